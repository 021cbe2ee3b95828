"""Lids on hinges: where a hinge may be, what it moves, and a box that opens, found from its video."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.fitting.asset_fit import antialiased
from dg4d_lib.fitting.hinge import Cut, Hinge, smoothest
from dg4d_lib.fitting.hinge_tracking import Hinged, _tears, track_hinge
from dg4d_lib.fitting.rigid_parts import RigidMotion, of_one_part, two_rigid_parts
from dg4d_lib.fitting.surface_tracking import DESCENT, bind_vertices
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.surface_cloud import cover_surface
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo

SETTINGS = DESCENT.model_copy(update={"fit_points": 600, "nodes": 40, "size": 48})
EXTENTS, RIM = (0.7, 0.5, 0.5), 0.1  # of the box, and height of the cut between it and its lid
LAST = 1.8  # radians
CAMERA = OrbitCamera(width=48, height=48)
FRAMES = 7
LID = Cut(np.array([0.0, 1.0, 0.0]), RIM)
BACK = Hinge(torch.tensor([0.0, RIM, -EXTENTS[2] / 2]), torch.tensor([-1.0, 0, 0]))


def box() -> InflatedSurface:
    """Return a closed box in a turn of 30 degrees about the vertical axis through its hinge, striped."""
    mesh = trimesh.creation.box(EXTENTS).subdivide().subdivide().subdivide()
    vertices = torch.tensor(mesh.vertices, dtype=torch.float32)
    colors = 0.5 + 0.4 * torch.stack([(9 * vertices[:, axis]).sin() for axis in range(3)], 1)
    return InflatedSurface(vertices, torch.tensor(mesh.faces), colors, torch.ones(len(vertices), dtype=torch.bool))


def turned(points: torch.Tensor) -> torch.Tensor:
    """Turn points, so that no side of the box faces the camera."""
    c, s = math.cos(0.5), math.sin(0.5)
    return torch.stack([c * points[:, 0] + s * points[:, 2], points[:, 1], c * points[:, 2] - s * points[:, 0]], 1)


def opened(points: torch.Tensor, angle: float) -> torch.Tensor:
    """Return points of the box, those of its lid opened backwards."""
    y, z = points[:, 1] - RIM, points[:, 2] + EXTENTS[2] / 2
    c, s = math.cos(angle), math.sin(angle)
    moved = torch.stack([points[:, 0], RIM + c * y + s * z, c * z - s * y - EXTENTS[2] / 2], 1)
    return torch.where(LID.above(points)[:, None], moved, points)


def splats(surface: InflatedSurface) -> Gaussians:
    part = ModelPart("box", surface.vertices.numpy(), surface.faces.numpy(), colors=surface.colors.numpy())
    return cover_surface(Model((part,)), 600, torch.Generator().manual_seed(0)).cloud


def film(cloud: Gaussians, moments: Sequence[torch.Tensor]) -> DrivingVideo:
    """Film Gaussians at every moment."""
    states = [replace(antialiased(cloud, CAMERA), means=one) for one in moments]
    drawn = [get_rasterizer("cpu")(state, [CAMERA], torch.ones(3)) for state in states]
    return DrivingVideo(torch.cat([one.color for one in drawn]), torch.cat([one.alpha for one in drawn]), 8.0)


def followed(share: float, angles: Sequence[float]) -> tuple[Hinged | None, list[torch.Tensor]]:
    """Track a box that opens, after a free motion in which its lid opens by a share of it; return the truth, too."""
    surface, steps = box(), list[int]()
    rest = replace(surface, vertices=turned(surface.vertices))
    free = [replace(rest, vertices=turned(opened(surface.vertices, share * angle))) for angle in angles]
    cloud = splats(surface)
    video = film(splats(rest), [turned(opened(cloud.means, angle)) for angle in angles])
    rasterize = get_rasterizer("cpu")
    found = track_hinge(free, splats(rest), video, rasterize, SETTINGS, lambda done, _: steps.append(done))
    assert steps == sorted(set(steps))
    return found, [turned(opened(surface.vertices, angle)) for angle in angles]


def test_a_box_that_opens_is_followed_by_its_hinge() -> None:
    found, truth = followed(0.4, [LAST * frame / (FRAMES - 1) for frame in range(FRAMES)])
    assert found is not None
    lid = LID.above(box().vertices)
    error, still = ((one - truth[-1])[lid].norm(dim=1).mean() for one in (found.surfaces[-1].vertices, truth[0]))
    assert error < 0.2 * still
    assert (found.surfaces[-1].vertices - truth[-1])[~lid].norm(dim=1).mean() < 0.08  # its distance is nearly free
    torch.testing.assert_close(found.surfaces[0].vertices, truth[0])
    cloud = splats(replace(box(), vertices=truth[0]))
    field = Framewise(FRAMES, len(cloud))
    with torch.no_grad():
        carried = found.carrying(field, cloud).displace(cloud.means, torch.ones(1)).apply(cloud).means[0]
    # Gaussians lie on the surface, so they stay there; vertices are 0.09 apart
    assert float(torch.cdist(carried, found.surfaces[-1].vertices).amin(1).max()) < 0.08


def test_a_box_that_stays_closed_has_no_hinge() -> None:
    found, _ = followed(1.0, [0.0, 0.02, 0.0])
    assert found is None


def test_what_no_two_parts_show_has_no_hinge() -> None:
    surface = replace(box(), vertices=turned(box().vertices))

    def waved(points: torch.Tensor, size: float) -> torch.Tensor:
        return points + size * (12 * points[:, 1:2]).sin() * torch.tensor([1.0, 0, 0])

    sizes, cloud = (0.0, 0.1, 0.2), splats(surface)
    states = [replace(surface, vertices=waved(surface.vertices, size)) for size in sizes]
    video = film(cloud, [waved(cloud.means, size) for size in sizes])
    assert track_hinge(states, cloud, video, get_rasterizer("cpu"), SETTINGS) is None


@pytest.mark.parametrize(
    ("across", "beside", "expected"), [(1.3, 1.0, False), (1.6, 1.0, True), (0.6, 1.0, True), (1.0, 2.0, False)]
)
def test_only_edges_across_the_cut_that_change_by_half_tear(across: float, beside: float, expected: bool) -> None:
    def column(lower: float, middle: float) -> torch.Tensor:
        heights = torch.tensor([0.0, lower, lower + middle, lower + middle + 0.1])
        return torch.stack([torch.zeros(4), heights, torch.zeros(4)], 1)

    nodes = torch.stack([column(0.1, 0.1), column(0.1, 0.1), column(0.1 * beside, 0.1 * across)])
    edges = torch.tensor([[0, 1], [1, 2], [2, 3]])
    assert _tears(nodes, edges, torch.tensor([False, False, True, True])) is expected
    assert not _tears(nodes, edges, torch.tensor([False] * 4))


def test_hinges_are_the_sides_of_the_rim_and_open_upwards() -> None:
    surface = box()
    hinges = LID.hinges(surface.vertices, surface.faces)
    middles = sorted(tuple(round(x, 3) + 0.0 for x in hinge.point.tolist()) for hinge in hinges)
    x, z = EXTENTS[0] / 2, EXTENTS[2] / 2
    assert middles == sorted([(-x, RIM, 0.0), (x, RIM, 0.0), (0.0, RIM, -z), (0.0, RIM, z)])
    top = torch.tensor([[0.0, EXTENTS[1] / 2, 0.0]])
    for hinge in hinges:
        parts, unturned = torch.tensor([0, 1]), torch.tensor([[[1.0, 0, 0, 0]] * 2])
        still = RigidMotion(parts, top.repeat(2, 1), unturned, top[None].repeat(1, 2, 1))
        assert float(hinge.opened(still, torch.tensor([0.1])).places[0, 1, 1]) > float(top[0, 1])
        assert sum(hinge.is_near(other) for other in hinges) == 1


def test_a_cut_beside_the_subject_has_no_hinge() -> None:
    assert Cut(np.array([0.0, 1.0, 0.0]), 5.0).hinges(box().vertices, box().faces) == []


def test_a_lid_moves_with_its_box_and_turns_about_the_hinge() -> None:
    angle, turn = torch.tensor([0.7]), torch.tensor([[[math.cos(0.4), 0.0, math.sin(0.4), 0.0]] * 2])
    centers = torch.tensor([[0.0, 0, 0], [0.0, 0.2, 0]])
    base = RigidMotion(torch.tensor([0, 1]), centers, turn, torch.tensor([[[0.1, 0.2, 0.3]] * 2]))
    moved = BACK.opened(base, angle)

    def at(point: torch.Tensor, part: int) -> np.ndarray:
        rotation = trimesh.transformations.quaternion_matrix(moved.quats[0, part].tolist())[:3, :3]
        return np.asarray(rotation @ (point - moved.centers[part]).numpy() + moved.places[0, part].numpy())

    for shift in (-0.3, 0.3):  # on the hinge, both parts agree
        place = BACK.point + shift * BACK.axis
        np.testing.assert_allclose(at(place, 0), at(place, 1), atol=1e-6)
    arm = BACK.point + torch.tensor([0.0, 0, 0.5])
    chord = np.linalg.norm(at(arm, 0) - at(arm, 1))
    assert chord == pytest.approx(2 * 0.5 * math.sin(0.35), abs=1e-6)
    assert BACK.distances(arm[None]).item() == pytest.approx(0.5)


def test_a_cut_is_found_from_parts_and_moves_as_it_is_told() -> None:
    nodes = torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    tilted = Cut(np.array([0.6, 0.8, 0.0]), 0.1)
    found = Cut.between(nodes, tilted.above(nodes).long())
    assert float(found.normal @ tilted.normal) > 0.97
    assert found.offset == pytest.approx(0.1, abs=0.03)
    assert LID.changed(0, 0.05, BACK.point).offset == pytest.approx(RIM + 0.05)
    for axis in (1, 2):
        other = LID.changed(axis, 0.2, BACK.point)
        assert math.acos(float(other.normal @ LID.normal)) == pytest.approx(math.atan(0.2))
        assert float(other.normal @ BACK.point.double().numpy()) == pytest.approx(other.offset)  # about the point


def test_angles_follow_small_errors_smoothly_from_closed() -> None:
    angles = np.array([0.0, 0.5, 1.0, 1.5])
    errors = np.ones((4, 5))
    for frame, step in enumerate((3, 0, 1, 2, 3)):  # the first frame is closed, whatever its error
        errors[step, frame] = 0.0
    loss, path = smoothest(errors, angles)
    assert path == [0, 0, 1, 2, 3]
    assert loss == pytest.approx(1.0 + 3 * 0.05 * 0.25)


def test_two_parts_are_those_that_move_apart_and_the_first_moves_less() -> None:
    surface = box()
    _, _, bound = bind_vertices(surface.vertices, surface.faces, SETTINGS)
    moved = torch.stack([opened(surface.vertices, 0.2 * frame) for frame in range(4)])
    found = two_rigid_parts(bound, moved)
    assert found is not None
    owners = found.parts[bound.indices.gather(1, bound.weights.argmax(1, keepdim=True))[:, 0]]
    agreement = (owners.bool() == LID.above(surface.vertices)).float().mean()
    assert agreement > 0.9
    alone = of_one_part(bound, found.parts, owners)
    rigid = found.of_nodes(bound).points(surface.vertices, alone)
    turns = torch.cdist(rigid[-1][owners == 1], rigid[-1][owners == 1])
    torch.testing.assert_close(turns, torch.cdist(*[surface.vertices[owners == 1]] * 2), atol=2e-3, rtol=0)
