"""Gauss-Newton fit of rigid parts: its derivatives, its residuals, and a box whose lid opens towards the camera."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.fitting.asset_fit import AssetFit
from dg4d_lib.fitting.losses import LEVELS, pyramid_error, pyramid_residuals
from dg4d_lib.fitting.node_pose import Pose
from dg4d_lib.fitting.rigid_fit import _Problem, fit_rigid_motion
from dg4d_lib.fitting.rigid_parts import RigidMotion
from dg4d_lib.mesh.models.control_graph import build_control_graph
from dg4d_lib.mesh.models.surface_cloud import cover_surface
from dg4d_lib.rasterizer.interface import get_rasterizer
from tests.dg4d_lib.fitting.test_asset_motion import arm, opened, video_of

SETTINGS = AssetSettings(points=1000, fit_points=1000, nodes=30, size=64, rigidity_loss="l1")
ANGLES = (0.0, 0.35, 0.7, 1.05)
BACK = -0.08  # world units per frame


@pytest.fixture(scope="module")
def fit() -> AssetFit:
    surface = cover_surface(arm(), SETTINGS.points, torch.Generator().manual_seed(0))
    graph = build_control_graph(surface.fine.vertices, surface.fine.faces, SETTINGS.nodes)
    rest = arm().parts[0].vertices
    moments = [opened(rest, angle) + np.array([0, 0, BACK * frame]) for frame, angle in enumerate(ANGLES)]
    normal = np.array([1.0, 0.0, 0.0])
    bound = graph.of(surface.nearest)
    fit = AssetFit(surface.cloud, bound, video_of(moments), get_rasterizer("cpu"), SETTINGS, normal)
    fit.match_first_frame(Pose.rest(len(graph.nodes)))
    return fit


def parts_of(fit: AssetFit, share: float) -> RigidMotion:
    """Return both halves, after a share of their true motion."""
    parts = (fit.graph.nodes[:, 1] > 0).long()
    angles = share * torch.tensor(ANGLES)
    quats = torch.zeros(len(ANGLES), 2, 4)
    quats[:, 0, 0] = 1
    quats[:, 1, 0], quats[:, 1, 1] = (angles / 2).cos(), (angles / 2).sin()
    places = torch.zeros(len(ANGLES), 2, 3)
    places[..., 2] = share * BACK * torch.arange(len(ANGLES))[:, None]
    return RigidMotion(parts, torch.zeros(2, 3), quats, places)


def moved(fit: AssetFit, motion: RigidMotion) -> torch.Tensor:
    return motion.of_nodes(fit.graph).points(fit.plain.means, fit.graph)


def test_a_lid_that_opens_on_a_box_that_leaps_back_is_found(fit: AssetFit) -> None:
    start, truth = parts_of(fit, 0.5), moved(fit, parts_of(fit, 1.0))
    steps: list[tuple[int, float]] = []
    found = fit_rigid_motion(fit, start, lambda step, values: steps.append((step, values["rigid parts"])))
    before, after = ((moved(fit, one) - truth).norm(dim=-1)[-1].mean() for one in (start, found))
    assert after < 0.35 * before  # below 0.25 on one processor, 0.262 on another
    assert [step for step, _ in steps] == list(range(1, len(steps) + 1))
    losses = [loss for _, loss in steps]
    assert losses == sorted(losses, reverse=True)


def test_half_of_the_gradient_is_that_of_the_loss(fit: AssetFit) -> None:
    start = parts_of(fit, 0.6)
    problem = _Problem(fit, start)
    matrix, gradient = problem.normal_equations(start)
    assert torch.allclose(matrix, matrix.T)
    assert torch.linalg.eigvalsh(matrix).min() > -1e-6 * matrix.diagonal().max()
    direction = torch.zeros(len(ANGLES), 2, 6)
    direction[1:, 1, 3], direction[1:, :, 2] = 0.02, -0.005  # the lid opens further, and both leap farther back
    ahead, behind = (problem.loss(start.changed(sign * direction)) for sign in (1, -1))
    expected = 2 * float(gradient @ direction.double().reshape(-1))
    assert 0.5 * (ahead - behind) == pytest.approx(expected, rel=0.1)


def test_squares_of_the_residuals_are_the_losses_without_those_in_depth(fit: AssetFit) -> None:
    flat = copy(fit)
    flat.settings = fit.settings.model_copy(update={"depth": 0.0, "whole_depth": 0.0})
    motion = parts_of(fit, 0.6).of_nodes(fit.graph)
    frames = list(range(len(ANGLES)))
    losses = flat.losses(motion, frames)
    squares = fit.residuals(motion, frames).square().sum(1).mean()
    assert float(squares) == pytest.approx(float(losses["color"] + losses["alpha"] + losses["unseen"]), rel=1e-4)


def test_filters_of_the_pyramid_are_means_over_squares() -> None:
    generator = torch.Generator().manual_seed(0)
    ours, theirs = torch.rand(2, 2, 48, 41, 3, generator=generator)
    levels = [(ours - theirs).movedim(-1, 1)]
    for width in LEVELS[1:]:
        filtered = functional.avg_pool2d(levels[0], width // 2)
        for _ in range(3):
            filtered = functional.avg_pool2d(filtered, 3, 1, 1)
        levels.append(filtered)
    expected = torch.stack([level.square().mean() for level in levels]).mean()
    torch.testing.assert_close(pyramid_error(ours, theirs), expected)


def test_squares_of_the_pyramid_sum_to_its_error() -> None:
    generator = torch.Generator().manual_seed(0)
    ours, theirs = torch.rand(2, 3, 48, 40, 3, generator=generator)
    errors = [pyramid_error(one[None], other[None]) for one, other in zip(ours, theirs, strict=True)]
    assert torch.allclose(pyramid_residuals(ours, theirs).square().sum(1), torch.stack(errors))


def test_joints_hold_parts_together(fit: AssetFit) -> None:
    """Compare two gaps between parts: the wider one costs more, but less than in proportion to its square."""
    together = parts_of(fit, 1.0)
    problem = _Problem(fit, together)
    apart = [together.places.clone() for _ in range(2)]
    for place, gap in zip(apart, (0.1, 0.2), strict=True):
        place[:, 1, 1] += gap

    def joints(motion: RigidMotion) -> float:
        frames = slice(0, len(ANGLES))
        seen = fit.residuals(motion.of_nodes(fit.graph), list(range(len(ANGLES)))).shape[1]
        return float(problem._residuals(motion, frames)[:, seen:].square().sum())

    near, far = (joints(replace(together, places=place)) for place in apart)
    assert 0 < near < far < 3 * near
