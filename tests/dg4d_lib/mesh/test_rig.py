import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from dg4d_lib.errors import BadInput
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.mesh.tracking import rig as module
from dg4d_lib.mesh.tracking.rig import Rig, fit_rig, rig_offsets

FRAMES = 9


def box(center: tuple[float, float, float], generator: torch.Generator, points: int = 200) -> torch.Tensor:
    return torch.tensor(center) + 0.3 * (torch.rand(points, 3, generator=generator) - 0.5)


def turning(axis: tuple[float, float, float], largest_deg: float) -> torch.Tensor:
    """Rotation matrices there and back again, the first is none."""
    angles = torch.linspace(0, math.pi, FRAMES).sin() * math.radians(largest_deg)
    half = (angles / 2)[:, None]
    return quat_to_rotmat(torch.cat((half.cos(), half.sin() * torch.tensor(axis)), 1))


def two_boxes() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    left, right = box((-0.5, 0.0, 0.2), generator), box((0.5, 0.1, 0.0), generator)
    moved_left = left @ turning((0.0, 0.0, 1.0), 40).mT + torch.linspace(0, 0.4, FRAMES)[:, None, None]
    moved_right = right @ turning((0.6, 0.8, 0.0), -70).mT
    rest = torch.cat((left, right))
    return rest, torch.cat((moved_left, moved_right), 1) - rest


def bent_cylinder() -> tuple[torch.Tensor, torch.Tensor]:
    """Skinned by two bones whose weights change smoothly around the middle, where the upper one turns."""
    height, around = torch.linspace(-1, 1, 41), torch.linspace(0, 2 * math.pi, 17)[:-1]
    y, angle = (part.ravel() for part in torch.meshgrid(height, around, indexing="ij"))
    rest = torch.stack((0.2 * angle.cos(), y, 0.2 * angle.sin()), 1)
    upper = ((y + 0.3) / 0.6).clamp(0, 1)[None, :, None]
    turned = rest @ turning((0.0, 0.0, 1.0), 60).mT
    return rest, upper * (turned - rest)


def test_two_rigid_boxes_are_two_bones() -> None:
    rest, offsets = two_boxes()
    rig = fit_rig(rest, offsets, 1e-3, 16)
    assert len(rig.rest_positions) == 2
    assert rig.max_distance < 2e-6  # float32 at places of size 1
    assert ((rig.weights > 1 - 1e-6) | (rig.weights < 1e-6)).all()


def test_bones_of_boxes_turn_as_the_boxes_do() -> None:
    rest, offsets = two_boxes()
    rig = fit_rig(rest, offsets, 1e-3, 16)
    left, right = int(rig.bones[0, 0]), int(rig.bones[-1, 0])
    torch.testing.assert_close(quat_to_rotmat(rig.quats[:, left]), turning((0.0, 0.0, 1.0), 40), atol=1e-5, rtol=0)
    torch.testing.assert_close(quat_to_rotmat(rig.quats[:, right]), turning((0.6, 0.8, 0.0), -70), atol=1e-5, rtol=0)


def test_a_bent_cylinder_is_two_bones_that_meet_at_the_bend() -> None:
    rest, offsets = bent_cylinder()
    rig = fit_rig(rest, offsets, 0.01, 16)
    assert len(rig.rest_positions) == 2
    assert rig.error < 0.01
    assert abs(float(rig.rest_positions[1, 1])) < 0.1  # the joint between them; the cylinder reaches from -1 to 1
    assert rig.parents.tolist() == [-1, 0]


