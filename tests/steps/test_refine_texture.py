import hashlib
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_svd import save_tiny_svd
from tiny_weights import write_scheduler, write_zero123

from dg4d_lib.errors import BadInput
from dg4d_lib.images import over_white
from dg4d_lib.mesh.textured import TexturedMesh, TrackedMesh
from dg4d_lib.refiner_settings import IdentitySettings, ImageToImageSettings, RefinerSettings, VideoToVideoSettings
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import write_frames, write_png
from steps.artifacts.meshes import read_meshes, read_tracked, write_meshes, write_tracked
from steps.fitting import priors
from steps.profiles import PREVIEW, step_settings
from steps.refine_texture import run
from steps.runtime.job import Job, StepReport

FRAMES = 3
TEXTURE = {"iterations": 2, "size": 64}
SUBJECT = torch.tensor([0.0, 0.6, 0.2, 1.0]).repeat(48, 48, 1)  # another color and size than the video
SUBJECT[:8, :, 3] = 0.0


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Inputs of the step: a board that moves, tracked and per frame, and its video."""
    corners = torch.tensor([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    texture = torch.full((16, 16, 3), 128 / 255)
    mesh = TexturedMesh(corners, torch.tensor([[0, 3, 2], [0, 2, 1]], dtype=torch.int32), uvs, texture)
    offsets = torch.stack([torch.full((4, 3), 0.05 * frame) for frame in range(FRAMES)])
    write_tracked(tmp_path / "tracked.in", TrackedMesh(mesh, offsets))
    write_meshes(
        tmp_path / "meshes.in", {i: replace(mesh, vertices=corners + offset) for i, offset in enumerate(offsets)}
    )
    red = torch.tensor([0.9, 0.1, 0.1]).expand(FRAMES, 64, 64, 3)
    write_frames(tmp_path / "video", DrivingVideo(red, torch.ones(FRAMES, 64, 64, 1), 24.0))
    write_png(tmp_path / "subject.png", SUBJECT)
    return tmp_path


def refine(folder: Path, mode: str, refiner: RefinerSettings) -> StepReport:
    return run(
        Job(
            inputs={mode: folder / f"{mode}.in", "subject": folder / "subject.png", "driving_video": folder / "video"},
            outputs={"tracked": folder / "tracked", "meshes": folder / "meshes"},
            settings=step_settings("refine_texture", PREVIEW.model_copy(update={"refiner": refiner})),
            seed=0,
            progress=lambda done, total, values: None,
            pictures=folder,
        )
    )


def video_to_video(folder: Path, strength_end: float = 0.0, **changes: object) -> VideoToVideoSettings:
    model = {"weights": str(save_tiny_svd(folder / "svd")), "num_inference_steps": 4}
    return VideoToVideoSettings(texture={**TEXTURE, **changes}, model=model, strength_end=strength_end)


@pytest.mark.parametrize("mode", ["tracked", "meshes"])
def test_video_diffusion_sees_all_frames_as_one_video(folder: Path, mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from dg4d_lib.texture.refiner import VideoToVideo

    seen = []
    refined = VideoToVideo.refine
    monkeypatch.setattr(
        VideoToVideo, "refine", lambda self, video, *rest: seen.append(len(video)) or refined(self, video, *rest)
    )
    facts = refine(folder, mode, video_to_video(folder, refresh_every=2))
    assert seen == [FRAMES]
    if mode == "tracked":
        textures = [read_tracked(folder / "tracked").mesh.texture]
    else:
        textures = [mesh.texture for mesh in read_meshes(folder / "meshes")]
        assert len(textures) == FRAMES
    for texture in textures:  # towards the driving video, which is red
        red, green, _ = texture[4:12, 4:12].mean((0, 1))
        assert red > 0.53 and green < 0.47
    assert facts.backend == "cpu (diffusers)" and any("unet" in name for name in facts.weights) and facts.licenses
    assert "every 2 iterations" in facts.notes[0] and "2 steps" in facts.notes[0]


def test_video_diffusion_is_conditioned_on_the_input_picture(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dg4d_lib.texture.refiner import VideoToVideo

    seen: list[torch.Tensor] = []
    init = VideoToVideo.__init__
    monkeypatch.setattr(
        VideoToVideo,
        "__init__",
        lambda self, kind, model, picture: seen.append(picture) or init(self, kind, model, picture),
    )
    refine(folder, "tracked", video_to_video(folder))
    torch.testing.assert_close(seen[0].cpu(), over_white(SUBJECT), rtol=0, atol=0.5 / 255)


def test_the_report_says_how_the_noise_was_annealed(folder: Path) -> None:
    (note,) = refine(folder, "tracked", video_to_video(folder, strength_end=0.05)).notes
    assert re.search(r"on, 2 steps \(in the last iteration from sigma 0\.002 on, 1 steps\);", note)


def test_every_frame_of_a_tracked_mesh_may_add_its_own(folder: Path) -> None:
    facts = refine(folder, "tracked", video_to_video(folder, frame_size=8))
    asset = read_tracked(folder / "tracked")
    assert asset.textures is not None and asset.textures.shape == (FRAMES, 8, 8, 3)
    assert asset.mesh.texture.shape == (16, 16, 3)
    assert "from frame to frame" in facts.notes[1]
    facts = refine(folder, "meshes", video_to_video(folder, frame_size=8))  # there every frame has its own anyway
    assert len(facts.notes) == 1


def test_image_diffusion_is_the_alternative(folder: Path) -> None:
    prior = {"weights": str(write_zero123(folder / "zero123")), "precision": "fp32"}
    settings = ImageToImageSettings(texture=TEXTURE, prior=prior, num_inference_steps=4)
    facts = refine(folder, "tracked", settings)
    assert "picture by picture" in facts.notes[0] and any("unet" in name for name in facts.weights)
    red, green, _ = read_tracked(folder / "tracked").mesh.texture[4:12, 4:12].mean((0, 1))
    assert red > 0.53 and green < 0.47


@pytest.mark.parametrize(
    ("scheduler", "message"),
    [("DDIMScheduler", r"set refiner\.prior\.variant=stable"), ("FlowMatchEulerDiscreteScheduler", "flow-matching")],
)
def test_other_models_than_the_settings_say_are_refused(
    folder: Path, scheduler: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = write_zero123(folder / "zero123")
    write_scheduler(weights / "scheduler", _class_name=scheduler)
    unet = hashlib.sha256((weights / "unet" / "diffusion_pytorch_model.safetensors").read_bytes()).hexdigest()
    monkeypatch.setattr(priors, "STABLE_UNET", unet)
    with pytest.raises(BadInput, match=message):
        refine(folder, "tracked", ImageToImageSettings(texture=TEXTURE, prior={"weights": str(weights)}))


def test_the_identity_needs_no_step(folder: Path) -> None:
    with pytest.raises(BadInput, match="leave refine_texture out"):
        refine(folder, "tracked", IdentitySettings())


def test_a_video_of_another_length_is_refused(folder: Path) -> None:
    write_frames(folder / "video", DrivingVideo(torch.rand(5, 64, 64, 3), torch.ones(5, 64, 64, 1), 24.0))
    with pytest.raises(BadInput, match="3 frames and the driving video has 5"):
        refine(folder, "tracked", video_to_video(folder))


def test_the_same_seed_gives_the_same_bytes(folder: Path) -> None:
    settings = video_to_video(folder, iterations=1)
    refine(folder, "tracked", settings)
    once = (folder / "tracked").read_bytes()
    refine(folder, "tracked", settings)
    assert (folder / "tracked").read_bytes() == once
