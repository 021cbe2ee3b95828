import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.objects.drawing import Painted
from benchmarks.objects.specimens import OBJECTS, SCORED_AZIMUTHS_DEG, read_specimen, render_specimen
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from steps.artifacts.ground_truth import GroundTruth, TrueView
from steps.artifacts.media import read_png, write_png

SIZE = 8  # pixels of synthetic pictures
EVERY_OBJECT = pytest.mark.parametrize("name", OBJECTS)


@cache
def painted(name: str) -> Painted:
    return Painted(OBJECTS[name]())


@EVERY_OBJECT
@pytest.mark.slow
def test_the_motion_is_a_loop_and_nothing_jumps(name):
    at = painted(name).creature.at
    np.testing.assert_allclose(at(0.0), at(1.0), atol=1e-9)
    assert np.linalg.norm(at(1 / 48) - at(0.0), axis=1).max() < 0.15
    assert np.linalg.norm(at(0.5) - at(0.0), axis=1).max() > 0.15


@EVERY_OBJECT
@pytest.mark.slow
def test_it_stays_in_the_picture(name):
    cameras = [OrbitCamera(0, azimuth, width=48, height=48) for azimuth in (0, *SCORED_AZIMUTHS_DEG)]
    for moment in (0.0, 0.3, 0.6):
        alpha = painted(name).draw(moment, cameras)[..., 3]
        assert not alpha[:, [0, -1]].any() and not alpha[:, :, [0, -1]].any()
        assert (alpha > 0.5).float().mean((1, 2)).min() > 0.03


@EVERY_OBJECT
@pytest.mark.slow
def test_it_has_many_colors_and_looks_different_from_every_side(name):
    cameras = [OrbitCamera(0, azimuth, width=48, height=48) for azimuth in (0, 90, 180)]
    cutouts = painted(name).draw(0.1, cameras)
    for cutout in cutouts:
        inside = cutout[cutout[..., 3] > 0.9][:, :3]
        assert inside.std(0).mean() > 0.1
    assert (cutouts[0] - cutouts[1]).abs().mean() > 0.02 and (cutouts[0] - cutouts[2]).abs().mean() > 0.01


@EVERY_OBJECT
@pytest.mark.slow
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
    specimen = render_specimen("excavator", 2, 24)
    azimuths = {camera.azimuth_deg % 360 for camera in specimen.bank.cameras}
    assert not azimuths & {camera.azimuth_deg % 360 for camera in specimen.cameras}
    front = specimen.bank.pictures[specimen.bank.cameras.index(OrbitCamera(0, 0, width=24, height=24))]
    assert (front.float() / 255 - specimen.cutouts).abs().max() < 0.5 / 255 + 1e-6
    assert specimen.views.shape == (4, 2, 24, 24, 4)


def test_the_same_object_is_drawn_twice_alike():
    first, second = (Painted(OBJECTS["excavator"]()).draw(0.2, [OrbitCamera(width=32, height=32)]) for _ in range(2))
    assert torch.equal(first, second)


def frames(folder: Path, pictures: torch.Tensor) -> tuple[Path, ...]:
    folder.mkdir(parents=True)
    for i, picture in enumerate(pictures):
        write_png(folder / f"{i:03d}.png", picture)
    return tuple(sorted(folder.iterdir()))


def bank(folder: Path, moments: list[int], pictures: torch.Tensor) -> Path:
    """One level view of so many moments, side by side."""
    folder.mkdir()
    write_png(folder / "sheet.png", torch.cat(list(pictures), 1))
    view = {"file": "sheet.png", "azimuth": 90.0, "elevation": 0.0, "radius": 2.0}
    about = {"frames": moments, "tile": [1, len(moments)], "tile_size": SIZE, "views": [view]}
    (folder / "bank.json").write_text(json.dumps(about))
    return folder


@pytest.fixture
def truth(tmp_path: Path) -> GroundTruth:
    """Six frames from two sides, every second of them in the bank."""
    shown = torch.rand(2, 6, SIZE, SIZE, 4, generator=torch.Generator().manual_seed(0))
    return GroundTruth(
        name="cat",
        inputs=frames(tmp_path / "input", shown[0]),
        views=(TrueView(azimuth_deg=15, frames=frames(tmp_path / "view_15", shown[1])),),
        bank=bank(tmp_path / "bank", [0, 2, 4], 1 - shown[0, ::2]),
    )


def test_of_a_data_set_every_second_frame_is_taken_and_what_the_bank_knows_of_it(truth):
    half = read_specimen(truth, 3)
    assert torch.equal(half.cutouts, torch.stack([read_png(path) for path in truth.inputs[::2]]))
    assert torch.equal(half.views[0], torch.stack([read_png(path) for path in truth.views[0].frames[::2]]))
    assert half.cameras == (OrbitCamera(0, 15, width=SIZE, height=SIZE),)
    assert half.bank.frames == (0, 1, 2) and half.bank.cameras[0].azimuth_deg == 90
    assert (half.bank.pictures[0].float() / 255 + half.cutouts - 1).abs().max() < 1.01 / 255
    assert read_specimen(truth, 6).bank.frames == (0, 2, 4)
    assert read_specimen(truth, 2).bank.frames == (0,)


def test_of_a_picture_the_first_frame_of_every_view_is_taken(truth):
    still = read_specimen(truth.model_copy(update={"inputs": truth.inputs[:1]}), 3)
    assert len(still.cutouts) == 1 and still.views.shape == (1, 1, SIZE, SIZE, 4)


def test_a_data_set_that_lacks_something_is_refused(truth, tmp_path):
    late = bank(tmp_path / "late", [2], torch.ones(1, SIZE, SIZE, 4))
    large = frames(tmp_path / "large", torch.ones(6, 2 * SIZE, 2 * SIZE, 4))
    opaque = frames(tmp_path / "opaque", torch.ones(6, SIZE, SIZE, 3))
    for change, message in (
        ({"bank": None}, "cat has no bank/"),
        ({"bank": late}, "has no frame 0"),
        ({"views": ()}, "cat has no view_<azimuth>/"),
        ({"views": (TrueView(azimuth_deg=15, frames=large),)}, "16 x 16 x 4, 8 x 8 x 4"),
        ({"inputs": opaque}, "8 x 8 x 3, 8 x 8 x 4"),
    ):
        with pytest.raises(BadInput, match=message):
            read_specimen(truth.model_copy(update=change), 3)
