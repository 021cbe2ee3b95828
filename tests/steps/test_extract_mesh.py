import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.deformation.on_parts import OnParts
from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.fitting import guided_mesh
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.tracking.reference_frame import Trial
from dg4d_lib.metrics.image import iou
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import FramewiseSettings, LearnedPriorSettings, MeshSettings
from dg4d_lib.shape_prior import packaged
from dg4d_lib.video.driving import DrivingVideo
from steps import extract_mesh, plan_mesh
from steps.artifacts.media import read_png, write_frames
from steps.artifacts.mesh_plan import MeshPlan, read_plan, write_plan
from steps.artifacts.meshes import read_meshes, read_tracked
from steps.artifacts.motions import write_motion
from steps.extract_mesh import run
from steps.fitting.priors import subject_shapes
from steps.profiles import PREVIEW, step_settings
from steps.runtime.job import Job, StepReport

FRAMES = 3
CAMERA = OrbitCamera(width=64, height=64)
SHIFT = torch.tensor([0.1, -0.05, 0.2])
MESH = MeshSettings(grid=32, edge_length=0.12, texture_size=64, render_size=64)


def ball() -> Gaussians:
    """A blue ball; its Gaussians lie at a radius of 0.4."""
    points = torch.randn(300, 3, generator=torch.Generator().manual_seed(0))
    points = 0.4 * torch.nn.functional.normalize(points, dim=-1)
    color = torch.tensor([[0.1, 0.2, 0.9]]).expand(300, 3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(300, 4)
    return Gaussians(points, torch.full((300, 3), -2.8), quats, torch.full((300,), 3.0), rgb_to_sh(color))


def make_plan(
    folder: Path,
    gaussians: Gaussians,
    mesh: MeshSettings = MESH,
    video: Path | None = None,
    subject: Path | None = None,
) -> tuple[Job, StepReport]:
    """Plan the mesh of a cloud that begins one SHIFT beside its canonical place and goes on by one a frame."""
    motion = Framewise(FRAMES, len(gaussians))
    with torch.no_grad():
        for parameter in motion.parameters():
            parameter[..., :3] = (torch.arange(FRAMES) + 1)[:, None, None] * SHIFT
    folder.mkdir(exist_ok=True)
    write_ply(folder / "gaussians.ply", gaussians)
    write_motion(folder / "motion", motion, FramewiseSettings(), FRAMES, len(gaussians))
    settings = PREVIEW.model_copy(update={"mesh": mesh})
    job = Job(
        inputs={"gaussians": folder / "gaussians.ply", "motion": folder / "motion"}
        | ({"driving_video": video} if video else {})
        | ({"subject": subject} if subject else {}),
        outputs={
            "plan": folder / "plan",
            "tracked": folder / "tracked",
            "meshes": folder / "meshes",
            "picture": folder / "picture.png",
        },
        settings=step_settings("plan_mesh", settings),
        seed=0,
        progress=lambda done, total, values: None,
        pictures=folder,
    )
    return job, plan_mesh.run(job)


def extract(
    folder: Path,
    gaussians: Gaussians,
    mesh: MeshSettings = MESH,
    video: Path | None = None,
    subject: Path | None = None,
    **frames: int,
) -> tuple[Job, StepReport]:
    """Plan and extract a mesh.

    Facts are those of `extract_mesh`, with the notes of `plan_mesh` before its own.
    """
    job, planned = make_plan(folder, gaussians, mesh, video, subject)
    settings = step_settings("extract_mesh", PREVIEW.model_copy(update={"mesh": mesh}), **frames)
    facts = run(replace(job, inputs={**job.inputs, "plan": folder / "plan"}, settings=settings))
    return job, replace(facts, notes=(*planned.notes, *facts.notes))


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
    assert "agree with the Gaussians' to 9" in tracked[1].notes[0]
    assert not (tracked[0] / "meshes").exists()


def test_the_notes_say_what_kind_of_surface_it_is(tracked: tuple[Path, StepReport]) -> None:
    assert "in the reference frame the mesh is watertight, 1 component, 0 inverted" in tracked[1].notes


def test_the_frame_whose_surface_it_is_stays_with_the_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *arguments: Trial(2, 1.0, 0.0))
    extract(tmp_path, ball())
    asset = read_tracked(tmp_path / "tracked")
    assert asset.reference_frame == 2
    torch.testing.assert_close(asset.mesh.vertices.mean(0), 3 * SHIFT, atol=0.02, rtol=0)


