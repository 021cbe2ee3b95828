"""Parts that sink into each other: balls of known radius, an arm before a body, and a knob pushed into a ball."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.sparse import csr_array
from scipy.sparse.linalg import SuperLU
from skimage.measure import marching_cubes

from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.extraction.silhouettes import cameras_of
from dg4d_lib.mesh.folds import self_intersecting
from dg4d_lib.mesh.neighbors import screened_factors
from dg4d_lib.mesh.tracking import separation
from dg4d_lib.mesh.tracking.separation import cap, push_apart, separate
from dg4d_lib.mesh.tracking.submerged import InnerBalls, inner_balls
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

CELL, ORIGIN = 0.02, -0.6037  # no sample lies on a surface, which would make triangles without area
FRAMES = 9


def solid(*capsules: tuple[tuple[float, ...], tuple[float, ...], float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of the union of capsules (both ends and a radius)."""
    axes = [np.arange(ORIGIN, 0.6, CELL)] * 3
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    inside = np.full(points.shape[:3], -np.inf)
    for first, last, radius in capsules:
        a, along = np.asarray(first), np.subtract(last, first)
        share = ((points - a) @ along / max(along @ along, 1e-9)).clip(0, 1)
        inside = np.maximum(inside, radius - np.linalg.norm(points - a - share[..., None] * along, axis=-1))
    vertices, faces, _, _ = marching_cubes(inside, 0.0, spacing=(CELL,) * 3)
    return vertices + ORIGIN, faces[:, ::-1].astype(np.int32)


