"""Folds, crossings, flips and handles on shapes for which they are known, and their removal."""

from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.mesh import folds
from dg4d_lib.mesh.extraction.silhouettes import cameras_of, silhouette_iou
from dg4d_lib.mesh.extraction.unfold import unfold, without_new_defects
from dg4d_lib.mesh.folds import DefectFinder, genus, self_intersecting, surface_defects
from dg4d_lib.mesh.neighbors import edge_graph
from dg4d_lib.mesh.tracking.elastic import ElasticBody, relax, turn_back
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh


def sphere(subdivisions: int = 3) -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(subdivisions)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def tube(rings: int = 41, around: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """An open tube of radius 0.1 along x, from 0 to 1, of nearly equal triangles."""
    along, angle = np.meshgrid(np.linspace(0, 1, rings), 2 * np.pi * np.arange(around) / around, indexing="ij")
    vertices = np.stack([along, 0.1 * np.cos(angle), 0.1 * np.sin(angle)], -1).reshape(-1, 3)
    numbers = np.arange(rings * around).reshape(rings, around)
    a, b = numbers[:-1], numbers[1:]
    c, d = np.roll(a, -1, 1), np.roll(b, -1, 1)
    return vertices, np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]).reshape(-1, 3)


def bent(vertices: np.ndarray, degrees: float) -> np.ndarray:
    """The half beyond x = 0.5 turned about the z axis through (0.5, 0, 0), as stiffly as two bones without a joint."""
    angle = np.radians(degrees)
    joint = np.array([0.5, 0, 0])
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return np.where(vertices[:, :1] > 0.5, (vertices - joint) @ turn.T + joint, vertices)


def test_a_sphere_has_no_defects_and_no_handle() -> None:
    defects = surface_defects(*sphere())
    assert (defects.self_intersecting, defects.folds, defects.creases, defects.flipped) == (0, 0, 0, 0)
    assert genus(sphere()[1]) == 0


def test_a_torus_has_one_handle_and_two_of_them_have_two() -> None:
    torus = trimesh.creation.torus(1, 0.3)
    both = trimesh.util.concatenate([torus, torus.copy().apply_translation([5, 0, 0])])
    assert genus(np.asarray(torus.faces)) == 1
    assert genus(np.asarray(both.faces)) == 2


@pytest.mark.parametrize(("distance", "crossing"), [(3.0, False), (1.0, True)])
def test_two_spheres_cross_where_they_overlap(distance: float, crossing: bool) -> None:
    vertices, faces = sphere(2)
    both = np.concatenate([vertices, vertices + np.array([distance, 0, 0])])
    marked = self_intersecting(both, np.concatenate([faces, faces + len(vertices)]))
    assert marked.any() == crossing
    middle = both[np.concatenate([faces, faces + len(vertices)])[marked]].mean(1)[:, 0]
    assert (np.abs(middle - distance / 2) < 0.3).all()


@pytest.mark.parametrize("largest", [1, 1000])
def test_crossings_are_those_of_a_search_over_all_pairs(largest: float) -> None:
    generator = np.random.default_rng(0)
    corners = generator.normal(size=(60, 1, 3)) + 0.5 * generator.normal(size=(60, 3, 3))
    corners[::40] *= largest
    faces = np.arange(180).reshape(60, 3)
    expected = np.zeros(60, bool)
    for i in range(60):
        for j in range(60):
            expected[[i, j]] |= i != j and any(passes(corners[i][[k, (k + 1) % 3]], corners[j]) for k in range(3))
    assert expected.any() and not expected.all()
    assert np.array_equal(self_intersecting(corners.reshape(-1, 3), faces), expected)


def test_a_ground_plane_does_not_put_a_model_into_few_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = sphere()
    corners = [[-1000, -0.95, -1000], [1000, -0.95, -1000], [0, -0.95, 1000]]
    fill, fullest = folds._fill_grid, []

    def count(*grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        starts, members = fill(*grid)
        fullest.append(np.diff(starts).max())
        return starts, members

    monkeypatch.setattr(folds, "_fill_grid", count)
    plane = np.arange(3)[None] + len(vertices)
    marked = self_intersecting(np.concatenate([vertices, corners]), np.concatenate([faces, plane]))
    below = vertices[:, 1] < -0.95
    assert np.array_equal(marked, [*(below[faces].any(1) & ~below[faces].all(1)), True])
    assert max(fullest) < 100


def passes(segment: np.ndarray, triangle: np.ndarray) -> bool:
    """Solve p + s (q - p) = a + u (b - a) + v (c - a)."""
    (p, q), (a, b, c) = segment, triangle
    s, u, v = np.linalg.solve(np.stack([p - q, b - a, c - a], 1), p - a)
    return 0 < s < 1 and u > 0 and v > 0 and u + v < 1


def test_a_rigid_motion_flips_nothing_and_a_vertex_that_overtakes_its_neighbor_flips_faces() -> None:
    vertices, faces = sphere(2)
    turn = trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3]
    assert surface_defects(vertices @ turn.T, faces, vertices).flipped == 0
    corner, neighbor, _ = faces[0]
    overtaken = vertices.copy()
    overtaken[corner] += 2 * (vertices[neighbor] - vertices[corner])
    assert 0 < surface_defects(overtaken, faces, vertices).flipped <= (faces == corner).any(1).sum()


