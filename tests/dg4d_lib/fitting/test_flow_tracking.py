"""Tracking by optical flow: known motions are recovered, far jumps are found, and what nobody shows stays."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.flow_tracking import FlowTracker, _Targets, across_weight
from dg4d_lib.fitting.node_pose import Pose
from dg4d_lib.fitting.part_search import find_parts
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.models.control_graph import graph_of_points, point_graph
from dg4d_lib.rasterizer.interface import get_rasterizer

SIZE = 64
SETTINGS = AssetSettings(size=SIZE, nodes=40, inertia=0.0, depth=0.0, whole_depth=0.0, rigidity_loss="l1")


def cloud_of(points: np.ndarray, colors: np.ndarray) -> Gaussians:
    count = len(points)
    return Gaussians(
        torch.from_numpy(points).float(),
        torch.full((count, 3), 0.03).log(),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous(),
        torch.full((count,), 4.0),
        torch.from_numpy((colors - 0.5) / 0.28209479)[:, None].float(),
    )


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Return a gray block and a small red ball beside it."""
    random = np.random.default_rng(0)
    block = random.uniform((-0.1, -0.5, -0.1), (0.3, 0.5, 0.1), (800, 3))
    ball = random.normal(size=(300, 3))
    ball *= 0.09 / np.linalg.norm(ball, axis=1, keepdims=True)
    gray = 0.4 + 0.2 * np.sin(12 * block[:, 1:2]) * np.ones(3)
    return np.concatenate([block, np.add(ball, (-0.35, -0.4, 0))]), np.concatenate(
        [gray, np.tile([0.9, 0.1, 0.1], (300, 1))]
    )


def tracker_of(moved: np.ndarray, settings: AssetSettings = SETTINGS, normal: np.ndarray | None = None) -> FlowTracker:
    """Return a tracker of the scene whose second frame shows moved points."""
    points, colors = scene()
    drawn = [
        get_rasterizer("cpu")(cloud_of(one, colors), [OrbitCamera(width=SIZE, height=SIZE)], torch.ones(3))
        for one in (points, moved)
    ]
    graph = graph_of_points(points, point_graph(points), settings.nodes)
    frames, alphas = (torch.cat([getattr(one, name) for one in drawn]) for name in ("color", "alpha"))
    return FlowTracker(cloud_of(points, colors), graph, frames, alphas, get_rasterizer("cpu"), settings, normal)


def test_gauss_newton_recovers_a_rigid_motion_from_exact_pixels() -> None:
    points, _ = scene()
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.2, 0.1], [0.2, 0.0, -0.15], [-0.1, 0.15, 0.0]])).numpy()
    truth = points @ turn.T + (0.05, -0.1, 0.02)
    tracker = tracker_of(points)
    targets = _Targets(np.arange(len(points)), tracker._projected(truth)[0], np.ones(len(points)))
    pose = rest = Pose.rest(len(tracker._nodes))
    for _ in range(15):
        pose = tracker._gauss_newton_step(pose, targets, rest, rest)
    found = tracker._points(pose, np.arange(len(points)))[0]
    assert np.abs(found - truth).max() < 1e-3  # in depth, too: perspective shows it
    np.testing.assert_allclose(pose.turns, np.tile(turn, (len(pose.turns), 1, 1)), atol=1e-3)


def test_a_part_that_jumps_farther_than_its_size_is_found() -> None:
    points, _ = scene()
    moved = points.copy()
    moved[800:, 1] += 0.4  # the ball is 0.18 wide
    tracker = tracker_of(moved)
    rest = Pose.rest(len(tracker._nodes))
    targets = tracker._patch_targets(rest, 1)
    steps = targets.pixels - tracker._projected(points[targets.rows])[0]
    expected = tracker._projected(moved[targets.rows])[0] - tracker._projected(points[targets.rows])[0]
    ball = (targets.rows >= 800) & (np.abs(points[targets.rows, 0] + 0.35) < 0.05)
    assert (
        np.abs(np.median(steps[ball], 0) - np.median(expected[ball], 0)).max() <= 2
    )  # pixels: half the size is searched
    assert targets.weights[ball].min() > 0.25
    after = tracker._points(tracker.track({0: rest}, [0], 1), np.arange(len(points)))[0]
    error = np.linalg.norm(after - moved, axis=1)
    assert "_parts" in vars(tracker)  # flow alone loses it
    assert np.median(error[800:]) < 0.2 and np.median(error[:800]) < 0.12  # of 0.4; the block hangs on it


