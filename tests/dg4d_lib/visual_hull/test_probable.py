"""Probable part of a hull: what a prediction denies goes, unless a silhouette needs it."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from creatures import alpha_of, known_surface, seen
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.visual_hull.carve import Volume
from dg4d_lib.visual_hull.frustum_field import cell_centers
from dg4d_lib.visual_hull.known import KnownView
from dg4d_lib.visual_hull.probable import Predict
from dg4d_lib.visual_hull.shape import known_volume
from dg4d_lib.visual_hull.surface import extract

RADIUS, HALF_HEIGHT = 0.15, 0.25
POSTS = torch.tensor([[0.3, 0.3], [-0.3, -0.3]])  # x and z of their axes
PHANTOMS = POSTS * torch.tensor([1.0, -1])  # where both silhouettes allow posts, too


def inside_posts(points: Float[Tensor, "*n 3"], posts: Float[Tensor, "p 2"] = POSTS) -> Float[Tensor, "*n"]:
    """Return how far points lie inside of posts, world units."""
    return RADIUS - (points[..., None, [0, 2]] - posts).norm(dim=-1).amin(-1)


@pytest.fixture(scope="module")
def views() -> list[KnownView]:
    """Return views of two posts from the front and from the side, which do not tell which of four places they have."""
    axis = torch.linspace(-0.6, 0.6, 61)
    points = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    field = torch.minimum(inside_posts(points), HALF_HEIGHT - points[..., 1].abs())
    vertices, faces = extract(Volume(field.numpy(), np.full(3, -0.6, np.float32), 0.02))
    posts = InflatedSurface(
        vertices, faces, torch.full_like(vertices, 0.5), torch.ones(len(vertices), dtype=torch.bool)
    )
    return [seen(posts, 0), seen(posts, 90)]


def prediction_of(views: Sequence[KnownView], offset: float = 0.0, posts: Sequence[Tensor] = (POSTS, POSTS)) -> Predict:
    """Return log-odds of the posts that each view believes in, plus an offset."""
    fields = {}
    for view, believed in zip(views, posts, strict=True):
        angle = np.deg2rad(view.camera.azimuth_deg)
        turn = torch.tensor([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        level = inside_posts(cell_centers() @ turn.float().T, believed)
        fields[view.cutout.data_ptr()] = (level / 0.02 + offset).clamp(-5, 5)
    return lambda cutout: fields[cutout.data_ptr()]


def matter(volume: Volume, posts: Float[Tensor, "p 2"]) -> int:
    """Return the number of cells inside of posts."""
    cells = torch.from_numpy(volume.values > 0).nonzero()
    return int((inside_posts(torch.from_numpy(volume.low) + cells * volume.step, posts) > 0).sum())


def test_what_the_prediction_denies_goes(views: list[KnownView]) -> None:
    hull, volume = known_volume(views), known_volume(views, prediction_of(views))
    assert matter(hull, PHANTOMS) > 0.3 * matter(hull, POSTS)
    assert matter(volume, PHANTOMS) < 0.1 * matter(hull, PHANTOMS)
    assert matter(volume, POSTS) > 0.95 * matter(hull, POSTS)


def test_a_prediction_that_denies_everything_leaves_what_silhouettes_show(views: list[KnownView]) -> None:
    surface = known_surface(views, prediction_of(views, -20.0))
    for view in views:
        drawn, shown = alpha_of(surface, view.camera.azimuth_deg)[..., 0] > 0.5, view.cutout[None, ..., 3] > 0.5
        assert (drawn & shown).sum() > 0.85 * shown.sum()


def test_a_sure_prediction_changes_nothing(views: list[KnownView]) -> None:
    sure = known_volume(views, prediction_of(views, 100.0))
    np.testing.assert_array_equal(sure.values, known_volume(views).values)


def test_unreliable_views_count_less(views: list[KnownView]) -> None:
    predict = prediction_of(views, posts=(POSTS, PHANTOMS))
    phantoms = []
    for weight in (1.0, 0.5):
        side = KnownView(views[1].camera, views[1].cutout, weight=weight)
        phantoms.append(matter(known_volume([views[0], side], predict), PHANTOMS))
    assert phantoms[1] < 0.3 * phantoms[0]
