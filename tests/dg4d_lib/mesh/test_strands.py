"""Strands: what grows out of a ball where a picture shows lines beyond its outline, and what does not."""

import numpy as np
import pytest
import torch
import trimesh
from skimage.draw import line

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.extraction.strands import with_strands
from dg4d_lib.mesh.folds import genus, surface_defects
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SIZE = 256  # pixels of the picture
FINE = OrbitCamera(width=4 * SIZE, height=4 * SIZE)
LEG = ((150, 90), (215, 60))  # row and column of root and tip; the root lies within the ball
ARM = ((150, 166), (190, 210))
FINGER = ((178, 197), (210, 190))  # from the arm


def ball() -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(4, 0.4)
    return torch.from_numpy(mesh.vertices.astype(np.float32)), torch.from_numpy(mesh.faces.astype(np.int32))


def alpha_of(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Return the alpha of a mesh at the input view, with soft edges."""
    covered = (rasterize_mesh(vertices, faces, [FINE]).faces >= 0).float()
    return torch.nn.functional.avg_pool2d(covered[None], 4)[0, 0]


def lines(*ends: tuple[tuple[int, int], tuple[int, int]]) -> torch.Tensor:
    """Return alpha of lines, two pixels wide."""
    alpha = torch.zeros(SIZE, SIZE)
    for (top, left), (bottom, right) in ends:
        rows, columns = line(top, left, bottom, right)
        alpha[rows, columns] = alpha[rows, columns + 1] = 1
    return alpha


@pytest.mark.parametrize(("ends", "roots"), [((LEG,), 1), ((LEG, ARM), 2), ((ARM, FINGER), 1)])
def test_lines_beyond_the_outline_become_tubes(
    ends: tuple[tuple[tuple[int, int], tuple[int, int]], ...], roots: int
) -> None:
    vertices, faces = ball()
    alpha = torch.maximum(alpha_of(vertices, faces), lines(*ends))
    grown, corners = with_strands(vertices, faces, alpha)
    beyond = (alpha > 0.5) & (alpha_of(vertices, faces) < 0.5)
    covered = alpha_of(grown, corners) > 0.5
    assert (covered & beyond).sum() > 0.7 * beyond.sum()  # the lines have steps
    assert (covered & (alpha < 0.5)).sum() < 0.3 * beyond.sum()
    surface = trimesh.Trimesh(grown.numpy(), corners.numpy(), process=False)
    assert surface.is_watertight and surface.is_winding_consistent and genus(corners.numpy()) == 0
    defects = surface_defects(grown.numpy(), corners.numpy())
    assert defects.self_intersecting == 0 and defects.folds == 0
    moved = (grown[: len(vertices)] != vertices).any(1)
    assert moved.sum() == roots  # the vertices that they grew out of became their tips
    assert (grown[len(vertices) :, 2] - vertices[moved][:, 2].mean()).abs().max() < 0.1  # all at one depth


def test_tubes_are_as_thick_as_the_lines() -> None:
    vertices, faces = ball()
    grown, _ = with_strands(vertices, faces, torch.maximum(alpha_of(vertices, faces), lines(LEG)))
    depth, pixel = 2 - float(grown[len(vertices) :, 2].mean()), 1 / OrbitCamera(width=SIZE, height=SIZE).focal
    thick = float(np.ptp(grown[len(vertices) :, 2].numpy()))
    assert thick == pytest.approx(2 * depth * pixel, rel=0.35)


def test_a_subject_without_strands_stays() -> None:
    vertices, faces = ball()
    wider = alpha_of(1.06 * vertices, faces)
    lobe = alpha_of(0.3 * vertices + torch.tensor([0.4, 0.2, 0.0]), faces)
    for alpha in (alpha_of(vertices, faces), wider, torch.maximum(wider, lobe)):
        grown, corners = with_strands(vertices, faces, alpha)
        assert torch.equal(grown, vertices) and torch.equal(corners, faces)


def test_lines_apart_from_the_subject_are_no_strands() -> None:
    vertices, faces = ball()
    alpha = torch.maximum(alpha_of(vertices, faces), lines(((20, 20), (20, 90)), ((235, 120), (235, 121))))
    assert torch.equal(with_strands(vertices, faces, alpha)[0], vertices)


def test_an_empty_picture_grows_nothing() -> None:
    vertices, faces = ball()
    assert torch.equal(with_strands(vertices, faces, torch.zeros(SIZE, SIZE))[0], vertices)