def test_a_still_video_moves_nothing() -> None:
    points, _ = scene()
    tracker = tracker_of(points)
    rest = Pose.rest(len(tracker._nodes))
    after = tracker._points(tracker.track({0: rest}, [0], 1), np.arange(len(points)))[0]
    assert np.abs(after - points).max() < 0.01
    assert "_parts" not in vars(tracker)  # a search takes seconds, and nothing is lost


def test_splats_at_one_place_are_tracked() -> None:
    points, colors = scene()
    twice = np.concatenate([points[::50], points[::50]])
    cloud = cloud_of(twice, np.concatenate([colors[::50], colors[::50]]))
    camera = OrbitCamera(width=SIZE, height=SIZE)
    drawn = get_rasterizer("cpu")(cloud, [camera, camera], torch.ones(3))
    graph = graph_of_points(twice, point_graph(twice), len(twice))
    tracker = FlowTracker(cloud, graph, drawn.color, drawn.alpha, get_rasterizer("cpu"), SETTINGS)
    rest = Pose.rest(len(graph.nodes))
    assert np.isfinite(tracker.track({0: rest}, [0], 1).shifts).all()
    assert find_parts(graph)


def test_the_dense_system_of_the_most_nodes_fits_into_memory() -> None:
    most = AssetSettings.model_json_schema()["properties"]["nodes"]["maximum"]
    assert (6 * most) ** 2 * np.dtype(np.float64).itemsize <= 300e6


def test_depth_is_not_extrapolated() -> None:
    points, _ = scene()
    tracker = tracker_of(points, SETTINGS.model_copy(update={"inertia": 1.0}))
    rest = Pose.rest(len(tracker._nodes))
    expected = replace(rest, shifts=np.add(rest.shifts, (0.1, 0, 0.1)))
    nothing = _Targets(np.arange(0), np.zeros((0, 2)), np.zeros(0))
    pose = rest
    for _ in range(5):
        pose = tracker._gauss_newton_step(pose, nothing, expected, rest)
    np.testing.assert_allclose(pose.shifts.mean(0), (0.1 / 1.15, 0, 0), atol=1e-4)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_mirror_plane_tells_depth(side: float) -> None:
    points, _ = scene()
    for normal, depth in ((None, 0.0), (np.array([1.0, 0, -side]) / 2**0.5, 0.08 * side)):
        tracker = tracker_of(points, SETTINGS.model_copy(update={"across": 10.0}), normal)
        pixels, _, slope = tracker._projected(points)
        targets = _Targets(np.arange(len(points)), pixels + slope @ (0.08, 0.05, 0), np.ones(len(points)))
        pose = rest = Pose.rest(len(tracker._nodes))
        for _ in range(8):
            pose = tracker._gauss_newton_step(pose, targets, rest, rest)
        np.testing.assert_allclose(pose.shifts.mean(0), (0.08, 0.05, depth), atol=0.02)


def test_poses_continue_at_half_their_speed() -> None:
    angle = torch.tensor([[0.0, -0.4, 0], [0.4, 0, 0], [0, 0, 0]])
    pair = [torch.linalg.matrix_exp(scale * angle).double().numpy()[None] for scale in (1.0, 1.5)]
    rest = Pose.rest(1)
    found = rest.continued(Pose(pair[0], np.array([[0.2, 0, 0]])))
    np.testing.assert_allclose(found.turns, pair[1], atol=1e-4)
    np.testing.assert_allclose(found.shifts, [[0.3, 0, 0]])


def test_a_mirror_plane_that_is_seen_edge_on_tells_nothing() -> None:
    angles = np.deg2rad([0, 60, 75, 90])
    weights = [across_weight(SETTINGS, np.array([np.sin(angle), 0, np.cos(angle)])) for angle in angles]
    assert weights[:2] == pytest.approx([SETTINGS.across] * 2)
    assert weights[2] == pytest.approx(SETTINGS.across * (np.cos(angles[2]) / 0.5) ** 2)
    assert weights[3] == pytest.approx(0, abs=1e-9)
