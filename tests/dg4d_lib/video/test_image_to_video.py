"""Driving videos from pipelines of diffusers: their names, sizes and numbers of frames."""

import inspect
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tiny_svd import save_tiny_svd
from tiny_text_to_image import save_pipeline
from tiny_wan import save_tiny_wan

from dg4d_lib.diffusion.flop_counter import count_flops
from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import DiffusersVideoSettings
from dg4d_lib.video.image_to_video import ImageToVideo, image_to_video_class, kept_frames, own_names

CPU = torch.device("cpu")
pytestmark = [
    pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning"),  # SVD's scheduler
    pytest.mark.usefixtures("quick_segmentation"),
]


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("models")
    return {
        "wan": save_tiny_wan(base / "wan"),
        "flf": save_tiny_wan(base / "flf", last_image=True),
        "svd": save_tiny_svd(base / "svd"),
    }


def small(**changes: Any) -> DiffusersVideoSettings:
    return DiffusersVideoSettings(
        **{"frames": 3, "height": 64, "width": 64, "num_inference_steps": 2, "prompt": "the subject moves", **changes}
    )


def disc(size: int = 48) -> torch.Tensor:
    axis = torch.linspace(-1, 1, size)
    inside = (axis[:, None] ** 2 + axis**2 < 0.5).float()
    return torch.stack([inside, 0.3 * inside, 0 * inside, inside], -1)


def made(folder: Path, seed: int = 0, **changes: Any) -> tuple[Any, ImageToVideo]:
    generator = ImageToVideo.load(folder, small(**changes), CPU)
    return generator.generate_all(disc(), [torch.Generator().manual_seed(seed)])[0], generator


def test_a_text_to_video_folder_is_opened_as_its_image_to_video_sibling(folders: dict[str, Path]) -> None:
    assert image_to_video_class(folders["wan"]) == "WanImageToVideoPipeline"
    assert image_to_video_class(folders["flf"]) == ""
    assert image_to_video_class(folders["svd"]) == ""


@pytest.mark.parametrize("name", ["wan", "svd"])
def test_a_picture_becomes_as_many_frames_as_asked_for_in_its_own_size(name: str, folders: dict[str, Path]) -> None:
    video, _ = made(folders[name], fps=5.0)
    assert video.frames.shape == (3, 48, 48, 3) and video.alpha.shape == (3, 48, 48, 1) and video.fps == 5
    assert bool(video.frames.isfinite().all()) and 0 <= float(video.frames.min()) <= float(video.frames.max()) <= 1


def test_equal_seeds_give_equal_videos_and_others_do_not(folders: dict[str, Path]) -> None:
    first, again, other = (made(folders["wan"], seed)[0].frames for seed in (4, 4, 5))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_operations_are_counted_without_calling_a_vae_that_keeps_state_twice(folders: dict[str, Path]) -> None:
    plain = made(folders["wan"])[0].frames
    with count_flops() as flops:
        counted = made(folders["wan"])[0].frames
    assert torch.equal(plain, counted)
    assert flops["WanTransformer3DModel"] > 1e4 and flops["UMT5EncoderModel"] > 1e4
    assert "AutoencoderKLWan" not in flops


def test_a_loop_gives_the_picture_as_the_last_one_too(folders: dict[str, Path], monkeypatch: Any) -> None:
    generator = ImageToVideo.load(folders["flf"], small(loop=True), CPU)
    seen: dict[str, Any] = {}
    inner = type(generator.pipeline).__call__

    def spy(self: Any, **given: Any) -> Any:
        seen.update(given)
        return inner(self, **given)

    spy.__signature__ = inspect.signature(inner)  # type: ignore[attr-defined]  # introspected by the adapter
    monkeypatch.setattr(type(generator.pipeline), "__call__", spy)
    (video,) = generator.generate_all(disc(), [torch.Generator().manual_seed(0)])
    assert seen["last_image"] is seen["image"] and seen["num_frames"] == 5  # 3 + the first again, as 4 n + 1
    assert len(video) == 3


@pytest.mark.parametrize(("name", "reason"), [("wan", "was not trained on last pictures"), ("svd", "no last picture")])
def test_a_loop_without_a_first_last_frame_model_is_refused(name: str, reason: str, folders: dict[str, Path]) -> None:
    with pytest.raises(BadInput, match=rf"driving\.loop=true .*{reason}.*driving\.weights=wan2\.1-flf2v"):
        ImageToVideo.load(folders[name], small(loop=True), CPU)


def test_a_pipeline_without_a_picture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"StableDiffusionPipeline .* is not an image-to-video pipeline"):
        ImageToVideo.load(save_pipeline(tmp_path / "words"), small(), CPU)


def test_sizes_are_rounded_to_patches_and_the_user_is_told(folders: dict[str, Path]) -> None:
    _, generator = made(folders["wan"], height=72, width=104)
    assert generator.notes[0] == "The video model takes multiples of 32 pixels: 96 x 64 were generated."
    assert not any("multiples" in note for note in made(folders["svd"])[1].notes)


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda image, prompt, num_frames, guidance_scale: 0, {"image", "prompt", "num_frames", "guidance_scale"}),
        (lambda image, frames, max_guidance_scale, fps: 0, {"image", "frames", "max_guidance_scale", "fps"}),
        (lambda image, num_frames, frame_rate: 0, {"image", "num_frames", "frame_rate"}),
    ],
)
def test_values_go_under_the_names_that_a_pipeline_has(call: Any, names: set[str]) -> None:
    values = dict.fromkeys(("image", "prompt", "num_frames", "guidance_scale", "fps"), 1)
    assert set(own_names(values, inspect.signature(call).parameters)) == names


@pytest.mark.parametrize(
    ("factors", "settings", "frames"),
    [
        ({"vae_scale_factor_temporal": 4}, {"frames": 14}, 17),
        ({"vae_temporal_compression_ratio": 8}, {"frames": 17}, 17),
        ({"vae_scale_factor_temporal": 4}, {"frames": 14, "generated_frames": 50}, 53),
        ({}, {"frames": 14}, 14),
    ],
)
def test_the_number_of_frames_is_one_that_the_vae_can_make(
    factors: dict[str, int], settings: dict[str, int], frames: int
) -> None:
    pipeline = SimpleNamespace(components={}, **factors)
    generator = object.__new__(ImageToVideo)
    generator.settings, generator.pipeline = DiffusersVideoSettings(**settings), pipeline
    assert generator._frame_count() == frames


def test_kept_frames_span_the_video_and_a_loop_ends_before_it_begins_again() -> None:
    assert kept_frames(17, 17, loop=False) == list(range(17))
    assert kept_frames(9, 3, loop=False) == [0, 4, 8]
    assert kept_frames(9, 4, loop=True) == [0, 2, 4, 6]


def test_what_the_pipeline_refuses_is_told_in_its_words(folders: dict[str, Path], monkeypatch: Any) -> None:
    generator = ImageToVideo.load(folders["svd"], small(), CPU)

    def refuse(image: Any, num_frames: int) -> None:
        raise ValueError("this many frames are too many")

    monkeypatch.setattr(type(generator.pipeline), "__call__", lambda self, image=None, num_frames=1: refuse(image, 1))
    generator._names = {"image": None, "num_frames": None}  # type: ignore[assignment]  # as the call above
    with pytest.raises(BadInput, match=r"StableVideoDiffusionPipeline .* refused its input: this many frames"):
        generator.generate_all(disc(), [torch.Generator()])
