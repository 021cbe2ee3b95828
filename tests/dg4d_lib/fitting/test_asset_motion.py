"""Motion of users' models: recovers bends that the video shows, keeps lengths, and leaves depth alone."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting import asset_motion, flow_tracking, rigidity
from dg4d_lib.fitting.asset_fit import AssetFit, antialiased
from dg4d_lib.fitting.asset_motion import Report, fit_asset_motion, iterations
from dg4d_lib.fitting.flow_tracking import FlowTracker
from dg4d_lib.fitting.node_motion import NodeMotion
from dg4d_lib.fitting.node_pose import Pose
from dg4d_lib.fitting.rigid_parts import RigidMotion
from dg4d_lib.fitting.surface_tracking import DESCENT
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.models.control_graph import ControlGraph, build_control_graph
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.surface_cloud import SurfaceCloud, cover_surface
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo

FRAMES, ANGLE = 4, 0.35  # radians at the last frame
SETTINGS = AssetSettings(
    points=700, fit_points=700, nodes=16, size=48, track_iterations=3, joint_iterations=10, rigidity_loss="l1"
)


def arm() -> Model:
    """Return a long box along y in short pieces, striped, so that places along it can be told apart."""
    y, angle = np.meshgrid(np.linspace(-0.5, 0.5, 21), np.arange(8) * np.pi / 4, indexing="ij")
    vertices = np.stack([0.1 * np.cos(angle), y, 0.1 * np.sin(angle)], -1).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(20), np.arange(8), indexing="ij")
    a, b = (row * 8 + column).ravel(), (row * 8 + (column + 1) % 8).ravel()
    faces = np.concatenate([np.stack([a, a + 8, b], 1), np.stack([b, a + 8, b + 8], 1)])
    colors = np.stack([vertices[:, 1] > 0, np.sin(20 * vertices[:, 1]) > 0, vertices[:, 0] > 0], 1).astype(float)
    return Model((ModelPart("arm", vertices.astype(np.float32), faces, colors=colors),))


def bent(points: np.ndarray, angle: float) -> np.ndarray:
    """Turn what is above the middle about z, smoothly."""
    turn = angle * np.clip(points[:, 1] / 0.2, 0, 1)
    c, s, up = np.cos(turn), np.sin(turn), np.maximum(points[:, 1], 0)
    x = c * points[:, 0] - s * up
    y = np.where(points[:, 1] > 0, s * points[:, 0] + c * up, points[:, 1])
    return np.stack([x, y, points[:, 2]], 1)


def opened(points: np.ndarray, angle: float) -> np.ndarray:
    """Turn what is above the middle about x, as the lid of a box."""
    c, s, upper = np.cos(angle), np.sin(angle), points[:, 1] > 0
    y = np.where(upper, c * points[:, 1] - s * points[:, 2], points[:, 1])
    return np.stack([points[:, 0], y, np.where(upper, s * points[:, 1] + c * points[:, 2], points[:, 2])], 1)


@pytest.fixture(scope="module")
def scene() -> tuple[SurfaceCloud, ControlGraph, DrivingVideo]:
    surface = cover_surface(arm(), SETTINGS.points, torch.Generator().manual_seed(0))
    graph = build_control_graph(surface.fine.vertices, surface.fine.faces, SETTINGS.nodes)
    bends = [bent(arm().parts[0].vertices, ANGLE * frame / (FRAMES - 1)) for frame in range(FRAMES)]
    return surface, graph, video_of(bends)


def video_of(moments: Sequence[np.ndarray]) -> DrivingVideo:
    """Film the arm with its vertices at every moment."""
    pictures = []
    for vertices in moments:
        part = arm().parts[0]
        model = Model((ModelPart("arm", vertices.astype(np.float32), part.faces, colors=part.colors),))
        cloud = cover_surface(model, 3000, torch.Generator().manual_seed(1)).cloud
        drawn = get_rasterizer("cpu")(cloud, [OrbitCamera(width=96, height=96)], torch.zeros(3))
        color, alpha = drawn.color[0], drawn.alpha[0]
        pictures.append(torch.cat([color / alpha.clamp_min(1e-4), alpha], -1).clamp(0, 1))
    video = torch.stack(pictures)
    return DrivingVideo(video[..., :3], video[..., 3:], 5.0)


@pytest.fixture(scope="module")
def motion(scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo]) -> NodeMotion:
    surface, graph, video = scene
    bound = graph.of(surface.nearest)
    generator = torch.Generator().manual_seed(0)
    return fit_asset_motion(surface.cloud, bound, video, get_rasterizer("cpu"), SETTINGS, generator)


def moved(scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], motion: NodeMotion) -> np.ndarray:
    surface, graph, _ = scene
    return motion.points(torch.from_numpy(surface.fine.vertices).float(), graph).numpy()


def test_a_bend_is_recovered(scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], motion: NodeMotion) -> None:
    rest = scene[0].fine.vertices
    truth = bent(rest, ANGLE)
    ours = moved(scene, motion)[-1]
    error, still = (np.sqrt(np.square(one - truth).sum(1).mean()) for one in (ours, rest))
    assert error < 0.5 * still  # 48 pixels and few iterations; a frozen model has 1


def test_edges_keep_their_lengths(scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], motion: NodeMotion) -> None:
    fine = scene[0].fine
    ends = fine.faces[:, :2]

    def lengths(points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)

    ratio = lengths(moved(scene, motion)[-1]) / lengths(fine.vertices)
    assert np.abs(np.median(ratio) - 1) < 0.05
    assert np.percentile(np.abs(ratio - 1), 90) < 0.25


def test_nothing_drifts_in_depth(scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], motion: NodeMotion) -> None:
    depth = moved(scene, motion)[..., 2] - scene[0].fine.vertices[:, 2]
    assert np.abs(depth.mean(1)).max() < 0.02


def follow(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], video: DrivingVideo, settings: AssetSettings = SETTINGS
) -> np.ndarray:
    """Return the vertices of the arm as it follows a video."""
    surface, graph, _ = scene
    bound, generator = graph.of(surface.nearest), torch.Generator().manual_seed(0)
    return moved(scene, fit_asset_motion(surface.cloud, bound, video, get_rasterizer("cpu"), settings, generator))


def test_an_arm_that_swings_is_followed_where_rotations_are_integrated(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo],
) -> None:
    surface = scene[0]
    graph = build_control_graph(surface.fine.vertices, surface.fine.faces, 40)
    angles = [0.0, 0.7, 1.4, 0.7, 0.0, 0.7, 1.4]  # to and fro
    video = video_of([bent(arm().parts[0].vertices, angle) for angle in angles])
    truth = np.stack([bent(surface.fine.vertices, angle) for angle in angles])
    settings = DESCENT.model_copy(
        update={"size": 48, "track_iterations": 25, "joint_iterations": 20, "fit_points": 700, "smoothing": 0.5}
    )
    errors = []
    for integrated in (False, True):
        one = settings.model_copy(update={"integrate_rotations": integrated})
        found = follow((surface, graph, video), video, one)
        errors.append(np.linalg.norm(found - truth, axis=-1).mean(1))
    along_shifts, along_rotations = errors
    assert along_rotations[-1] < 0.6 * along_shifts[-1]  # 0.036 and 0.084: what shrinks on the way does not come back
    assert along_rotations.mean() < 0.8 * along_shifts.mean()


@pytest.mark.parametrize("joint_iterations", [0, 60])
def test_a_motion_of_the_whole_in_depth_is_found(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], joint_iterations: int
) -> None:
    truth = -0.1 * np.arange(FRAMES)
    video = video_of([arm().parts[0].vertices + np.array([0, 0, depth]) for depth in truth])
    settings = SETTINGS.model_copy(update={"joint_iterations": joint_iterations, "rigid_parts": 0})
    depth = (follow(scene, video, settings) - scene[0].fine.vertices)[..., 2].mean(1)
    np.testing.assert_allclose(depth[1:] / truth[1:], 0.8, atol=0.1)


def test_a_rigid_whole_is_found_in_depth_by_its_size(scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo]) -> None:
    truth = -0.1 * np.arange(FRAMES)
    video = video_of([arm().parts[0].vertices + np.array([0, 0, depth]) for depth in truth])
    depth = (follow(scene, video) - scene[0].fine.vertices)[..., 2].mean(1)
    np.testing.assert_allclose(depth[1:] / truth[1:], 1, atol=0.1)


def test_rigid_parts_that_show_the_video_worse_are_left(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], monkeypatch: pytest.MonkeyPatch
) -> None:
    video = video_of([arm().parts[0].vertices + np.array([0, 0, depth]) for depth in (0.0, -0.1, -0.2, -0.3)])
    free = follow(scene, video, SETTINGS.model_copy(update={"rigid_parts": 0}))
    tried = []

    def misled(fit: AssetFit, start: RigidMotion, report: Report) -> RigidMotion:
        tried.append(len(start.centers))
        return start.changed(torch.full((*start.places.shape[:2], 6), 0.1))

    monkeypatch.setattr(asset_motion, "fit_rigid_motion", misled)
    np.testing.assert_array_equal(follow(scene, video), free)
    assert tried == [1]


def test_what_the_first_frame_lacks_of_the_model_is_no_motion(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo],
) -> None:
    """As where a texture has holes or splats are wide: smaller outlines would draw the model away from the camera."""
    video = video_of([arm().parts[0].vertices * np.array([0.8, 1, 0.8])] * FRAMES)
    assert np.linalg.norm(follow(scene, video) - scene[0].fine.vertices, axis=-1).max() < 0.02


@pytest.mark.parametrize("rigid_parts", [0, 4])
def test_a_first_frame_at_rest_stays_exactly_so(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], rigid_parts: int
) -> None:
    rest = arm().parts[0].vertices
    video = video_of([opened(rest, angle) for angle in (0.0, 0.3, 0.6, 0.9)])
    found = follow(scene, video, SETTINGS.model_copy(update={"rigid_parts": rigid_parts}))
    np.testing.assert_allclose(found[0], scene[0].fine.vertices, atol=1e-6)
    assert np.linalg.norm(found[-1] - found[0], axis=-1).max() > 0.1


def test_a_first_frame_in_another_pose_is_followed(scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo]) -> None:
    rest = scene[0].fine.vertices
    truth = bent(rest, 2 * ANGLE)
    video = video_of([bent(arm().parts[0].vertices, 2 * ANGLE)] * 2)
    error, still = (np.linalg.norm(one - truth, axis=1).mean() for one in (follow(scene, video)[0], rest))
    assert error < 0.5 * still


def test_a_fit_is_repeatable(scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo]) -> None:
    surface, graph, video = scene
    quick = SETTINGS.model_copy(update={"track_iterations": 1, "joint_iterations": 1})
    bound, rasterize = graph.of(surface.nearest), get_rasterizer("cpu")
    threads = torch.get_num_threads()
    torch.set_num_threads(2)  # which may add gradients in any order
    try:
        runs = [
            fit_asset_motion(surface.cloud, bound, video, rasterize, quick, torch.Generator().manual_seed(0))
            for _ in range(3)
        ]
    finally:
        torch.set_num_threads(threads)
    for name, value in vars(runs[0]).items():
        assert all(torch.equal(value, getattr(other, name)) for other in runs[1:])


def test_small_gaussians_cover_as_much_as_without_the_filter() -> None:
    size, sigma = 64, 0.001  # far smaller than a pixel
    camera = OrbitCamera(width=size, height=size)
    one = Gaussians(
        torch.zeros(1, 3),
        torch.full((1, 3), sigma).log(),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([4.0]),
        torch.zeros(1, 1, 3),
    )
    pixels = sigma * camera.focal / camera.radius
    clear = antialiased(one, camera)
    expected = one.opacities * pixels**2 / (pixels**2 + 0.3)
    torch.testing.assert_close(clear.opacities, expected.clamp(min=1e-3))


def test_colors_of_the_video_are_taken_over(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], motion: NodeMotion
) -> None:
    """A model in other light than the video moves alike."""
    surface, graph, video = scene
    dim = replace(surface.cloud, harmonics=0.5 * surface.cloud.harmonics)
    bound, generator = graph.of(surface.nearest), torch.Generator().manual_seed(0)
    other = fit_asset_motion(dim, bound, video, get_rasterizer("cpu"), SETTINGS, generator)
    rest = scene[0].fine.vertices
    still = np.linalg.norm(moved(scene, motion)[-1] - rest, axis=1).mean()
    assert np.linalg.norm(moved(scene, other)[-1] - moved(scene, motion)[-1], axis=1).mean() < 0.1 * still


def test_loops_are_tracked_from_both_ends(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], monkeypatch: pytest.MonkeyPatch
) -> None:
    surface, graph, video = scene
    there_and_back = [0, 1, 2, 3, 2, 1]
    loop = DrivingVideo(video.frames[there_and_back], video.alpha[there_and_back], 5.0)
    seen = []

    def track(self: FlowTracker, poses: Mapping[int, Pose], trail: Sequence[int], frame: int) -> Pose:
        seen.append((list(trail), frame))
        return poses[trail[-1]]

    monkeypatch.setattr(FlowTracker, "track", track)
    quick = SETTINGS.model_copy(update={"joint_iterations": 0})
    found = fit_asset_motion(
        surface.cloud, graph.of(surface.nearest), loop, get_rasterizer("cpu"), quick, torch.Generator()
    )
    assert seen == [([0], 1), ([0, 1], 2), ([0, 1, 2], 3), ([0], 5), ([0, 5], 4)]
    assert len(found.shifts) == len(there_and_back)


@pytest.mark.parametrize("log", [False, True])
def test_tracking_and_refinement_have_one_rigidity(log: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gauss-Newton steps solve least squares, reweighted by the derivative of the refinement's loss."""
    monkeypatch.setattr(rigidity, "ROBUST", flow_tracking.ROBUST)
    stretch = torch.logspace(-3, 0.5, 20, dtype=torch.float64)[:, None] * torch.tensor([0.6, 0.0, 0.8])
    stretch.requires_grad_()
    rigidity.robust(stretch, log).sum().backward()
    divisor = torch.from_numpy(flow_tracking._softened(stretch.detach().numpy(), log))
    torch.testing.assert_close(stretch.grad, stretch.detach() / divisor[:, None], rtol=0.07, atol=0)


