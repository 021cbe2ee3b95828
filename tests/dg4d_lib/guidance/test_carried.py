"""Fields carried by the video: a rigid box that turns in the image plane keeps its back."""

import math
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance import carried as module
from dg4d_lib.guidance.carried import EDGE_ON, CarriedFields, carry
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.learned import LearnedShapes
from dg4d_lib.settings import LearnedPriorSettings
from dg4d_lib.shape_prior.field import LARGEST_LOGIT, InflatedFields, ShapeField, bounded_logits
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV
from dg4d_lib.video.first_frame import Correspondence

BLUE, YELLOW = torch.tensor([0.1, 0.1, 0.9]), torch.tensor([0.9, 0.8, 0.1])
MIDDLE = (SIZE - 1) / 2
LONG, SHORT = 40.0, 16.0  # half sides of the box on the picture, pixels
TURN_DEG = 10.0
FRAMES = 4
DEPTHS = NEAR + (torch.arange(BINS) + 0.5) * (FAR - NEAR) / BINS


def on_box(angle_deg: float) -> tuple[Tensor, Tensor]:
    """Return the place of every pixel along and across the turned box."""
    rows, columns = (axis - MIDDLE for axis in torch.meshgrid(*[torch.arange(SIZE).float()] * 2, indexing="ij"))
    angle = math.radians(angle_deg)
    return math.sin(angle) * rows + math.cos(angle) * columns, math.cos(angle) * rows - math.sin(angle) * columns


def box(angle_deg: float) -> ShapeField:
    """Return the field of a turned box: one half is thin and far away, with a yellow back; the other is blue."""
    along, across = on_box(angle_deg)
    mask = (along.abs() < LONG) & (across.abs() < SHORT)
    far = (along > 0)[..., None]
    inside = torch.where(far, (DEPTHS > 2.2) & (DEPTHS < 2.4), (DEPTHS > 1.7) & (DEPTHS < 2.4))
    logits = bounded_logits(torch.where(inside, LARGEST_LOGIT, -LARGEST_LOGIT), mask)
    hidden = torch.where(far[..., None], YELLOW, BLUE).expand(-1, -1, BINS, -1)
    return ShapeField(logits, picture(angle_deg)[..., :3], hidden, mask, 0.0)


def picture(angle_deg: float) -> Tensor:
    along, across = on_box(angle_deg)
    alpha = ((LONG - along.abs()).clamp(0, 1) * (SHORT - across.abs()).clamp(0, 1))[..., None]
    pattern = 0.5 + 0.4 * torch.sin(along / 5) * torch.cos(across / 4)
    return torch.cat([pattern[..., None].expand(-1, -1, 3), alpha], -1)


def carried(pictures: list[Tensor]) -> CarriedFields:
    return CarriedFields(InflatedFields(pictures), box(0), pictures)


def test_a_box_that_turns_in_the_image_plane_keeps_its_depth_and_its_back():
    fields = carried([picture(TURN_DEG * frame) for frame in range(FRAMES)])
    angle = TURN_DEG * (FRAMES - 1)
    found, truth = fields.predict(FRAMES - 1), box(angle)
    filled, true = found.logits > 0, truth.logits > 0
    assert (filled & true).sum() / (filled | true).sum() > 0.9
    along, _ = on_box(angle)
    inner = truth.mask & (along.abs() > 6) & (along.abs() < LONG - 4)
    assert (found.hidden[inner] - truth.hidden[inner]).abs().mean() < 0.05
    guess = InflatedFields([picture(angle)]).predict(0).logits > 0
    assert (guess & true).sum() / (guess | true).sum() < 0.5  # nothing of it is in the last frame alone


def test_views_of_other_sides_show_the_turned_box():
    pictures = [picture(TURN_DEG * frame) for frame in range(FRAMES)]
    known = _Known(box(TURN_DEG * (FRAMES - 1)))
    found, truth = (LearnedShapes(fields, LearnedPriorSettings(contrast=1.2)) for fields in (carried(pictures), known))
    for azimuth in (90, 180, 215):
        camera = OrbitCamera(0, azimuth, width=64, height=64)
        color, alpha = found.clean([GuidanceView(camera, FRAMES - 1)])
        true_color, true_alpha = truth.clean([GuidanceView(camera, 0)])
        filled, true = alpha > 0.5, true_alpha > 0.5
        assert (filled & true).sum() / (filled | true).sum() > 0.75  # soft where the guess differs
        assert (color - true_color).abs().mean() < 0.04