def test_the_same_job_gives_the_same_bytes(tracked: tuple[Path, StepReport], tmp_path: Path) -> None:
    extract(tmp_path, ball())
    for name in ("tracked", "picture.png"):
        assert (tmp_path / name).read_bytes() == (tracked[0] / name).read_bytes()


@pytest.mark.parametrize(
    ("mode", "followed", "expected"),
    [
        ("auto", 0.94, ("tracked", 1)),
        ("auto", 0.86, ("per_frame", 0)),
        ("tracked", 0.8, ("tracked", 1)),
        ("per_frame", 0.0, ("per_frame", 0)),
    ],
)
def test_the_plan_says_what_is_extracted_and_from_which_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str, followed: float, expected: tuple[str, int]
) -> None:
    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *given: Trial(1, followed, 0.4))
    job, facts = extract(tmp_path, ball(), MESH.model_copy(update={"mode": mode}))
    plan = read_plan(tmp_path / "plan")
    assert (plan.mode, plan.reference_frame) == expected
    made = {"tracked": "tracked", "per_frame": "meshes"}[plan.mode]
    assert {name for name, path in job.outputs.items() if path.exists()} == {"plan", made, "picture"}
    refused = any("does not follow this motion (trial mesh: 86.0% IoU" in note for note in facts.notes)
    assert refused == (mode == "auto" and plan.mode == "per_frame")
    picture = read_png(job.outputs["picture"])[..., :3]
    assert picture.shape == (256, 1024, 3)
    blue = (picture[..., 2] - picture[..., 0] > 0.3).float().mean()
    assert 0.05 < blue < 0.5


def green_video(path: Path) -> Float[Tensor, "t h w 1"]:
    """Write a video of the moving ball in another color than its Gaussians have, and return its alpha."""
    cameras = [CAMERA]
    clouds = [replace(ball(), means=ball().means + (frame + 1) * SHIFT) for frame in range(FRAMES)]
    alpha = torch.cat([get_rasterizer("cpu")(cloud, cameras, torch.zeros(3)).alpha for cloud in clouds])
    green = torch.tensor([0.1, 0.9, 0.2]).expand(*alpha.shape[:-1], 3).contiguous()
    write_frames(path, DrivingVideo(green, alpha, 8.0))
    return alpha


@pytest.mark.parametrize("trial", [Trial(1, 0.8, 0.0), Trial(1, 0.95, 0.4)], ids=["silhouettes", "stretch"])
def test_the_video_guides_where_the_gaussians_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trial: Trial
) -> None:
    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *given: trial)
    monkeypatch.setattr(plan_mesh, "rank_guided_references", lambda *given: [(2, 0.9)])
    green_video(tmp_path / "video")
    make_plan(tmp_path, ball(), MESH.model_copy(update={"mode": "auto"}), video=tmp_path / "video")
    plan = read_plan(tmp_path / "plan")
    assert (plan.mode, plan.guide, plan.reference_frame, plan.followed) == ("tracked", "video", 2, 0.9)


def test_a_mesh_that_the_video_guides_follows_it_and_has_its_colors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *given: Trial(1, 0.8, 0.0))
    monkeypatch.setattr(plan_mesh, "rank_guided_references", lambda *given: [(2, 0.9)])
    monkeypatch.setattr(
        guided_mesh,
        "TRACKING",
        AssetSettings(tracking="descent", size=32, nodes=8, track_iterations=10, fit_points=100),
    )
    alpha = green_video(tmp_path / "video")
    _, facts = extract(tmp_path, ball(), MESH.model_copy(update={"mode": "auto"}), video=tmp_path / "video")
    asset = read_tracked(tmp_path / "tracked")
    shown, covered = render_mesh(asset.mesh, [CAMERA] * FRAMES, asset.offsets)
    assert iou(covered, alpha).min() > 0.8  # held still, 0.4: the ball also grows, for it comes nearer
    assert shown[covered[..., 0] == 1].mean(0).argmax() == 1  # green, from the video
    assert any("frame 2, which follows the driving video best" in note for note in facts.notes)
    assert "trial mesh of frame 2: 90.0% silhouette IoU over the motion" in facts.notes