@pytest.fixture(scope="module")
def body_with_arm() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rest shape, faces, and frames in which the arm swings into the body, to the middle frame and back."""
    vertices, faces = solid(
        ((0, -0.3, 0), (0, 0.3, 0), 0.18),
        ((0, 0.33, 0), (0.36, 0.36, 0.02), 0.07),
        ((0.36, 0.36, 0.02), (0.36, -0.1, 0.1), 0.07),
    )
    bend = np.where(vertices[:, 0] > 0.25, ((0.34 - vertices[:, 1]) / 0.2).clip(0, 1), 0)
    angles = np.radians(35) * np.sin(np.pi * np.arange(FRAMES) / (FRAMES - 1))[:, None] * bend**2 * (3 - 2 * bend)
    x, y = vertices[:, 0] - 0.36, vertices[:, 1] - 0.36  # from the elbow
    turned = np.stack([np.cos(angles) * x + np.sin(angles) * y, np.cos(angles) * y - np.sin(angles) * x], 2)
    frames = np.concatenate([turned + 0.36, np.broadcast_to(vertices[:, 2:], (*angles.shape, 1))], 2)
    return vertices, faces, frames


def silhouettes_of(frames: np.ndarray, faces: np.ndarray) -> torch.Tensor:
    moved, triangles = torch.from_numpy(frames).float(), torch.from_numpy(faces)
    views = [rasterize_mesh(moved, triangles, cameras).faces >= 0 for cameras in cameras_of(len(frames))]
    return torch.stack(views, 1)


def crossings(frames: np.ndarray, faces: np.ndarray) -> list[int]:
    return [int(self_intersecting(frame, faces).sum()) for frame in frames]


def separated(
    rest: np.ndarray, faces: np.ndarray, frames: np.ndarray, silhouettes: torch.Tensor
) -> tuple[np.ndarray, int]:
    vertices = torch.from_numpy(rest).float()
    offsets = torch.from_numpy(frames).float() - vertices
    moved, count = separate(vertices, offsets, torch.from_numpy(faces), silhouettes)
    return (vertices + moved).double().numpy(), count


@pytest.mark.parametrize("radius", [0.1, 0.3])
def test_inner_balls_of_a_sphere_fill_it(radius: float) -> None:
    mesh = trimesh.creation.icosphere(4, radius)
    centers, radii = inner_balls(mesh.vertices, np.asarray(mesh.vertices) / radius)
    assert radii == pytest.approx(radius, rel=0.01)
    assert np.abs(centers).max() < 0.01 * radius


def test_inner_balls_hold_no_vertex_and_are_as_thick_as_the_part() -> None:
    vertices, faces = solid(((0, -0.3, 0), (0, 0.3, 0), 0.18), ((0, 0, 0), (0.45, 0, 0), 0.07))
    normals = vertex_normals(torch.from_numpy(vertices).float(), torch.from_numpy(faces)).double().numpy()
    centers, radii = inner_balls(vertices, normals)
    distances = np.linalg.norm(vertices[None, ::7] - centers[::7, None], axis=2).min(1)
    assert (distances > 0.8 * radii[::7]).all()
    on_arm = (vertices[:, 0] > 0.28) & (vertices[:, 0] < 0.42)
    assert np.median(radii[on_arm]) == pytest.approx(0.07, rel=0.1)
    assert np.median(radii[np.abs(vertices[:, 1]) > 0.15]) == pytest.approx(0.18, rel=0.1)


def test_an_arm_in_the_body_is_submerged_and_an_arm_beside_it_is_not(
    body_with_arm: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    rest, faces, frames = body_with_arm
    balls = InnerBalls(rest, faces)
    for moved, expected in ((frames[0], False), (frames[FRAMES // 2], True)):
        inside = balls.submerged(moved, balls.centers(moved), np.ones(len(faces), bool)).vertices
        assert bool(len(inside)) == expected
    arm = inside[rest[inside, 0] > 0.25]
    depths = 0.18 - np.linalg.norm(frames[FRAMES // 2][arm][:, [0, 2]], axis=1)  # below the side of the body
    assert len(arm) > 100 and depths.min() > -0.02


def test_centers_turn_with_the_surface(body_with_arm: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    rest, faces, _ = body_with_arm
    balls = InnerBalls(rest, faces)
    turn = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]
    expected = balls.centers(rest) @ turn.T + [0.1, 0, 0]
    assert balls.centers(rest @ turn.T + [0.1, 0, 0]) == pytest.approx(expected, abs=1e-6)


def test_an_arm_comes_out_of_the_body_along_the_rays_of_the_input_camera(
    body_with_arm: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    rest, faces, frames = body_with_arm
    before = crossings(frames, faces)
    assert before[0] == before[-1] == 0 and max(before) > 100
    result, count = separated(rest, faces, frames, silhouettes_of(frames, faces))
    assert count == sum(number > 0 for number in before)
    assert max(crossings(result, faces)) == 0
    hand = (rest[:, 0] > 0.3) & (rest[:, 1] < 0.1)
    shift = (result - frames)[FRAMES // 2][hand].mean(0)
    assert shift[2] > 0.05 and np.abs(shift[:2]).max() < 0.4 * shift[2]  # the hand was before the axis of the body
    before_it = rasterize_mesh(torch.from_numpy(result).float(), torch.from_numpy(faces), cameras_of(FRAMES)[0])
    shown = np.unique(faces[before_it.faces[FRAMES // 2].numpy()[before_it.faces[FRAMES // 2].numpy() >= 0]])
    assert hand[shown].sum() > 0.3 * hand.sum()  # and now covers it
    kept = silhouettes_of(result, faces)[:, 0] == silhouettes_of(frames, faces)[:, 0]
    assert kept.float().mean() > 0.998


def test_the_motion_stays_steady(body_with_arm: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    rest, faces, frames = body_with_arm
    crossing = np.stack([self_intersecting(frame, faces) for frame in frames])
    pushed, left = push_apart(InnerBalls(rest, faces), frames, crossing, loop=False)
    assert np.array_equal(left.sum(1), crossings(pushed, faces))
    moved = pushed - frames
    hand = (rest[:, 0] > 0.3) & (rest[:, 1] < 0.1)
    depth = moved[:, hand, 2].mean(1)
    assert depth.argmax() in range(2, FRAMES - 2) and depth.max() > 0.05
    assert np.abs(np.diff(depth)).max() < 0.6 * depth.max()  # no jump where the contact begins


def test_no_frame_is_searched_twice_and_equal_pulls_share_their_factors(
    body_with_arm: tuple[np.ndarray, np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    rest, faces, frames = body_with_arm
    frames = frames[1:3]  # no two are alike, unlike those of the way there and back
    searched, factored = list[bytes](), list[float]()

    def search(moved: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        searched.append(moved.tobytes())
        return self_intersecting(moved, triangles)

    def factors(laplacian: csr_array, pull: np.ndarray) -> SuperLU:
        factored.append(pull[0])
        return screened_factors(laplacian, pull)

    monkeypatch.setattr(separation, "self_intersecting", search)
    monkeypatch.setattr(separation, "screened_factors", factors)
    _, count = separated(rest, faces, frames, silhouettes_of(frames, faces))
    assert count > 0 and len(searched) > 2 * len(frames)
    assert len(set(searched)) == len(searched)
    assert sorted(factored) == sorted(set(separation.PULLS))


def test_a_motion_without_crossings_stays_as_it_is(body_with_arm: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    rest, faces, frames = body_with_arm
    vertices = torch.from_numpy(rest).float()
    offsets = torch.from_numpy(frames[:1]).float() - vertices
    moved, count = separate(vertices, offsets, torch.from_numpy(faces), silhouettes_of(frames[:1], faces))
    assert moved is offsets and count == 0


@pytest.fixture(scope="module")
def body_under_knob() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rest shape, faces, and a frame in which a knob on a bent rod has sunk into the body below it."""
    vertices, faces = solid(
        ((-0.4, -0.2, 0), (0.4, -0.2, 0), 0.15),
        ((-0.4, -0.2, 0), (-0.4, 0.2, 0), 0.06),
        ((-0.4, 0.2, 0), (0.2, 0.2, 0), 0.06),
        ((0.2, 0.2, 0), (0.2, 0.14, 0), 0.09),
    )
    lowered = np.where(vertices[:, 1] > 0, ((vertices[:, 0] + 0.3) / 0.4).clip(0, 1), 0)
    sunk = vertices - 0.2 * (lowered**2 * (3 - 2 * lowered))[:, None] * np.array([0.0, 1, 0])
    return vertices, faces, sunk


