"""Placements of a model in a picture."""

from dataclasses import replace

import numpy as np
import torch
import trimesh

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.asset_pose import APART, centered_placement, distinct_placements, find_placement, judge
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.surface_cloud import cover_surface
from dg4d_lib.rasterizer.interface import get_rasterizer

RASTERIZE = get_rasterizer("cpu")
AZIMUTH = 40.0


def slab() -> Gaussians:
    """Return a flat box with a red front, whose outline is the same from the back, and a little gray on top."""
    box = trimesh.creation.box((0.8, 1.0, 0.3))
    box = box.subdivide().subdivide()
    front = box.vertices[:, 2:] > 0.1
    colors = np.where(front, (0.8, 0.1, 0.1), np.where(box.vertices[:, 1:2] > 0.4, (0.4,) * 3, (0.1, 0.1, 0.8)))
    part = ModelPart("slab", box.vertices.astype(np.float32), np.asarray(box.faces), colors=colors.astype(float))
    return cover_surface(Model((part,)), 2000, torch.Generator().manual_seed(0)).cloud


def picture(cloud: Gaussians) -> torch.Tensor:
    placed = centered_placement(cloud, AZIMUTH).apply(cloud)
    drawn = RASTERIZE(placed, [OrbitCamera(width=96, height=96)], torch.zeros(3))
    return torch.cat([drawn.color[0] / drawn.alpha[0].clamp(min=1e-3), drawn.alpha[0]], -1).clamp(0, 1)


def apart(first: float, second: float) -> float:
    return abs((first - second + 180) % 360 - 180)


def test_distinct_placements_are_from_other_sides_and_the_best_is_first():
    cloud = slab()
    subject = picture(cloud)
    found = distinct_placements(cloud, subject, RASTERIZE)
    azimuths = [one.azimuth_deg for one in found]
    assert len(found) == 3 and apart(azimuths[0], AZIMUTH) < 15
    assert max(apart(azimuths[0], other) for other in azimuths[1:]) > APART
    assert apart(find_placement(cloud, subject, RASTERIZE).azimuth_deg, AZIMUTH) < 15


def test_a_given_azimuth_is_the_only_one():
    cloud = slab()
    (only,) = distinct_placements(cloud, picture(cloud), RASTERIZE, AZIMUTH)
    assert only.azimuth_deg == AZIMUTH


def test_the_score_of_a_placement_does_not_depend_on_those_beside_it():
    cloud = slab()
    subject, true = picture(cloud), centered_placement(cloud, AZIMUTH)
    (alone,) = judge(cloud, [true], subject, RASTERIZE, 96)
    beside = judge(cloud, [replace(true, scale=0.1 * true.scale), true], subject, RASTERIZE, 96)
    assert beside[1].score == alone.score
