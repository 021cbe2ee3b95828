from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.geometry.harmonics import harmonics_of_color
from dg4d_lib.settings import FramewiseSettings, IdentitySettings, MeshSettings
from dg4d_lib.video.driving import DrivingVideo
from steps import extract_mesh
from steps.artifacts.media import read_png, write_frames
from steps.artifacts.meshes import read_meshes, read_tracked, write_meshes, write_tracked
from steps.artifacts.motions import write_motion
from steps.extract_mesh import run
from steps.profiles import ExtractMeshSettings, RefineTextureSettings
from steps.refine_texture import run as refine
from steps.runtime.job import Job, StepReport

FRAMES = 3
SHIFT = torch.tensor([0.1, -0.05, 0.2])
MESH = MeshSettings(grid=32, edge_length=0.12, texture_size=64, render_size=64)


def ball() -> Gaussians:
    """A blue ball; its Gaussians lie at a radius of 0.4."""
    points = torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    points = 0.4 * torch.nn.functional.normalize(points, dim=-1)
    color = torch.tensor([[0.1, 0.2, 0.9]]).expand(300, 3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(300, 4)
    return Gaussians(points, torch.full((300, 3), -2.8), quats, torch.full((300,), 3.0), harmonics_of_color(color))


def extract(folder: Path, gaussians: Gaussians, mesh: MeshSettings = MESH, **frames: int) -> tuple[Job, StepReport]:
    """Run the step on a cloud that begins one SHIFT beside its canonical place, and goes on by one SHIFT a frame."""
    motion = Framewise(FRAMES, len(gaussians))
    with torch.no_grad():
        for parameter in motion.parameters():
            parameter[..., :3] = (torch.arange(FRAMES) + 1)[:, None, None] * SHIFT
    folder.mkdir(exist_ok=True)
    write_ply(folder / "gaussians.ply", gaussians)
    write_motion(folder / "motion", motion, FramewiseSettings(), FRAMES, len(gaussians))
    job = Job(
        inputs={"gaussians": folder / "gaussians.ply", "motion": folder / "motion"},
        outputs={"tracked": folder / "tracked", "meshes": folder / "meshes", "picture": folder / "picture.png"},
        settings=ExtractMeshSettings(rasterizer="auto", mesh=mesh, **frames),
        seed=0,
        progress=lambda done, total, values: None,
        pictures=folder,
    )
    return job, run(job)


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StepReport]:
    folder = tmp_path_factory.mktemp("tracked")
    return folder, extract(folder, ball())[1]


def test_the_mesh_is_that_of_the_first_frame_and_moves_with_the_cloud(tracked: tuple[Path, StepReport]) -> None:
    asset = read_tracked(tracked[0] / "tracked")
    radii = (asset.mesh.vertices - SHIFT).norm(dim=-1)
    assert radii.mean() == pytest.approx(0.5, abs=0.04)  # half-transparent two standard deviations of 0.06 outside
    assert radii.std() < 0.03
    expected = torch.arange(FRAMES)[:, None, None] * SHIFT
    drawn_in = asset.offsets[0].norm(dim=-1)  # cleaning smoothed the bumps, and the surface of a moment is denser
    assert drawn_in.mean() < 0.02
    assert drawn_in.max() < 0.06
    ways = asset.offsets - asset.offsets[:1]
    torch.testing.assert_close(ways, expected.expand_as(ways), atol=1e-4, rtol=0)


def test_the_texture_has_the_color_of_the_cloud(tracked: tuple[Path, StepReport]) -> None:
    texture = read_tracked(tracked[0] / "tracked").mesh.texture
    torch.testing.assert_close(texture.mean((0, 1)), torch.tensor([0.1, 0.2, 0.9]), atol=0.02, rtol=0)


def test_the_picture_shows_it_and_the_notes_say_how_well_it_fits(tracked: tuple[Path, StepReport]) -> None:
    picture = read_png(tracked[0] / "picture.png")
    assert picture.shape == (256, 4 * 256, 3)
    assert (picture.amin(-1) < 0.5).float().mean() > 0.05
    assert "outlines agree with the Gaussians' to 9" in tracked[1].notes[0]
    assert not (tracked[0] / "meshes").exists()


