"""Meshes that follow the video: legs that cross and touch on the way keep their surfaces."""

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting import guided_mesh
from dg4d_lib.fitting.guided_mesh import (
    follow_video,
    frames_with_long_outlines,
    rank_guided_references,
    register_tracking,
)
from dg4d_lib.fitting.surface_tracking import DESCENT
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface, select_level
from dg4d_lib.mesh.extraction.silhouettes import render_silhouettes, silhouette_iou
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import MeshSettings
from dg4d_lib.video.driving import DrivingVideo

FRAMES = 5
SWING_DEG = 20.0  # per frame; the legs cross in the middle
SETTINGS = MeshSettings(grid=32, max_faces=4000, edge_length=0.04)
FAST = DESCENT.model_copy(
    update={"fit_points": 400, "nodes": 24, "size": 48, "track_iterations": 20, "joint_iterations": 0}
)
IN_FRONT = np.array([0, 0, 0.06])
RASTERIZE = get_rasterizer("cpu")


def leg(angle_deg: float) -> np.ndarray:
    """Points on a capsule that hangs from a hip and is turned in the plane of the picture."""
    capsule = trimesh.creation.capsule(0.45, 0.07, count=[10, 10])
    points = trimesh.transform_points(capsule.vertices, trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    turn = trimesh.transformations.rotation_matrix(np.radians(angle_deg), [0, 0, 1])
    return trimesh.transform_points(points - np.array([0, 0.1, 0]), turn)


def scissors() -> Gaussians:
    """Two legs that swing past each other in parallel planes and exchange their Gaussians when they touch."""
    states = []
    for frame in range(FRAMES):
        angle = SWING_DEG * (frame - FRAMES // 2)
        states.append(np.concatenate([leg(angle) + IN_FRONT, leg(-angle) - IN_FRONT]))
    means = torch.from_numpy(np.stack(states).astype(np.float32))
    count = means.shape[1]
    half = count // 2
    means[FRAMES // 2 + 1 :] = torch.cat([means[FRAMES // 2 + 1 :, half:], means[FRAMES // 2 + 1 :, :half]], 1)
    along = torch.linspace(0, 1, half)[:, None].repeat(2, 1)
    colors = torch.cat([0.2 + 0.6 * along, 0.5 - 0.3 * along, 0.8 - 0.6 * along], 1)
    return Gaussians(
        means,
        torch.full((FRAMES, count, 3), -3.5),
        torch.tensor([[1.0, 0, 0, 0]]).expand(FRAMES, count, 4),
        torch.full((count,), 3.0),
        rgb_to_sh(colors),
    )


def video_of(states: Gaussians) -> DrivingVideo:
    camera = OrbitCamera(width=128, height=128)
    drawn = RASTERIZE(states, [camera] * FRAMES, torch.zeros(3))
    return DrivingVideo((drawn.color / drawn.alpha.clamp_min(1e-6)).clamp(0, 1), drawn.alpha, 8.0)


def test_frames_with_long_outlines_have_the_legs_apart() -> None:
    video = video_of(scissors())
    assert FRAMES // 2 not in frames_with_long_outlines(video, 2)
    assert frames_with_long_outlines(video, 99)[-1] == FRAMES // 2


def test_candidates_are_apart_in_time() -> None:
    alpha = torch.zeros(20, 32, 32, 1)
    alpha[:, 8:24, 8:24] = 1
    still = DrivingVideo(torch.zeros(20, 32, 32, 3), alpha, 8.0)
    chosen = frames_with_long_outlines(still, 3)
    assert min(abs(a - b) for a in chosen for b in chosen if a != b) > 2


def test_a_mesh_follows_legs_that_cross(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guided_mesh, "TRACKING", FAST)
    states = scissors()
    video = video_of(states)
    rest = states.at(0)
    field = density_field(rest, SETTINGS)
    level, _ = select_level(field, rest, RASTERIZE, 0.5)
    vertices, faces = map(torch.from_numpy, extract_surface(field, level))
    generator = torch.Generator().manual_seed(0)
    tracked = follow_video(vertices, faces, states, video, 0, RASTERIZE, generator)
    offsets = register_tracking(vertices, tracked, faces, states, video, 0, level, RASTERIZE, SETTINGS)
    silhouettes = render_silhouettes(states, range(FRAMES), RASTERIZE, video.alpha[..., 0])
    still = silhouette_iou(vertices.expand(FRAMES, -1, -1), faces, silhouettes)
    followed = silhouette_iou(vertices + offsets, faces, silhouettes)
    assert still[FRAMES // 2 :].min() < 0.75
    assert followed.min() > 0.8 and followed.mean() > 0.87


@pytest.mark.parametrize(
    ("away", "swinging_away", "ways", "kept"),
    [(0.0, 0.0, 1, 0.0), (0.1, 0.0, 2, 0.0), (0.1, 0.1, 2, 0.1), (0.1, 0.4, 2, 0.1)],
)
def test_a_mesh_that_loses_the_outline_is_tracked_with_limbs_that_swing(
    monkeypatch: pytest.MonkeyPatch, away: float, swinging_away: float, ways: int, kept: float
) -> None:
    ball = trimesh.creation.icosphere(3, 0.3)
    vertices, faces = torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces)
    points = vertices.expand(FRAMES, -1, -1)
    count = len(vertices)
    states = Gaussians(
        0.9 * points,  # splats are seen beyond their centers
        torch.full((FRAMES, count, 3), -4.0),
        torch.tensor([[1.0, 0, 0, 0]]).expand(FRAMES, count, 4),
        torch.full((count,), 3.0),
        torch.zeros(1, 1, 3).expand(count, 1, 3),
    )
    tracked: list[bool] = []

    def track(*arguments: object) -> torch.Tensor:
        settings = next(one for one in arguments if isinstance(one, AssetSettings))
        tracked.append(settings.integrate_rotations)
        return points + torch.tensor([swinging_away if settings.integrate_rotations else away, 0, 0])

    monkeypatch.setattr(guided_mesh, "track_vertices", track)
    offsets = follow_video(vertices, faces, states, video_of(states), 0, RASTERIZE, torch.Generator())
    assert tracked == [False, True][:ways]
    assert float(offsets[1, :, 0].mean()) == pytest.approx(kept, abs=1e-5)


@pytest.mark.parametrize(
    ("first", "second", "handles", "chosen"),
    [
        (0.95, 0.945, 0, 0),
        (0.95, 0.945, 1, 3),
        (0.96, 0.945, 1, 0),
    ],
)
def test_a_handle_outweighs_a_trial_that_is_a_little_better(
    monkeypatch: pytest.MonkeyPatch, first: float, second: float, handles: int, chosen: int
) -> None:
    overlaps = iter([first, second])
    monkeypatch.setattr(guided_mesh, "frames_with_long_outlines", lambda *_: [3])
    monkeypatch.setattr(guided_mesh, "track_vertices", lambda vertices, *_: vertices.repeat(FRAMES, 1, 1))
    monkeypatch.setattr(guided_mesh, "register_to_outlines", lambda vertices, offsets, *_: offsets)
    monkeypatch.setattr(guided_mesh, "silhouette_iou", lambda *_: torch.tensor([next(overlaps)]))
    states = scissors()
    generator = torch.Generator().manual_seed(0)
    ranked = rank_guided_references(
        states, video_of(states), RASTERIZE, SETTINGS, 0, generator, lambda frame: 0 if frame else handles
    )
    assert ranked[0] == (chosen, pytest.approx(second if chosen else first))


@pytest.mark.parametrize(("scores", "frames"), [((0.95, 0.93, 0.94), [0, 4]), ((0.95, 0.91, 0.90), [0])])
def test_ranked_frames_are_about_as_good_as_the_best(
    monkeypatch: pytest.MonkeyPatch, scores: tuple[float, ...], frames: list[int]
) -> None:
    overlaps = iter(scores)
    monkeypatch.setattr(guided_mesh, "frames_with_long_outlines", lambda *_: [2, 4])
    monkeypatch.setattr(guided_mesh, "track_vertices", lambda vertices, *_: vertices.repeat(FRAMES, 1, 1))
    monkeypatch.setattr(guided_mesh, "register_to_outlines", lambda vertices, offsets, *_: offsets)
    monkeypatch.setattr(guided_mesh, "silhouette_iou", lambda *_: torch.tensor([next(overlaps)]))
    states = scissors()
    ranked = rank_guided_references(
        states, video_of(states), RASTERIZE, SETTINGS, 0, torch.Generator().manual_seed(0)
    )  # fmt: skip
    assert [frame for frame, _ in ranked] == frames


@pytest.mark.slow
def test_the_chosen_frame_has_the_legs_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guided_mesh, "TRIAL", FAST.model_copy(update={"track_iterations": 5}))
    states = scissors()
    middle = FRAMES // 2
    (frame, followed), *_ = rank_guided_references(
        states, video_of(states), RASTERIZE, SETTINGS, middle, torch.Generator().manual_seed(0)
    )
    assert frame != middle
    assert 0.85 < followed < 1