def test_a_knob_inside_the_body_shrinks_to_a_cap_over_the_hole(
    body_under_knob: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    rest, faces, sunk = body_under_knob
    assert crossings(sunk[None], faces)[0] > 50
    capped = cap(InnerBalls(rest, faces), sunk)
    assert crossings(capped[None], faces) == [0]
    tip = (rest[:, 0] > 0.15) & (rest[:, 1] < 0.08) & (rest[:, 1] > 0)
    assert sunk[tip, 1].max() < -0.05  # the top of the body
    assert capped[tip, 1].min() > -0.07
    below = rest[:, 1] < -0.1
    assert np.abs(capped - sunk)[below].max() < 0.03


def test_a_rod_inside_the_body_does_not_shrink_to_a_point() -> None:
    """It would have triangles smaller than a step of quantized positions."""
    rest, faces = solid(
        ((-0.35, -0.3, 0), (0.35, -0.3, 0), 0.25),
        ((-0.35, -0.3, 0), (-0.35, 0.3, 0), 0.06),
        ((-0.35, 0.3, 0), (0.2, 0.3, 0), 0.06),
        ((0.2, 0.3, 0), (0.2, 0.0, 0), 0.04),
    )
    rod = (np.abs(rest[:, 0] - 0.2) < 0.1) & (rest[:, 1] > -0.045)
    lowered = np.where(rod | (rest[:, 1] > 0.1), ((rest[:, 0] + 0.25) / 0.35).clip(0, 1), 0)
    sunk = rest - 0.3 * (lowered**2 * (3 - 2 * lowered))[:, None] * np.array([0.0, 1, 0])
    capped = cap(InnerBalls(rest, faces), sunk)
    assert crossings(rest[None], faces) == [0] == crossings(capped[None], faces) < crossings(sunk[None], faces)
    assert np.ptp(capped[rod & (rest[:, 1] < 0.1)], axis=0).min() > 2e-3


def test_outlines_decide_whether_a_cap_is_kept(body_under_knob: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    rest, faces, sunk = body_under_knob
    balls = InnerBalls(rest, faces)
    assert cap(balls, sunk, lambda attempt: False) is sunk
    aside = silhouettes_of(rest[None], faces)  # the video shows the knob above the body: a cap loses nothing
    result, count = separated(rest, faces, sunk[None], aside)
    assert count == 1 and crossings(result[None][0], faces)[0] < crossings(sunk[None], faces)[0]