def test_the_notes_say_what_kind_of_surface_it_is(tracked: tuple[Path, StepReport]) -> None:
    assert "at rest it is watertight, 1 component, 0 inverted" in tracked[1].notes


def test_the_frame_whose_surface_it_is_stays_with_the_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extract_mesh, "select_reference_frame", lambda *arguments: (2, 1.0))
    extract(tmp_path, ball())
    asset = read_tracked(tmp_path / "tracked")
    assert asset.rest == 2
    torch.testing.assert_close(asset.mesh.vertices.mean(0), 3 * SHIFT, atol=0.02, rtol=0)


def test_the_same_job_gives_the_same_bytes(tracked: tuple[Path, StepReport], tmp_path: Path) -> None:
    extract(tmp_path, ball())
    for name in ("tracked", "picture.png"):
        assert (tmp_path / name).read_bytes() == (tracked[0] / name).read_bytes()


@pytest.mark.parametrize(("followed", "outputs"), [(0.9, {"tracked", "picture"}), (0.8, {"picture"})])
def test_in_auto_there_is_one_mesh_only_where_it_follows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, followed: float, outputs: set[str]
) -> None:
    monkeypatch.setattr(extract_mesh, "select_reference_frame", lambda *given: (1, followed))
    job, facts = extract(tmp_path, ball(), MESH.model_copy(update={"mode": "auto"}))
    assert {name for name, path in job.outputs.items() if path.exists()} == outputs
    assert any("does not follow this motion (80.0% IoU" in note for note in facts.notes) == (followed == 0.8)
    picture = read_png(job.outputs["picture"])[..., :3]
    assert picture.shape == (256, 1024, 3)
    blue = (picture[..., 2] - picture[..., 0] > 0.3).float().mean()
    assert 0.05 < blue < 0.5


def test_a_mesh_per_frame_stands_where_the_cloud_is_then(tmp_path: Path) -> None:
    _, facts = extract(tmp_path, ball(), MESH.model_copy(update={"mode": "per_frame"}), first_frame=1, end_frame=3)
    assert facts.notes[1:] == ("2 of 2 meshes from frame 1 on bound solids",)
    meshes = read_meshes(tmp_path / "meshes")
    centers = torch.stack([(mesh.vertices.amax(0) + mesh.vertices.amin(0)) / 2 for mesh in meshes])
    torch.testing.assert_close(centers, torch.tensor([[2.0], [3.0]]) * SHIFT, atol=0.03, rtol=0)
    assert not (tmp_path / "tracked").exists()


def test_frames_that_the_motion_does_not_have_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"frames 2 to 4.*the motion has 3"):
        extract(tmp_path, ball(), MESH.model_copy(update={"mode": "per_frame"}), first_frame=2, end_frame=4)


def test_an_empty_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FitDiverged, match="no surface"):
        extract(tmp_path, replace(ball(), opacity_logits=torch.full((300,), -20.0)))


@pytest.mark.parametrize("mode", ["tracked", "meshes"])
def test_refining_with_the_identity_keeps_the_mesh_and_sets_the_clock(
    tracked: tuple[Path, StepReport], tmp_path: Path, mode: str
) -> None:
    asset = read_tracked(tracked[0] / "tracked")
    write_tracked(tmp_path / "given_tracked", asset)
    write_meshes(tmp_path / "given_meshes", {0: asset.mesh, 1: asset.mesh})
    write_frames(tmp_path / "video", DrivingVideo(torch.rand(FRAMES, 8, 8, 3), torch.ones(FRAMES, 8, 8, 1), 24.0))
    job = Job(
        inputs={mode: tmp_path / f"given_{mode}", "driving_video": tmp_path / "video"},
        outputs={"tracked": tmp_path / "tracked", "meshes": tmp_path / "meshes"},
        settings=RefineTextureSettings(refiner=IdentitySettings()),
        seed=0,
        progress=lambda done, total, values: None,
        pictures=tmp_path,
    )
    refine(job)
    if mode == "tracked":
        refined = read_tracked(tmp_path / "tracked")
        assert refined.fps == 24.0
        assert torch.equal(refined.mesh.texture, asset.mesh.texture)
        assert torch.equal(refined.offsets, asset.offsets)
    else:
        assert (tmp_path / "meshes").read_bytes() == (tmp_path / "given_meshes").read_bytes()
        assert not (tmp_path / "tracked").exists()
