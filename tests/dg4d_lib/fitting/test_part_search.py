"""Search of parts: limbs are found in a graph, and a turned limb is put back; a pose that fits stays."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.node_pose import Pose
from dg4d_lib.fitting.part_search import LARGEST, SMALLEST, PartSearch, find_parts
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.mesh.models.control_graph import ControlGraph, graph_of_points, point_graph
from dg4d_lib.rasterizer.interface import Rendering, get_rasterizer

SIZE, NODES = 48, 40
SHOULDER = np.array([0.15, 0.2, 0.0])


def body_with_arm() -> tuple[np.ndarray, np.ndarray]:
    """Return points of a body and of an arm that sticks out of it, and which are the arm's."""
    random = np.random.default_rng(0)
    body = random.uniform((-0.15, -0.4, -0.1), (0.15, 0.3, 0.1), (350, 3))
    arm = random.uniform((0.15, 0.15, -0.05), (0.6, 0.25, 0.05), (150, 3))
    return np.concatenate([body, arm]), np.arange(500) >= 350


def cloud_of(points: np.ndarray) -> Gaussians:
    colors = np.stack(
        [0.5 + 0.4 * np.sin(9 * points[:, 0]), 0.5 + 0.4 * np.cos(9 * points[:, 1]), 0.3 + 0 * points[:, 2]]
    )
    scales = torch.full((len(points),), 0.04)
    return isotropic(torch.from_numpy(points).float(), scales, torch.from_numpy(colors.T).float(), 0.98)


def draw(points: np.ndarray, colored: np.ndarray) -> Rendering:
    """Draw moved points with the colors of the points at rest."""
    cloud = replace(cloud_of(colored), means=torch.from_numpy(points).float())
    return get_rasterizer("cpu")(cloud, [OrbitCamera(width=SIZE, height=SIZE)], torch.ones(3))


def search_of(turn: Rotation) -> tuple[PartSearch, ControlGraph, np.ndarray]:
    """Return a search over two frames, at rest and with a turned arm, its graph, and the arm's points there."""
    points, arm = body_with_arm()
    moved = points.copy()
    moved[arm] = turn.apply(points[arm] - SHOULDER) + SHOULDER
    drawn = [draw(one, points) for one in (points, moved)]
    pictures, alphas = (torch.cat([getattr(one, name) for one in drawn]) for name in ("color", "alpha"))
    graph = graph_of_points(points, point_graph(points), NODES)
    return PartSearch(cloud_of(points), graph, pictures, alphas, 1.0, get_rasterizer("cpu")), graph, moved


def moved_points(graph: ControlGraph, pose: Pose, points: np.ndarray) -> np.ndarray:
    nodes, weights = graph.nodes.double().numpy(), graph.weights.double().numpy()
    return pose.shares(points, nodes, graph.indices.numpy(), weights)[0].sum(1)


def test_an_arm_is_one_of_the_parts() -> None:
    points, _ = body_with_arm()
    graph = graph_of_points(points, point_graph(points), NODES)
    parts = find_parts(graph)
    truth = graph.nodes.numpy()[:, 0] > 0.15
    overlaps = [(part.nodes & truth).sum() / (part.nodes | truth).sum() for part in parts]
    best = parts[int(np.argmax(overlaps))]
    assert max(overlaps) > 0.8
    assert np.linalg.norm(graph.nodes.numpy()[best.joint].mean((0, 1)) - SHOULDER) < 0.15
    for part in parts:
        assert SMALLEST <= part.nodes.sum() <= LARGEST * len(part.nodes)
        assert (part.nodes[part.joint].sum(1) == 1).all()  # one end inside


def test_parts_do_not_depend_on_the_run() -> None:
    points, _ = body_with_arm()
    graph = graph_of_points(points, point_graph(points), NODES)
    first, second = find_parts(graph), find_parts(graph)
    assert [part.nodes.tolist() for part in first] == [part.nodes.tolist() for part in second]


@pytest.mark.parametrize("angle", [-70, 50])
def test_a_turned_arm_is_found(angle: int) -> None:
    points, arm = body_with_arm()
    search, graph, moved = search_of(Rotation.from_rotvec([0, 0, np.deg2rad(angle)]))
    found = moved_points(graph, search.best_pose(Pose.rest(len(graph.nodes)), 1), points)
    far = arm & (points[:, 0] > 0.4)
    before, after = (np.linalg.norm(one - moved, axis=1) for one in (points, found))
    assert before[far].mean() > 0.25 and after[far].mean() < 0.3 * before[far].mean()
    assert after[~arm].mean() < 0.05


def test_a_pose_that_fits_stays() -> None:
    search, graph, _ = search_of(Rotation.identity())
    rest = Pose.rest(len(graph.nodes))
    assert search.best_pose(rest, 0) is rest


@pytest.mark.parametrize(("nodes", "sizes"), [(4, []), (6, [3])])
def test_models_of_a_few_nodes_have_few_parts(nodes: int, sizes: list[int]) -> None:
    points, _ = body_with_arm()
    graph = graph_of_points(points, point_graph(points), nodes)
    assert [part.nodes.sum() for part in find_parts(graph)] == sizes  # from 3 nodes to 65 % of them


def test_no_part_spans_pieces_that_nothing_connects() -> None:
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    sides = np.array([[0, 1], [1, 2], [2, 3], [0, 3]])
    nodes, edges = np.concatenate([square, square + 5]), np.concatenate([sides, sides + 4])
    graph = ControlGraph(
        torch.from_numpy(nodes), torch.arange(8)[:, None], torch.ones(8, 1), torch.from_numpy(edges), torch.ones(8)
    )
    parts = find_parts(graph)
    assert parts
    for part in parts:
        assert part.nodes[:4].any() != part.nodes[4:].any()