def test_a_frame_that_shows_something_else_keeps_its_own_guess():
    other = picture(0)
    other[..., :3] = torch.tensor([1.0, 0.0, 0.0])
    other[..., 3] = torch.roll(other[..., 3], 1).T
    fields, guess = carried([picture(0), other]), InflatedFields([other]).predict(0)
    found = fields.predict(1)
    apart = found.mask & (box(0).mask == 0)
    assert ((found.logits[apart] > 0) == (guess.logits[apart] > 0)).float().mean() > 0.9
    assert torch.equal(found.front, guess.front) and torch.equal(found.mask, guess.mask)


def test_a_guessed_first_frame_is_carried_along_with_turns_in_the_picture_and_not_with_foreshortened_parts():
    turned, narrow = picture(TURN_DEG), torch.zeros(SIZE, SIZE, 4)
    columns = ((torch.arange(SIZE) - MIDDLE) / 0.6 + MIDDLE).round().long()
    kept = (columns >= 0) & (columns < SIZE)
    narrow[:, kept] = picture(0)[:, columns[kept]]  # the box turned about a vertical axis, from afar
    first = box(0)
    for later, least, most in ((turned, 0.9, 1.0), (narrow, 0.0, 0.3)):
        guess = InflatedFields([picture(0), later])
        free, bound = (CarriedFields(guess, first, [picture(0), later], limit) for limit in (math.inf, 0.2))
        own, all_of_it, some = (fields.predict(1).logits for fields in (guess, free, bound))
        differs = (all_of_it - own).abs() > 1
        assert differs.float().mean() > 0.01
        assert least <= ((some - own) / (all_of_it - own))[differs].median() <= most


def test_threads_follow_the_video_together_and_no_further_than_they_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    followed = []

    def match(pictures: list[Tensor]) -> Iterator[Correspondence]:
        pixels = torch.stack(torch.meshgrid(*[torch.arange(SIZE).float()] * 2, indexing="ij"), -1)
        for frame in range(len(pictures)):
            time.sleep(0.05)  # other threads ask meanwhile
            followed.append(frame)
            yield Correspondence(pixels, torch.ones(SIZE, SIZE))

    monkeypatch.setattr(module, "match_first_frame", match)
    fields = CarriedFields(_Known(box(0)), box(0), [picture(0)] * 5)
    with ThreadPoolExecutor(4) as pool:
        assert len(list(pool.map(fields.predict, (2, 0, 1, 2)))) == 4
    assert followed == [0, 1, 2]


def test_a_guessed_first_frame_is_predicted_once() -> None:
    guess = _Known(box(0))
    fields = CarriedFields(guess, None, [picture(0), picture(TURN_DEG)], 0.2)
    given = CarriedFields(guess, guess.predict(0), [picture(0), picture(TURN_DEG)], 0.2)
    assert guess.asked == [0, 0]
    for frame, asked in ((0, [0]), (1, [1, 1])):  # by those that were given their first frame; by both
        guess.asked.clear()
        one, other = fields.predict(frame), given.predict(frame)
        assert guess.asked == asked
        assert torch.equal(one.logits, other.logits) and torch.equal(one.hidden, other.hidden)


class _Known:
    """One field, known."""

    def __init__(self, field: ShapeField) -> None:
        self._field = field
        self.asked: list[int] = []

    def __len__(self) -> int:
        return 1

    def predict(self, frame: int) -> ShapeField:
        self.asked.append(frame)
        return self._field


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_sideways_motion_in_an_upright_plane_is_one_in_depth(side):
    pixels = torch.stack(torch.meshgrid(*[torch.arange(SIZE).float()] * 2, indexing="ij"), -1)
    shifted = 12
    match = Correspondence(pixels - torch.tensor([0.0, shifted]), torch.ones(SIZE, SIZE))
    normal = np.array([side, 0, 1.0]) / 2**0.5
    still, moved = (carry(box(0), match, one) for one in (None, normal))
    row, column = SIZE // 2, SIZE // 2 - 20 + shifted  # of the near half
    away = side * shifted * 4 * TAN_HALF_FOV / SIZE * 0.5 / (0.5 + EDGE_ON)
    before, after = (DEPTHS[field.logits[row, column] > 0] for field in (still, moved))
    assert before.min() < 1.75 and before.max() > 2.35
    cell = (FAR - NEAR) / BINS
    assert (
        abs(float(after.min() - before.min()) - away) <= cell and abs(float(after.max() - before.max()) - away) <= cell
    )
    assert (moved.hidden[row, column] - BLUE).abs().max() < 1e-5
