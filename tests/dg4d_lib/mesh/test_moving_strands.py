"""Strands of a moving mesh: lines of a video that a tracked ball lacks, and lines that are none."""

import numpy as np
import torch
import trimesh
from skimage.draw import line

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.folds import genus, self_intersecting
from dg4d_lib.mesh.tracking.moving_strands import find_strands_again, grow_moving_strands
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SIZE, FRAMES = 256, 4
FINE = OrbitCamera(width=4 * SIZE, height=4 * SIZE)
ROOT, LENGTH = (165.0, 95.0), 70.0  # row and column within the ball at rest, and pixels from there

Moving = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def alpha_of(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Return the alpha of a mesh at the input view, with soft edges."""
    covered = (rasterize_mesh(vertices, faces, [FINE]).faces >= 0).float()
    return torch.nn.functional.avg_pool2d(covered[None], 4)[0, 0]


def with_leg(alpha: torch.Tensor, across: float, turn_deg: float) -> torch.Tensor:
    """Return the alpha with a leg, two pixels wide, that points down and to the left at 0 degrees."""
    angle = np.radians(115 + turn_deg)
    top, left = ROOT[0], ROOT[1] + across
    rows, columns = line(
        round(top), round(left), round(top + LENGTH * np.sin(angle)), round(left + LENGTH * np.cos(angle))
    )
    drawn = alpha.clone()
    drawn[rows, columns] = drawn[rows, columns + 1] = 1
    return drawn


def walking_ball(legs: tuple[int, ...]) -> Moving:
    """A ball that moves to the right, with a leg that swings in some of the frames: mesh, offsets, faces and alpha."""
    mesh = trimesh.creation.icosphere(4, 0.4)
    vertices = torch.from_numpy(mesh.vertices.astype(np.float32))
    faces = torch.from_numpy(mesh.faces.astype(np.int32))
    offsets = torch.zeros(FRAMES, *vertices.shape)
    offsets[..., 0] = 0.03 * torch.arange(FRAMES)[:, None]
    pixels = 0.03 * OrbitCamera(width=SIZE, height=SIZE).focal / 2
    alpha = torch.stack([alpha_of(vertices + offset, faces) for offset in offsets])
    for frame in legs:
        alpha[frame] = with_leg(alpha[frame], pixels * frame, 12.0 * frame)
    return vertices, offsets, faces, alpha


def shares(vertices: torch.Tensor, offsets: torch.Tensor, faces: torch.Tensor, alpha: torch.Tensor) -> list[float]:
    """Return the share of the pixels of the leg that the mesh covers, by frame."""
    ball = trimesh.creation.icosphere(4, 0.4)
    body = torch.from_numpy(ball.vertices.astype(np.float32)), torch.from_numpy(ball.faces.astype(np.int32))
    covered = []
    for frame, offset in enumerate(offsets):
        shift = torch.tensor([0.03 * frame, 0, 0])
        leg = (alpha[frame] > 0.5) & (alpha_of(body[0] + shift, body[1]) < 0.5)
        covered.append(float((leg & (alpha_of(vertices + offset, faces) > 0.5)).sum() / leg.sum()))
    return covered


def test_a_swinging_leg_is_followed() -> None:
    vertices, offsets, faces, alpha = walking_ball((0, 1, 2, 3))
    grown, moved, corners, tubes = grow_moving_strands(vertices, offsets, faces, alpha, 0)
    assert len(tubes) == 1 and min(shares(grown, moved, corners, alpha)) > 0.7
    assert genus(corners.numpy()) == 0 and trimesh.Trimesh(grown, corners, process=False).is_watertight
    body = np.arange(len(vertices)) != tubes[0].tip
    assert torch.equal(grown[: len(vertices)][body], vertices[body])
    assert torch.allclose(moved[:, : len(vertices)][:, body], offsets[:, body], atol=1e-6)
    rods = (grown + moved)[:, tubes[0].rings.ravel()]
    assert float(rods[..., 2].std(1).max()) < 0.05  # parallel to the picture


def test_a_leg_slopes_towards_the_camera_or_away_to_pass_a_plate() -> None:
    vertices, offsets, faces, alpha = walking_ball((0, 1, 2, 3))
    grown, moved, corners, tubes = grow_moving_strands(vertices, offsets, faces, alpha, 0)
    middle = grown[tubes[0].rings].mean(1).numpy()
    place, along = middle[2 * len(middle) // 3], middle[-1] - middle[0]
    ray = OrbitCamera().position().numpy() - place
    axes = np.linalg.qr(np.stack([ray, along], 1), "complete")[0]  # along the ray, along the strand, across both
    plate = trimesh.creation.box((0.16, 0.008, 0.4)).subdivide().subdivide().subdivide()
    plate.apply_transform(np.block([[axes, place[:, None]], [0, 0, 0, 1]]))
    together = torch.cat([grown, torch.from_numpy(plate.vertices.astype(np.float32))])
    carried = torch.cat([moved, moved[:, :1].expand(-1, len(plate.vertices), -1)], 1)
    every = torch.cat([corners, len(grown) + torch.from_numpy(plate.faces.astype(np.int32))])

    def crossing(offsets: torch.Tensor) -> list[int]:
        poses = (together + offsets).numpy()
        return [int(self_intersecting(pose, every.numpy())[len(corners) :].sum()) for pose in poses]

    found = find_strands_again(together, carried, every, tubes, alpha)
    assert sum(crossing(carried)) > 20 and sum(crossing(found)) == 0
    assert min(shares(together, found, every, alpha)) > 0.7


def test_where_a_leg_is_hidden_it_goes_on_between_its_neighbors() -> None:
    vertices, offsets, faces, alpha = walking_ball((0, 2, 3))
    shown = walking_ball((0, 1, 2, 3))[-1]
    grown, moved, corners, tubes = grow_moving_strands(vertices, offsets, faces, alpha, 0)
    assert len(tubes) == 1 and shares(grown, moved, corners, shown)[1] > 0.3


def test_a_line_in_one_frame_is_no_strand() -> None:
    vertices, offsets, faces, alpha = walking_ball((2,))
    grown, moved, corners, tubes = grow_moving_strands(vertices, offsets, faces, alpha, 0)
    assert tubes == () and grown is vertices and moved is offsets and corners is faces


def test_strands_that_were_moved_away_are_found_again() -> None:
    vertices, offsets, faces, alpha = walking_ball((0, 1, 2, 3))
    grown, moved, corners, tubes = grow_moving_strands(vertices, offsets, faces, alpha, 0)
    (tube,) = tubes
    away = moved.clone()
    away[:, [*tube.rings.ravel(), tube.tip], 0] += 0.02
    assert max(shares(grown, away, corners, alpha)) < 0.4
    found = find_strands_again(grown, away, corners, tubes, alpha)
    assert min(shares(grown, found, corners, alpha)) > 0.7