def test_a_spike_through_the_other_side_is_smoothed_away() -> None:
    vertices, faces = sphere()
    spiked = vertices.copy()
    spiked[0] *= -1.3
    assert surface_defects(spiked, faces).self_intersecting > 0
    smooth = unfold(spiked, faces)
    defects = surface_defects(smooth, faces)
    assert (defects.self_intersecting, defects.folds) == (0, 0)
    assert (smooth == spiked).all(1).mean() > 0.9
    assert unfold(vertices, faces) is not vertices and np.array_equal(unfold(vertices, faces), vertices)


def test_steps_are_shorter_around_new_defects_alone() -> None:
    """A sphere that grows, but for a spike through its other side; an old spike may stay."""
    vertices, faces = sphere()
    vertices[5] *= -1.3
    grown = 1.1 * vertices
    grown[0] *= -1.3
    edges, defective = edge_graph(faces, len(vertices)), DefectFinder(faces).defective
    kept = without_new_defects(vertices, grown, faces, edges, defective)
    assert (defective(grown) & ~defective(vertices)).any() and defective(kept).any()
    assert not (defective(kept) & ~defective(vertices)).any()
    assert (kept == grown).all(1).mean() > 0.8 and (kept[0] != grown[0]).any()


def test_unfolding_tests_moved_faces_alone_and_misses_none(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = tube()
    noisy = vertices + 0.012 * np.random.default_rng(1).normal(size=vertices.shape) * (vertices[:, :1] > 0.85)
    fast = unfold(noisy, faces)
    assert DefectFinder(faces).defective(noisy).any() and (fast == noisy).all(1).mean() > 0.5
    search = DefectFinder.defective
    monkeypatch.setattr(DefectFinder, "defective", lambda self, vertices, near=None: search(self, vertices))
    assert np.array_equal(fast, unfold(noisy, faces))


def test_only_faces_nearby_are_searched() -> None:
    vertices, faces = sphere(2)
    both, joined = (
        np.concatenate([vertices, vertices + np.array([1.0, 0, 0])]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    everywhere = self_intersecting(both, joined)
    assert not self_intersecting(both, joined, np.zeros(len(joined), bool)).any()
    assert np.array_equal(self_intersecting(both, joined, np.arange(len(joined)) < len(faces)), everywhere)


@pytest.mark.parametrize("seed", range(5))
def test_defects_after_a_change_in_one_place_are_those_of_a_whole_search(seed: int) -> None:
    vertices, faces = tube()
    draws = np.random.default_rng(seed)
    finder = DefectFinder(faces, vertices)
    before = vertices + 0.02 * draws.normal(size=vertices.shape) * (vertices[:, :1] > 0.5)
    place = np.linalg.norm(vertices - vertices[draws.integers(len(vertices))], axis=1) < 0.15
    after = np.where(place[:, None], vertices + 0.03 * draws.normal(size=vertices.shape), before)
    marked, expected = finder.defective(before), finder.defective(after)
    assert (marked != expected).any()
    assert np.array_equal(finder.updated(marked, before, after), expected)
    assert finder.updated(marked, before, before) is marked


def test_more_rounds_of_smoothing_never_leave_more_defects(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thin and crumpled tube, which smoothing collapses in the end."""
    vertices, faces = tube(rings=41, around=4)
    noise = 0.05 * np.random.default_rng(0).normal(size=vertices.shape) * [0.3, 1, 1]
    left = []
    for rounds in range(1, 25):
        monkeypatch.setattr("dg4d_lib.mesh.extraction.unfold.ROUNDS", rounds)
        left.append(DefectFinder(faces).defective(unfold(vertices + noise, faces)).sum())
    assert left[0] > 100 and left[-1] < 10
    assert left == sorted(left, reverse=True)


def test_a_bone_that_bends_a_tube_at_once_makes_folds_and_relaxing_takes_them_away() -> None:
    vertices, faces = tube()
    moved = bent(vertices, 50.0)
    assert surface_defects(moved, faces, vertices).self_intersecting > 10
    rest, offsets = (torch.from_numpy(part).float() for part in (vertices, np.stack([moved - vertices])))
    relaxed = relax(rest, offsets, torch.from_numpy(faces))
    found = surface_defects((rest + relaxed[0]).numpy(), faces, vertices)
    assert (found.self_intersecting, found.flipped) == (0, 0)
    far = np.abs(vertices[:, 0] - 0.5) > 0.3
    assert np.abs((relaxed - offsets)[0].numpy()[far]).max() < 0.02  # the ends stay where tracking put them


def test_a_stronger_relaxation_is_kept_where_the_outlines_allow_it() -> None:
    vertices, faces = tube()
    rest, moved, triangles = (
        torch.from_numpy(vertices),
        torch.from_numpy(bent(vertices, 150.0)),
        torch.from_numpy(faces),
    )
    rest, offsets = (rest - torch.tensor([0.5, 0, 0])).float(), (moved - rest)[None].float()
    gentle = relax(rest, offsets, triangles)
    outlines = torch.stack([rasterize_mesh(rest + gentle, triangles, views).faces >= 0 for views in cameras_of(1)], 1)
    assert silhouette_iou(rest + gentle, triangles, outlines)[0] == 1
    assert torch.equal(relax(rest, offsets, triangles, outlines), gentle)  # the stronger one would lose more
    strong = relax(rest, offsets, triangles, torch.zeros_like(outlines))  # an IoU of 0 cannot fall
    left = [DefectFinder(faces, vertices).defective((rest + found[0]).numpy()).sum() for found in (strong, gentle)]
    assert 0 < left[0] < left[1]


def test_the_stronger_relaxation_begins_with_the_first_round_of_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = tube()
    rest, triangles = torch.from_numpy(vertices).float(), torch.from_numpy(faces)
    offsets = torch.from_numpy(bent(vertices, 150.0)).float()[None] - rest
    whole = 0
    settle = ElasticBody.settle

    def counted(body: ElasticBody, *args: Any) -> np.ndarray:
        nonlocal whole
        whole += len(args) == 3  # without the vertices that are free
        return settle(body, *args)

    monkeypatch.setattr(ElasticBody, "settle", counted)
    strong = relax(rest, offsets, triangles, torch.zeros(1, 2, 128, 128, dtype=torch.bool))
    assert whole == 1
    assert not torch.equal(strong, relax(rest, offsets, triangles))


def test_a_rigid_motion_is_left_as_it_is() -> None:
    vertices, faces = sphere(2)
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    offsets = torch.from_numpy(vertices @ turn.T + [0.1, 0.2, 0.3] - vertices)[None]
    torch.testing.assert_close(relax(torch.from_numpy(vertices), offsets, torch.from_numpy(faces)), offsets)


def test_flipped_faces_are_turned_back_where_the_outlines_allow_it() -> None:
    vertices, faces = sphere(3)
    vertices = 0.4 * vertices  # within the picture
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    corner, neighbor, _ = faces[100]
    overtaken = vertices.copy()
    overtaken[corner] += 2 * (vertices[neighbor] - vertices[corner])
    rest, triangles = torch.from_numpy(vertices).float(), torch.from_numpy(faces)
    states = torch.from_numpy(np.stack([vertices @ turn.T, overtaken @ turn.T])).float()
    outlines = torch.stack([rasterize_mesh(states, triangles, views).faces >= 0 for views in cameras_of(2)], 1)
    turned = rest + turn_back(rest, states - rest, triangles, outlines)
    torch.testing.assert_close(turned[0], states[0])  # nothing to do
    before, after = (surface_defects(state.numpy(), faces, vertices) for state in (states[1], turned[1]))
    assert before.flipped > after.flipped == 0
    far = np.linalg.norm(vertices - vertices[corner], axis=1) > 0.2
    torch.testing.assert_close(turned[1, far], states[1, far])


def test_flipped_faces_are_relaxed_place_by_place() -> None:
    vertices, faces = sphere(4)
    vertices = 0.4 * vertices
    overtaken = vertices.copy()
    for corner, neighbor, _ in faces[[100, 3000]]:
        overtaken[corner] += 2 * (vertices[neighbor] - vertices[corner])
    places = ElasticBody(vertices, faces).flipped_places(overtaken)
    assert len(places) == 2 and not (places[0] & places[1]).any()
    rest, state, triangles = (
        torch.from_numpy(vertices).float(),
        torch.from_numpy(overtaken).float(),
        torch.from_numpy(faces),
    )
    outlines = torch.stack([rasterize_mesh(rest[None], triangles, views).faces >= 0 for views in cameras_of(1)], 1)
    turned = rest + turn_back(rest, (state - rest)[None], triangles, outlines)[0]
    assert surface_defects(turned.numpy(), faces, vertices).flipped == 0
    changed = (turned - state).norm(dim=1) > 1e-6
    assert changed.sum() < 0.1 * len(vertices)  # a few rings around each


def test_flipped_faces_stay_where_outlines_ask_for_them() -> None:
    vertices, faces = sphere(2)
    vertices = 0.3 * vertices
    spiked = vertices.copy()
    spiked[faces[100]] *= -2.5  # a triangle through the other side
    rest, spike, triangles = (torch.from_numpy(array) for array in (vertices, spiked, faces))
    rest, offsets = rest.float(), (spike - rest)[None].float()
    assert surface_defects(spiked, faces, vertices).flipped > 0
    for shown, kept in ((rest + offsets, True), (rest[None], False)):
        outlines = torch.stack([rasterize_mesh(shown, triangles, views).faces >= 0 for views in cameras_of(1)], 1)
        assert torch.equal(turn_back(rest, offsets, triangles, outlines), offsets) is kept
