import math
from collections.abc import Sequence
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.texture import build_lookup, sample_bilinear, sample_texture
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.refiner_settings import TextureSettings
from dg4d_lib.texture import refine
from dg4d_lib.texture.refine import MeshClip, refine_textures
from dg4d_lib.video.driving import DrivingVideo

SIZE, FRAMES = 64, 3
SETTINGS = TextureSettings(iterations=50, size=SIZE, azimuth_step_deg=40.0)
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])
GRAY = torch.full((8, 8, 3), 0.5)


def box(texture: Tensor) -> TexturedMesh:
    """Four upright sides around the axis, each with a quarter of the texture, seen from all azimuths."""
    vertices, uvs, faces = [], [], []
    for side in range(4):
        angle = math.radians(90 * side)
        for x, y, u, v in ((-1, -1, 0, 1), (1, -1, 1, 1), (1, 1, 1, 0), (-1, 1, 0, 0)):
            place = (x * math.cos(angle) + math.sin(angle), y, -x * math.sin(angle) + math.cos(angle))
            vertices.append([0.4 * c for c in place])
            uvs.append([(side + 0.05 + 0.9 * u) / 4, 0.05 + 0.9 * v])
        faces.append(FACES + 4 * side)
    return TexturedMesh(torch.tensor(vertices), torch.cat(faces), torch.tensor(uvs), texture)


def painted(seed: float = 0.0) -> Tensor:
    """Smooth colors that differ everywhere."""
    y, x = torch.meshgrid(torch.linspace(0, 1, 32), torch.linspace(0, 1, 128), indexing="ij")
    waves = (7 * x + seed, 5 * y + 3 * x + seed, 9 * x - 4 * y + seed)
    return torch.stack([0.5 + 0.35 * torch.sin(wave) for wave in waves], -1)


def shown(meshes: Sequence[TexturedMesh], cameras: Sequence[OrbitCamera]) -> Tensor:
    """Each mesh over white from its camera."""
    pictures = []
    for mesh, camera in zip(meshes, cameras, strict=True):
        fragments = rasterize_mesh(mesh.vertices, mesh.faces, [camera])
        lookup = build_lookup(mesh.vertices, mesh.faces, mesh.uvs, mesh.texture.shape[:2], [camera], fragments)
        picture = torch.ones(*lookup.covered.shape, 3)
        picture[lookup.covered] = sample_texture(mesh.texture, lookup)
        pictures.append(picture[0])
    return torch.stack(pictures)


class Oracle:
    """Returns the true pictures, and remembers what it was asked."""

    def __init__(self, truth: Sequence[TexturedMesh]) -> None:
        self.truth = truth
        self.cameras: list[Sequence[OrbitCamera]] = []
        self.progress: list[float] = []

    def refine(
        self, video: Tensor, cameras: Sequence[OrbitCamera], progress: float, generator: torch.Generator
    ) -> Tensor:
        self.cameras.append(cameras)
        self.progress.append(progress)
        return shown(self.truth, cameras)


class Satisfied:
    """Finds every video good."""

    def refine(
        self, video: Tensor, cameras: Sequence[OrbitCamera], progress: float, generator: torch.Generator
    ) -> Tensor:
        return video


def moved(mesh: TexturedMesh, frame: int) -> TexturedMesh:
    return TexturedMesh(mesh.vertices + shift(mesh, frame), mesh.faces, mesh.uvs, mesh.texture)


def shift(mesh: TexturedMesh, frame: int) -> Tensor:
    return torch.tensor([0.05 * frame, 0.0, 0.0]).expand_as(mesh.vertices)


def driving_of(meshes: Sequence[TexturedMesh]) -> DrivingVideo:
    frames = shown(meshes, [OrbitCamera(width=SIZE, height=SIZE)] * len(meshes))
    return DrivingVideo(frames, torch.ones_like(frames[..., :1]), 7.0)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def error(texture: Tensor, truth: Tensor) -> float:
    """Mean over the texels that the sides show."""
    inside = torch.linspace(0.1, 0.9, 20)
    places = torch.stack([torch.stack([(side + u) / 4, v]) for side in range(4) for u in inside for v in inside])
    return float((sample_bilinear(texture, places) - sample_bilinear(truth, places)).abs().mean())


def tracked(texture: Tensor) -> list[MeshClip]:
    mesh = box(texture)
    return [MeshClip(mesh, torch.stack([shift(mesh, frame) for frame in range(FRAMES)]))]