def test_of_two_frames_the_one_whose_mesh_shows_the_video_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mesh of frame 2 stands still, that of frame 0 goes with the ball."""

    def follow(vertices: torch.Tensor, faces: object, states: object, video: object, frame: int, *_: object) -> object:
        steps = torch.arange(FRAMES).float()[:, None, None] * SHIFT
        return (steps if frame == 0 else torch.zeros_like(steps)).expand(-1, len(vertices), -1).contiguous()

    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *given: Trial(1, 0.8, 0.0))
    monkeypatch.setattr(plan_mesh, "rank_guided_references", lambda *given: [(2, 0.9), (0, 0.89)])
    monkeypatch.setattr(extract_mesh, "follow_video", follow)
    green_video(tmp_path / "video")
    _, facts = extract(tmp_path, ball(), MESH.model_copy(update={"mode": "auto"}), video=tmp_path / "video")
    assert read_plan(tmp_path / "plan").other_candidates == (0,)
    assert read_tracked(tmp_path / "tracked").reference_frame == 0
    (compared,) = [note for note in facts.notes if note.startswith("PSNR at the input view after tracking")]
    worse, better = map(float, re.findall(r"frame \d ([\d.]+) dB", compared))
    assert worse < better - 3


@pytest.mark.parametrize(
    ("mode", "moves", "given_up"), [("auto", False, True), ("auto", True, False), ("tracked", False, False)]
)
def test_one_mesh_that_shows_the_video_far_worse_than_the_gaussians_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str, moves: bool, given_up: bool
) -> None:
    """The mesh stands still in a corner of the picture, or goes with the ball."""

    def stand(vertices: torch.Tensor, offsets: torch.Tensor, *_: object) -> torch.Tensor:
        away = torch.tensor([0.0, 0.5, 0.0]).expand_as(offsets)
        return offsets if moves else away

    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *given: Trial(1, 0.9, 0.0))
    monkeypatch.setattr(extract_mesh, "fit_outline_detail", stand)
    steps = (torch.arange(FRAMES) + 1)[:, None, None] * SHIFT
    states = replace(ball(), means=ball().means + steps, log_scales=ball().log_scales.expand(FRAMES, -1, -1),
                     quats=ball().quats.expand(FRAMES, -1, -1))  # fmt: skip
    drawn = get_rasterizer("cpu")(states, [CAMERA] * FRAMES, torch.zeros(3))
    write_frames(tmp_path / "video", DrivingVideo(drawn.color / drawn.alpha.clamp_min(1e-4), drawn.alpha, 8.0))
    _, facts = extract(tmp_path, ball(), MESH.model_copy(update={"mode": mode}), tmp_path / "video")
    assert (tmp_path / "tracked").exists() is not given_up
    assert read_plan(tmp_path / "plan").mode == ("per_frame" if given_up else "tracked")
    assert any("a mesh per frame is used" in note for note in facts.notes) is given_up


def test_no_face_is_flipped_against_the_first_frame() -> None:
    """A third of the vertices stand out in the first frame and are pressed in later; each way tilts faces a little."""
    solid = trimesh.creation.icosphere(3, 0.4)
    vertices, faces = torch.from_numpy(solid.vertices).float(), torch.from_numpy(np.asarray(solid.faces))
    picked = torch.from_numpy(np.random.default_rng(0).random(len(vertices)) < 0.35)[:, None]
    offsets = torch.stack([0.08 * picked * vertices, -0.08 * picked * vertices])
    silhouettes = torch.ones(2, 1, 128, 128, dtype=torch.bool)

    def flipped(against: torch.Tensor, offsets: torch.Tensor) -> int:
        finder = DefectFinder(faces.numpy(), against.double().numpy())
        return sum(int(finder.flipped((vertices + one).double().numpy()).sum()) for one in offsets)

    assert flipped(vertices, offsets) == 0
    assert flipped(vertices + offsets[0], offsets) > 0
    sound, _ = extract_mesh._sound(vertices, offsets, faces, silhouettes, None)
    assert flipped(vertices, sound) == flipped(vertices + sound[0], sound) == 0


@pytest.mark.parametrize("mode", ["tracked", "per_frame"])
def test_a_leg_that_the_grid_lacks_grows_out_of_the_mesh(tmp_path: Path, mode: str) -> None:
    camera, reach = OrbitCamera(width=128, height=128), torch.linspace(0, 0.7, 400)
    alphas = []
    for frame in range(FRAMES):
        means = ball().means + (frame + 1) * SHIFT
        alpha = get_rasterizer("cpu")(replace(ball(), means=means), [camera], torch.zeros(3)).alpha[0]
        leg = (frame + 1) * SHIFT + reach[:, None] * torch.tensor([-0.9, -0.4, 0.0])
        in_camera = torch.cat([leg, torch.ones(len(leg), 1)], 1).double() @ camera.viewmat().T
        columns, rows = (in_camera[:, :2] / in_camera[:, 2:3] * camera.focal + 64).long().T
        alpha[rows, columns] = 1
        alphas.append(alpha)
    alpha = torch.stack(alphas)
    green = torch.tensor([0.1, 0.9, 0.2]).expand(*alpha.shape[:-1], 3).contiguous()
    write_frames(tmp_path / "video", DrivingVideo(green, alpha, 8.0))
    settings = MESH.model_copy(update={"mode": mode, "edge_length": 0.05})
    _, facts = extract(tmp_path, ball(), settings, tmp_path / "video")
    if mode == "tracked":
        asset = read_tracked(tmp_path / "tracked")
        moved = [replace(asset.mesh, vertices=asset.mesh.vertices + offset) for offset in asset.offsets]
        assert any(note.endswith("narrower than a cell of mesh.grid: 1") for note in facts.notes)
    else:
        moved = read_meshes(tmp_path / "meshes")
    for mesh, expected, frame in zip(moved, alpha, range(FRAMES), strict=True):
        far = (mesh.vertices - (frame + 1) * SHIFT).norm(dim=-1)
        assert far.max() > 0.65 and far.median() < 0.55
        _, covered = render_mesh(mesh, [camera])
        assert iou(covered, expected[None]).min() > 0.9


@pytest.mark.parametrize("source", ["prior", "gaussians"])
def test_a_guessed_subject_has_the_surface_of_the_shape_network(tmp_path: Path, source: str) -> None:
    alpha = green_video(tmp_path / "video")
    settings = MESH.model_copy(update={"mode": "tracked", "source": source})
    _, facts = extract(tmp_path, ball(), settings, tmp_path / "video", subject=tmp_path / "subject.png")
    guess = LearnedPriorSettings()
    color = torch.tensor([0.1, 0.9, 0.2]).expand(*alpha.shape[:-1], 3)
    surface = subject_shapes(guess, list(torch.cat([color, alpha], -1))).surface(0)
    vertices = read_tracked(tmp_path / "tracked").mesh.vertices
    apart = float(torch.cdist(vertices, surface.vertices).amin(1).mean())
    guessed = source == "prior"
    assert (apart < 0.01) is guessed
    assert any("the mesh is the shape network's surface of frame 0" in note for note in facts.notes) is guessed
    assert any("outlines of the isosurface at density" in note for note in facts.notes) is not guessed
    assert (facts.weights == packaged.digests()) is guessed


@pytest.mark.parametrize("with_video", [True, False])
def test_what_no_trial_follows_gets_a_mesh_per_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_video: bool
) -> None:
    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *given: Trial(1, 0.8, 0.0))
    monkeypatch.setattr(plan_mesh, "rank_guided_references", lambda *given: [(2, 0.84)])
    green_video(tmp_path / "video")
    video = tmp_path / "video" if with_video else None
    _, facts = make_plan(tmp_path, ball(), MESH.model_copy(update={"mode": "auto"}), video=video)
    plan = read_plan(tmp_path / "plan")
    assert (plan.mode, plan.guide, plan.reference_frame) == ("per_frame", "gaussians", 0)
    limit = "84.0% IoU, mesh.min_guided requires" if with_video else "80.0% IoU, mesh.min_followed requires"
    assert any(limit in note for note in facts.notes)


@pytest.mark.parametrize("mode", ["auto", "tracked"])
def test_parts_on_a_hinge_get_a_mesh_per_frame_unless_one_is_asked_for(mode: str, tmp_path: Path) -> None:
    job, _ = make_plan(tmp_path, ball(), MESH.model_copy(update={"mode": mode}))
    assert read_plan(tmp_path / "plan").mode == "tracked"
    cloud, turns = ball(), torch.tensor([1.0, 0, 0, 0]).expand(FRAMES, 2, -1)
    owners, field = (cloud.means[:, 1] > 0).long(), Framewise(FRAMES, len(cloud))
    moved = OnParts(field, owners, cloud.quats, torch.zeros(2, 3), turns, torch.zeros(FRAMES, 2, 3))
    write_motion(tmp_path / "motion", moved, FramewiseSettings(), FRAMES, len(cloud))
    notes = plan_mesh.run(job).notes
    assert read_plan(tmp_path / "plan").mode == ("per_frame" if mode == "auto" else "tracked")
    assert any("opens about a hinge" in note for note in notes) == (mode == "auto")


@pytest.mark.parametrize(("thickness", "finer"), [(0.0, True), (0.4, False)])
def test_a_mesh_per_frame_gets_a_finer_grid_for_thin_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, thickness: float, finer: bool
) -> None:
    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *given: Trial(1, 0.8, 0.0))
    body = ball()
    body = replace(body, means=body.means * torch.tensor([1, 1, max(thickness, 1e-3) / 0.4]))
    if not thickness:
        body = replace(body, log_scales=body.log_scales - torch.tensor([0, 0, 2.0]))
    settings = MESH.model_copy(update={"mode": "auto"})
    _, facts = extract(tmp_path, body, settings)
    plan = read_plan(tmp_path / "plan")
    assert plan.grid == (round(1.5 * settings.grid) if finer else None)
    assert any(note.startswith("thin parts") for note in facts.notes) is finer
    assert len(read_meshes(tmp_path / "meshes")) == FRAMES


def test_a_stretched_mesh_that_the_video_guides_no_better_stays_with_its_gaussians(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plan_mesh, "select_reference_frame", lambda *given: Trial(1, 0.95, 0.4))
    monkeypatch.setattr(plan_mesh, "rank_guided_references", lambda *given: [(2, 0.84)])
    green_video(tmp_path / "video")
    make_plan(tmp_path, ball(), MESH.model_copy(update={"mode": "auto"}), video=tmp_path / "video")
    plan = read_plan(tmp_path / "plan")
    assert (plan.mode, plan.guide, plan.reference_frame, plan.followed) == ("tracked", "gaussians", 1, 0.95)


def test_a_plan_comes_back_with_every_bit_and_other_files_are_refused(tmp_path: Path) -> None:
    plan = MeshPlan(mode="tracked", reference_frame=3, followed=0.1 + 0.2, level=0.5 * 2**0.25)
    write_plan(tmp_path / "plan", plan)
    assert read_plan(tmp_path / "plan") == plan
    (tmp_path / "plan").write_bytes(b"PK")
    with pytest.raises(BadInput, match="not a plan of a mesh"):
        read_plan(tmp_path / "plan")


def test_a_mesh_per_frame_stands_where_the_cloud_is_then(tmp_path: Path) -> None:
    _, facts = extract(tmp_path, ball(), MESH.model_copy(update={"mode": "per_frame"}), first_frame=1, end_frame=3)
    assert facts.notes[1:] == ("all 2 meshes of frames 1 to 2 are closed surfaces without defects",)
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
