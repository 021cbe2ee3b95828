import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.density import DensityField, density_field
from dg4d_lib.mesh.extraction.extract import extract_surface, select_level, usable_level
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import Rendering, get_rasterizer
from dg4d_lib.settings import MeshSettings

SMALL = MeshSettings(grid=64)
Cloud = Callable[..., Gaussians]


def body(field: DensityField, level: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(*extract_surface(field, level), process=False)


def ball(opacity_logit: float = 3.0) -> Gaussians:
    """One round Gaussian, standard deviation 0.2, at (0.1, 0.2, 0.3)."""
    return Gaussians(
        torch.tensor([[0.1, 0.2, 0.3]]),
        torch.full((1, 3), math.log(0.2)),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([opacity_logit]),
        torch.zeros(1, 1, 3),
    )


def constant(value: float, size: int = 8) -> DensityField:
    return DensityField(torch.full((size,) * 3, value), torch.zeros(3, dtype=torch.float64), 1.0, 1.0)


def test_a_round_gaussian_gives_a_closed_sphere_of_the_radius_of_the_level() -> None:
    field = density_field(ball(), SMALL)
    mesh = body(field, 0.5)
    opacity = ball().opacities.item()
    radius = 0.2 * math.sqrt(2 * math.log(opacity / 0.5))
    distances = np.linalg.norm(mesh.vertices - [0.1, 0.2, 0.3], axis=1)
    assert mesh.is_watertight
    assert abs(distances - radius).max() < 0.2 * field.cell  # linear interpolation between samples
    assert mesh.volume == pytest.approx(4 / 3 * math.pi * radius**3, rel=0.05)  # positive: faces look outwards


def test_a_hollow_sphere_has_no_inner_wall(sphere_of_gaussians: Cloud) -> None:
    field = density_field(sphere_of_gaussians(), SMALL)
    mesh = body(field, 0.5)
    assert mesh.body_count == 1
    assert mesh.is_watertight
    assert 1 < mesh.volume / (4 / 3 * math.pi * 0.5**3) < 1.3  # the wall has a thickness


def test_a_hollow_sphere_with_a_small_hole_is_filled_too(sphere_of_gaussians: Cloud) -> None:
    gaussians = sphere_of_gaussians()

    def without(first: int) -> DensityField:  # the first ones sit around the pole
        return density_field(gaussians.subset(slice(first, None)), SMALL)

    holed = without(7)
    assert holed.values[32, 32:, 32].max() < 0.5, "there is no hole to close"
    assert body(holed, 0.5).volume > 4 / 3 * math.pi * 0.5**3
    assert body(without(20), 0.5).volume < 0.5 * 4 / 3 * math.pi * 0.5**3, "a wide opening must stay open"


def test_a_gap_between_two_bodies_stays_open() -> None:
    two = Gaussians(
        torch.tensor([[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0]]),
        torch.full((2, 3), math.log(0.2)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1),
        torch.full((2,), 3.0),
        torch.zeros(2, 1, 3),
    )
    assert body(density_field(two, SMALL), 0.7).body_count == 2


def test_matter_that_fills_the_box_is_closed_at_its_border() -> None:
    mesh = body(constant(1.0), 0.5)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(8**3, rel=0.1)


def test_a_level_above_the_density_is_refused() -> None:
    with pytest.raises(FitDiverged, match="the largest density is 1"):
        extract_surface(constant(1.0), 2.0)


def test_a_level_that_is_not_reached_is_lowered() -> None:
    assert usable_level(constant(0.2), 0.5) == pytest.approx(0.05)
    assert usable_level(constant(2.0), 0.5) == 0.5
    with pytest.raises(FitDiverged, match="zero everywhere"):
        usable_level(constant(0.0), 0.5)


def test_the_best_level_has_the_outline_of_the_gaussians() -> None:
    # alpha of a Gaussian on a ray through its middle is its opacity times the same bell: half alpha at density one half
    gaussians, rasterize = ball(), get_rasterizer("auto")
    field = density_field(gaussians, SMALL)
    level, agreement = select_level(field, gaussians, rasterize, 0.2)
    assert level == pytest.approx(0.5, rel=0.1)
    assert agreement > 0.9
    assert select_level(field, gaussians, rasterize, 0.5)[1] == pytest.approx(0.98, abs=0.02)


def test_every_view_is_drawn_once_and_the_input_view_counts_twice() -> None:
    flat = replace(ball(), log_scales=torch.tensor([[math.log(0.3), math.log(0.2), math.log(0.05)]]))
    field, drawn = density_field(flat, SMALL), []

    def rasterize(gaussians: Gaussians, cameras: Sequence[OrbitCamera], background: torch.Tensor) -> Rendering:
        drawn.append((cameras, get_rasterizer("auto")(gaussians, cameras, background)))
        return drawn[-1][1]

    level, agreement = select_level(field, flat, rasterize, 0.5)
    ((cameras, render),) = drawn
    assert len(set(cameras)) == len(cameras)
    vertices, faces = map(torch.from_numpy, extract_surface(field, level))
    views = [0, *range(len(cameras))]
    shown = render.alpha[views, ..., 0] > 0.5
    covered = rasterize_mesh(vertices, faces, [cameras[view] for view in views]).faces >= 0
    assert agreement == float((shown & covered).sum() / (shown | covered).sum())


def test_a_faint_model_still_gets_a_surface() -> None:
    gaussians = replace(ball(), opacity_logits=torch.tensor([-2.0]))
    field = density_field(gaussians, SMALL)
    level, agreement = select_level(field, gaussians, get_rasterizer("auto"), 0.5)
    assert level < gaussians.opacities.item()
    assert agreement == 0.0, "nothing of it is more opaque than one half"
    assert len(extract_surface(field, level)[1]) > 0