def test_a_refiner_that_knows_the_truth_gives_a_tracked_mesh_its_texture() -> None:
    truth, start = painted(), torch.full((32, 128, 3), 0.5)
    meshes = [moved(box(truth), frame) for frame in range(FRAMES)]
    (refined,) = refine_textures(tracked(start), driving_of(meshes), Oracle(meshes), SETTINGS, rng())
    assert error(start, truth) > 0.2
    assert error(refined.texture, truth) < 0.02
    assert refined.frame_textures is None


def test_it_gives_every_frame_of_its_own_mesh_its_own_texture() -> None:
    truths = [painted(frame) for frame in range(FRAMES)]
    meshes = [moved(box(truth), frame) for frame, truth in enumerate(truths)]
    start = torch.full((32, 128, 3), 0.5)
    clips = [MeshClip(moved(box(start), frame), torch.zeros(1, 16, 3)) for frame in range(FRAMES)]
    refined = refine_textures(clips, driving_of(meshes), Oracle(meshes), SETTINGS, rng())
    textures = [each.texture for each in refined]
    for texture, truth in zip(textures, truths, strict=True):
        assert error(texture, truth) < 0.05  # each is seen by one camera per iteration
    assert error(textures[0], truths[2]) > 0.1


def test_a_texture_that_changes_over_time_takes_what_every_frame_adds() -> None:
    truths = [painted(0.6 * frame) for frame in range(FRAMES)]
    meshes = [moved(box(truth), frame) for frame, truth in enumerate(truths)]
    errors = {}
    for size in (0, 64):
        settings = SETTINGS.model_copy(update={"frame_size": size})
        (refined,) = refine_textures(tracked(painted()), driving_of(meshes), Oracle(meshes), settings, rng())
        shown_at = [refined.texture] * FRAMES if refined.frame_textures is None else list(refined.frame_textures)
        assert (refined.frame_textures is None) == (size == 0)
        errors[size] = max(error(texture, truth) for texture, truth in zip(shown_at, truths, strict=True))
    assert shown_at[0].shape == (16, 64, 3)  # as the texture, half as large
    assert errors[0] > 0.1
    assert errors[64] < 0.3 * errors[0]


def test_where_nothing_changes_frames_add_next_to_nothing() -> None:
    meshes = [moved(box(painted()), frame) for frame in range(FRAMES)]
    settings = SETTINGS.model_copy(update={"frame_size": 128})
    start = torch.full((32, 128, 3), 0.5)
    (refined,) = refine_textures(tracked(start), driving_of(meshes), Oracle(meshes), settings, rng())
    assert refined.frame_textures is not None and refined.frame_textures.shape == (FRAMES, 32, 128, 3)
    for texture in refined.frame_textures:
        assert error(texture, painted()) < 0.03
    assert max(error(one, other) for one in refined.frame_textures for other in refined.frame_textures) < 0.03


def test_what_frames_add_is_what_its_weight_leaves_of_it() -> None:
    """A board in one color per frame: a(b + r - c)^2 + w r^2 + w (change of r)^2 per texel, a line of equations."""
    board = TexturedMesh(box(painted()).vertices[:4], FACES, torch.tensor([[0.0, 1], [1, 1], [1, 0], [0, 0]]), GRAY)
    colors, weight = torch.tensor([0.3, 0.4, 0.8]), 0.2
    frames = colors[:, None, None, None].expand(FRAMES, SIZE, SIZE, 3)
    video = DrivingVideo(frames, torch.ones(FRAMES, SIZE, SIZE, 1), 7.0)
    settings = SETTINGS.model_copy(update={"iterations": 150, "frame_size": 8, "frame_weight": weight})
    (refined,) = refine_textures([MeshClip(board, torch.zeros(FRAMES, 4, 3))], video, Satisfied(), settings, rng())

    drawn = rasterize_mesh(board.vertices, board.faces, [OrbitCamera(width=SIZE, height=SIZE)])
    seen = float((drawn.faces >= 0).double().mean())
    steps = torch.eye(FRAMES, dtype=torch.float64).diff(dim=0)
    # unknowns: b, r1, r2, r3
    equations = torch.zeros(FRAMES + 1, FRAMES + 1, dtype=torch.float64)
    equations[0, 0], equations[0, 1:], equations[1:, 0] = FRAMES, 1, 1
    equations[1:, 1:] = (1 + weight / seen) * torch.eye(FRAMES) + weight / seen * steps.T @ steps
    base, *added = torch.linalg.solve(equations, torch.cat([colors.double().sum()[None], colors.double()])).tolist()
    inside = refined.texture[2:-2, 2:-2]
    assert float(inside.mean()) == pytest.approx(base, abs=0.01)
    assert refined.frame_textures is not None
    for texture, more in zip(refined.frame_textures, added, strict=True):
        assert float(texture[2:-2, 2:-2].mean()) == pytest.approx(base + more, abs=0.01)
    assert max(added) < 0.8 * float(colors.max() - colors.mean())  # so that the weight is felt