def test_of_two_rigidities_the_one_that_shows_the_video_better_is_kept(
    scene: tuple[SurfaceCloud, ControlGraph, DrivingVideo], monkeypatch: pytest.MonkeyPatch
) -> None:
    surface, graph, video = scene
    quick = SETTINGS.model_copy(update={"track_iterations": 1, "joint_iterations": 4, "rigid_parts": 0})
    shown = {}

    def fitted(rigidity_loss: str) -> NodeMotion:
        settings = quick.model_copy(update={"rigidity_loss": rigidity_loss})
        done = []
        motion = fit_asset_motion(
            surface.cloud,
            graph.of(surface.nearest),
            video,
            get_rasterizer("cpu"),
            settings,
            torch.Generator().manual_seed(0),
            lambda count, values: done.append(count),
        )
        assert done == sorted(done)
        assert done[-1] == iterations(settings, FRAMES)
        return motion

    original = AssetFit.difference

    def difference(fit: AssetFit, motion: NodeMotion) -> float:
        shown[fit.settings.rigidity_loss] = original(fit, motion)
        return -shown[fit.settings.rigidity_loss] if reverse else shown[fit.settings.rigidity_loss]

    monkeypatch.setattr(AssetFit, "difference", difference)
    reverse = False
    better = fitted("best")
    reverse = True
    worse = fitted("best")
    assert shown["l1"] != shown["log"]
    names = sorted(shown, key=lambda name: shown[name])
    assert not torch.equal(better.shifts, worse.shifts)
    reverse = False
    torch.testing.assert_close(fitted("l1").shifts, (better if names[0] == "l1" else worse).shifts)
