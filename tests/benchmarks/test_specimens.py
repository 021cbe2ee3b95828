from functools import cache

import numpy as np
import pytest
import torch

from benchmarks.objects.drawing import Painted
from benchmarks.objects.specimens import OBJECTS, SCORED_AZIMUTHS_DEG, made, read
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from steps.truth import Truth

EVERY_OBJECT = pytest.mark.parametrize("name", OBJECTS)


@cache
def painted(name: str) -> Painted:
    return Painted(OBJECTS[name]())


@EVERY_OBJECT
def test_the_motion_is_a_loop_and_nothing_jumps(name):
    at = painted(name).creature.at
    np.testing.assert_allclose(at(0.0), at(1.0), atol=1e-9)
    assert np.linalg.norm(at(1 / 48) - at(0.0), axis=1).max() < 0.15
    assert np.linalg.norm(at(0.5) - at(0.0), axis=1).max() > 0.15


@EVERY_OBJECT
def test_it_stays_in_the_picture(name):
    cameras = [OrbitCamera(0, azimuth, width=48, height=48) for azimuth in (0, *SCORED_AZIMUTHS_DEG)]
    for moment in (0.0, 0.3, 0.6):
        alpha = painted(name).draw(moment, cameras)[..., 3]
        assert not alpha[:, [0, -1]].any() and not alpha[:, :, [0, -1]].any()
        assert (alpha > 0.5).float().mean((1, 2)).min() > 0.03


@EVERY_OBJECT
def test_it_has_many_colors_and_looks_different_from_every_side(name):
    cameras = [OrbitCamera(0, azimuth, width=48, height=48) for azimuth in (0, 90, 180)]
    cutouts = painted(name).draw(0.1, cameras)
    for cutout in cutouts:
        inside = cutout[cutout[..., 3] > 0.9][:, :3]
        assert inside.std(0).mean() > 0.1
    assert (cutouts[0] - cutouts[1]).abs().mean() > 0.02 and (cutouts[0] - cutouts[2]).abs().mean() > 0.01


@EVERY_OBJECT
def test_its_surface_is_closed_at_every_moment(name):
    edges = np.sort(painted(name).faces.numpy()[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert np.isfinite(painted(name).creature.at(0.37)).all()


def test_parts_of_the_excavator_are_stiff():
    machine = painted("excavator").creature
    for number in range(5):
        part = np.flatnonzero(machine.part == number)[::97]
        lengths = [np.linalg.norm(np.diff(machine.at(moment)[part], axis=0), axis=1) for moment in (0.0, 0.4)]
        np.testing.assert_allclose(*lengths, atol=1e-9)


def test_what_is_scored_is_not_in_the_bank_and_the_bank_tells_the_truth():
    specimen = made("excavator", 2, 24)
    azimuths = {camera.azimuth_deg % 360 for camera in specimen.bank.cameras}
    assert not azimuths & {camera.azimuth_deg % 360 for camera in specimen.cameras}
    front = specimen.bank.pictures[specimen.bank.cameras.index(OrbitCamera(0, 0, width=24, height=24))]
    assert (front.float() / 255 - specimen.cutouts).abs().max() < 0.5 / 255 + 1e-6
    assert specimen.views.shape == (4, 2, 24, 24, 4)


def test_the_same_object_is_drawn_twice_alike():
    first, second = (Painted(OBJECTS["excavator"]()).draw(0.2, [OrbitCamera(width=32, height=32)]) for _ in range(2))
    assert torch.equal(first, second)


def test_a_data_set_without_a_bank_is_refused(tmp_path):
    with pytest.raises(BadInput, match="no bank"):
        read(Truth(name="cat", inputs=(tmp_path / "0.png",)), 4)