def test_the_camera_goes_round_at_constant_speed_from_random_starts() -> None:
    meshes = [moved(box(painted()), frame) for frame in range(FRAMES)]
    oracle, settings = Oracle(meshes), SETTINGS.model_copy(update={"iterations": 5, "azimuth_step_deg": 10.0})
    refine_textures(tracked(painted()), driving_of(meshes), oracle, settings, rng())
    starts = []
    for cameras in oracle.cameras:
        azimuths = [camera.azimuth_deg for camera in cameras]
        assert [b - a for a, b in pairwise(azimuths)] == pytest.approx([10.0, 10.0])
        assert all(camera.elevation_deg == 0 and camera.width == SIZE for camera in cameras)
        starts.append(azimuths[0])
    assert len(set(starts)) == 5 and max(starts) - min(starts) > 90
    assert oracle.progress == [0, 0.25, 0.5, 0.75, 1]


def test_targets_are_kept_for_as_many_iterations_as_wanted() -> None:
    meshes = [moved(box(painted()), frame) for frame in range(FRAMES)]
    oracle, settings = Oracle(meshes), SETTINGS.model_copy(update={"iterations": 7, "refresh_every": 3})
    refine_textures(tracked(painted()), driving_of(meshes), oracle, settings, rng())
    assert len(oracle.cameras) == 3


def test_texels_that_nothing_shows_stay_bit_for_bit() -> None:
    """Only the front is shown, and only its right half is painted anew; the lower half of the texture is on no side."""
    start = torch.cat([painted(), painted(1.0)])
    mesh = box(start)
    front = TexturedMesh(mesh.vertices[:4], mesh.faces[:2], mesh.uvs[:4] * torch.tensor([1.0, 0.4]), start)
    truth = TexturedMesh(front.vertices, front.faces, front.uvs, 1 - start)
    settings = SETTINGS.model_copy(update={"iterations": 3, "azimuth_step_deg": 0.0})
    (refined,) = refine_textures(
        [MeshClip(front, torch.zeros(1, 4, 3))], driving_of([truth]), Satisfied(), settings, rng()
    )
    assert torch.equal(refined.texture[32:], start[32:])
    assert (refined.texture[4:20, 4:28] - start[4:20, 4:28]).abs().mean() > 0.05