def test_bones_keep_their_lengths() -> None:
    """An arm of three parts, each turning against the last, with noise that free bones would follow."""
    rest, _ = bent_cylinder()
    y, noise = rest[:, 1], torch.randn((FRAMES, len(rest), 3), generator=torch.Generator().manual_seed(3))
    lower, upper = (((y - bend) / 0.4).clamp(0, 1)[None, :, None] for bend in (-0.6, 0.3))
    elbow, wrist = torch.tensor([0.0, -0.4, 0.0]), torch.tensor([0.0, 0.5, 0.0])
    first, second = turning((0.0, 0.0, 1.0), 50), turning((1.0, 0.0, 0.0), 40)
    forearm = (rest - elbow) @ first.mT + elbow
    carried = (first @ (wrist - elbow))[:, None] + elbow
    hand = (rest - wrist) @ second.mT @ first.mT + carried
    moved = rest + lower * (forearm - rest) + upper * (hand - forearm)
    rig = fit_rig(rest, moved - rest + 0.003 * noise, 0.05, 16)
    assert len(rig.rest_positions) >= 3
    assert rig.stretch < 1e-4
    assert rig.error < 0.1


def test_bones_stretch_where_parts_fly_apart() -> None:
    rest, offsets = two_boxes()
    rig = fit_rig(rest, offsets, 1e-3, 16)
    assert rig.stretch > 0.1
    assert rig.max_distance < 2e-6


def test_a_vertex_has_no_bone_that_does_not_help_it() -> None:
    rest, offsets = waving()
    exact, rough = fit_rig(rest, offsets, 0.0, 8), fit_rig(rest, offsets, 0.3, 8)
    counts = [float((rig.weights > 0).sum(1).float().mean()) for rig in (exact, rough)]
    assert counts[1] < min(counts[0], 2.5)


def test_a_mesh_that_stands_still_is_one_bone_that_stands_still() -> None:
    rest = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    rig = fit_rig(rest, torch.zeros(5, 100, 3), 0.1, 16)
    assert (len(rig.rest_positions), rig.error) == (1, 0.0)
    assert rig.max_distance < 1e-12
    torch.testing.assert_close(rig.quats, torch.tensor([1.0, 0, 0, 0]).expand(5, 1, 4))


def test_noise_is_left_over() -> None:
    rest, offsets = two_boxes()
    noise = 0.01 * torch.randn(offsets.shape, generator=torch.Generator().manual_seed(1))
    rig = fit_rig(rest, offsets + noise, 0.1, 16)
    assert len(rig.rest_positions) == 2
    assert rig.rms == pytest.approx(0.01 * math.sqrt(3), rel=0.05)  # a few of 600 numbers a frame fit the bones


def test_a_single_frame_and_a_single_vertex_have_a_rig() -> None:
    rig = fit_rig(torch.tensor([[0.1, 0.2, 0.3]]), torch.tensor([[[1.0, 0.0, 0.0]]]), 0.1, 16)
    assert (len(rig.rest_positions), rig.max_distance < 1e-6) == (1, True)


def waving(points: int = 300) -> tuple[torch.Tensor, torch.Tensor]:
    """A motion that no few bones have."""
    rest = torch.rand(points, 3, generator=torch.Generator().manual_seed(2))
    phase = torch.linspace(0, 2 * math.pi, FRAMES)[:, None]
    height = 0.1 * (phase + 4 * rest[:, 0]).sin()
    return rest, torch.stack((height, 0.5 * height, 0 * height), -1)


@pytest.fixture(scope="module")
def twelve_bones() -> Rig:
    return fit_rig(*waving(), 0.0, 12)


def test_more_bones_follow_better_and_their_limit_is_kept() -> None:
    rest, offsets = waving()
    rigs = [fit_rig(rest, offsets, 0.0, most) for most in (1, 4, 12)]
    assert [len(rig.rest_positions) for rig in rigs] == [1, 4, 12]
    assert rigs[0].rms > 1.5 * rigs[1].rms > 2 * rigs[2].rms


def test_weights_are_shares_of_at_most_four_bones(twelve_bones: Rig) -> None:
    rig = twelve_bones
    assert rig.weights.shape[1] == 4
    assert (rig.weights >= 0).all()
    assert (rig.weights.diff(dim=1) <= 0).all()
    torch.testing.assert_close(rig.weights.sum(1), torch.ones(len(rig.weights)))
    assert (rig.bones[rig.weights == 0] == 0).all()


def test_the_residual_is_that_of_the_skin() -> None:
    rest, offsets = waving()
    rig = fit_rig(rest, offsets, 0.0, 6)
    missed = (rig_offsets(rig, rest) - offsets).norm(dim=-1)
    assert float(missed.square().mean().sqrt()) == pytest.approx(rig.rms, rel=1e-4)
    assert float(missed.max()) == pytest.approx(rig.max_distance, rel=1e-4)
    assert rig.error == pytest.approx(rig.rms / float((offsets - offsets.mean(0)).norm(dim=-1).square().mean().sqrt()))


def test_equal_motions_have_equal_rigs() -> None:
    first, second = (fit_rig(*waving(), 0.0, 6) for _ in range(2))
    assert all(
        torch.equal(getattr(first, name), getattr(second, name)) for name in ("rest_positions", "quats", "weights")
    )


def test_copies_of_a_vertex_follow_the_same_bones() -> None:
    rest, offsets = waving()
    twice = torch.cat((torch.arange(len(rest)), torch.arange(0, len(rest), 3)))
    rig = fit_rig(rest[twice], offsets[:, twice], 0.0, 6)
    assert torch.equal(rig.weights[len(rest) :], rig.weights[: len(rest) : 3])
    assert torch.equal(rig.bones[len(rest) :], rig.bones[: len(rest) : 3])


def test_parents_come_before_their_children(twelve_bones: Rig) -> None:
    parents = twelve_bones.parents.tolist()
    assert parents[0] == -1
    assert all(0 <= parent < bone for bone, parent in enumerate(parents) if bone)


def test_bones_turn_without_jumps_of_sign() -> None:
    rest = box((0.0, 0.0, 0.0), torch.Generator().manual_seed(0))
    angles = torch.linspace(0, 2 * math.pi, FRAMES)
    turns = quat_to_rotmat(torch.stack((torch.cos(angles / 2), *[0 * angles] * 2, torch.sin(angles / 2)), 1))
    rig = fit_rig(rest, rest @ turns.mT - rest, 1e-3, 4)
    torch.testing.assert_close(rig.quats[-1], -rig.quats[0], atol=1e-5, rtol=0)  # a whole turn is the other sign
    assert ((rig.quats[1:] * rig.quats[:-1]).sum(-1) > 0.9).all()


def test_where_the_mesh_lies_does_not_matter() -> None:
    rest, offsets = two_boxes()
    far = fit_rig(rest.double() + 50, offsets.double(), 1e-3, 16)
    assert (len(far.rest_positions), far.max_distance < 1e-6) == (2, True)


def test_numbers_that_are_not_finite_are_refused() -> None:
    rest, offsets = two_boxes()
    offsets[3, 4, 1] = torch.nan
    with pytest.raises(BadInput, match="finite"):
        fit_rig(rest, offsets, 0.1, 4)


def test_frames_are_needed() -> None:
    with pytest.raises(BadInput, match="frames"):
        fit_rig(torch.zeros(3, 3), torch.zeros(0, 3, 3), 0.1, 4)


def test_convex_weights_are_the_best_there_are() -> None:
    generator = np.random.default_rng(0)
    for _ in range(20):
        arms, goal = generator.normal(size=(6, 4)), generator.normal(size=6)
        gram, given = arms.T @ arms, arms.T @ goal
        found = module._convex_weights(gram[None], given[None])[0]
        sought = minimize(
            lambda w, gram=gram, given=given: w @ gram @ w - 2 * w @ given,
            np.full(4, 0.25),
            bounds=[(0, 1)] * 4,
            constraints={"type": "eq", "fun": lambda w: w.sum() - 1},
            tol=1e-12,
        )
        np.testing.assert_allclose(found, sought.x, atol=1e-5)  # SLSQP's accuracy


def test_rigid_fits_undo_a_rigid_motion() -> None:
    rest, offsets = (part.double().numpy() for part in two_boxes())
    maps = module.rigid_maps(rest[:200], offsets[:, :200].swapaxes(0, 1), np.ones((200, 1)))
    np.testing.assert_allclose(module._displaced(rest[:200], maps[0]), offsets[:, :200].swapaxes(0, 1), atol=1e-6)