def test_the_input_view_does_not_color_what_it_sees_from_the_side() -> None:
    """The driving video is all red; the sides of a turned box are flatter than the least cosine, its front is not."""
    start = torch.full((32, 128, 3), 0.5)
    mesh = box(start)
    angle = math.radians(25)
    turn = torch.tensor([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    turned = TexturedMesh(mesh.vertices @ turn.T, mesh.faces, mesh.uvs, start)
    red = DrivingVideo(torch.tensor([1.0, 0, 0]).expand(1, SIZE, SIZE, 3), torch.ones(1, SIZE, SIZE, 1), 7.0)
    clips = [MeshClip(turned, torch.zeros(1, 16, 3))]
    settings = SETTINGS.model_copy(update={"iterations": 3, "min_cosine": 0.6})
    (refined,) = refine_textures(clips, red, Satisfied(), settings, rng())
    change = (refined.texture - start).abs().mean(-1).mean(0).reshape(4, 32).mean(1)
    assert change[0] > 0.1
    assert change[1:].max() < 0.01
    (refined,) = refine_textures(clips, red, Satisfied(), settings.model_copy(update={"min_cosine": 0.0}), rng())
    assert (refined.texture - start).abs().mean(-1).mean(0).reshape(4, 32).mean(1)[1:].max() > 0.1


def test_equal_seeds_give_equal_bits() -> None:
    meshes = [moved(box(painted()), frame) for frame in range(FRAMES)]
    settings = SETTINGS.model_copy(update={"iterations": 3})
    once, again, other = (
        refine_textures(tracked(painted(1.0)), driving_of(meshes), Oracle(meshes), settings, rng(seed))[0].texture
        for seed in (0, 0, 1)
    )
    assert torch.equal(once, again) and not torch.equal(once, other)


def front_of(texture: Tensor) -> TexturedMesh:
    mesh = box(texture)
    return TexturedMesh(mesh.vertices[:4], mesh.faces[:2], mesh.uvs[:4], texture)


def test_the_reference_view_is_compared_at_full_size_without_supersampling() -> None:
    """The public code renders 256 pixels, supersampled: averages of ours, whose error is never larger."""
    start, truth = front_of(painted()), front_of(painted(1.0))
    driving, losses = driving_of([truth]), []
    settings = SETTINGS.model_copy(update={"iterations": 1})
    refine_textures(
        [MeshClip(start, torch.zeros(1, 4, 3))], driving, Satisfied(), settings, rng(),
        lambda done, total, values: losses.append(values["loss"]),
    )  # fmt: skip
    camera = [OrbitCamera(width=SIZE, height=SIZE)]
    covered = (shown([front_of(torch.zeros(32, 128, 3))], camera) == 0).all(-1, keepdim=True)
    difference = (shown([start], camera) - driving.frames) * covered
    assert losses[0] == pytest.approx(float(difference.square().mean()), rel=1e-4)
    halves = torch.nn.functional.avg_pool2d(difference.movedim(-1, 1), 2)
    assert 0.9 * losses[0] < float(halves.square().mean()) <= losses[0]  # equal but for the outline


def test_black_texels_can_become_gray_within_the_papers_iterations() -> None:
    """Adam moves a logit by 0.2 per iteration: from 1/512 31 iterations to gray, from the public code's 1e-6 69."""
    assert -math.log(1 / 512 / (1 - 1 / 512)) / SETTINGS.lr == pytest.approx(31, abs=0.5)
    assert -math.log(1e-6) / SETTINGS.lr == pytest.approx(69, abs=0.5) and SETTINGS.iterations == 50
    black, gray = front_of(torch.zeros(32, 128, 3)), front_of(torch.full((32, 128, 3), 0.5))
    (refined,) = refine_textures(
        [MeshClip(black, torch.zeros(1, 4, 3))], driving_of([gray]), Satisfied(), SETTINGS, rng()
    )
    assert (refined.texture[4:28, 4:28] - 0.5).abs().max() < 0.1  # from 1e-6 it would be 0.48
    settings = SETTINGS.model_copy(update={"iterations": 1})
    (begun,) = refine_textures(
        [MeshClip(black, torch.zeros(1, 4, 3))], driving_of([gray]), Satisfied(), settings, rng()
    )
    step = begun.texture[8:24, 8:24].logit() - torch.tensor(1 / 512).logit()
    assert (step > 0.1).all() and (step < SETTINGS.lr + 1e-4).all()  # Adam's epsilon takes a part of small gradients


@pytest.mark.parametrize(("is_tracked", "frame_size"), [(False, 0), (True, 0), (True, 64)])
def test_longer_videos_change_textures_as_far(
    is_tracked: bool, frame_size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Texels have more pixels here than at full size, so the epsilon of Adam is larger as well."""
    monkeypatch.setattr(refine, "ADAM_EPS", 256e-8)
    start, truth = box(painted()), box(painted(0.5))
    settings = SETTINGS.model_copy(
        update={"iterations": 8, "refresh_every": 8, "azimuth_step_deg": 0.0, "frame_size": frame_size}
        | {"min_cosine": 1.0, "frame_weight": 0.0}  # without the input view, and the pull of residuals towards zero
    )
    textures = []
    for frames in (2, 5):
        meshes = [truth] * frames
        lengths = [frames] if is_tracked else [1] * frames
        clips = [MeshClip(start, torch.zeros(length, 16, 3)) for length in lengths]
        refined = refine_textures(clips, driving_of(meshes), Oracle(meshes), settings, rng())[0]
        textures.append(refined.texture if refined.frame_textures is None else refined.frame_textures[0])
    assert error(textures[0], painted()) > 0.005
    torch.testing.assert_close(*textures, rtol=0, atol=1e-4)


def test_another_number_of_frames_is_refused() -> None:
    meshes = [box(painted())] * 2
    with pytest.raises(BadInput, match="3 frames and the driving video has 2"):
        refine_textures(tracked(painted()), driving_of(meshes), Satisfied(), SETTINGS, rng())


def test_a_refiner_that_breaks_is_noticed() -> None:
    class Broken:
        def refine(
            self, video: Tensor, cameras: Sequence[OrbitCamera], progress: float, generator: torch.Generator
        ) -> Tensor:
            return torch.full_like(video, math.nan)

    meshes = [moved(box(painted()), frame) for frame in range(FRAMES)]
    with pytest.raises(FitDiverged, match="iteration 0"):
        refine_textures(tracked(painted()), driving_of(meshes), Broken(), SETTINGS, rng())
