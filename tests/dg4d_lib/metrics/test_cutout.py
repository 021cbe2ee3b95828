import numpy as np
import pytest
import torch

from dg4d_lib.asset_settings import CutoutGateSettings
from dg4d_lib.metrics.cutout import border_share, evaluate_cutout, hole_share, loose_share


def square(size: int = 100, top: int = 20, bottom: int = 80) -> np.ndarray:
    mask = np.zeros((size, size), bool)
    mask[top:bottom, top:bottom] = True
    return mask


def failing(mask: np.ndarray, agreement: float | None = 1.0) -> list[str]:
    gates = evaluate_cutout(torch.from_numpy(mask)[None].float(), agreement, CutoutGateSettings())
    return [gate.name for gate in gates if not gate.passed]


def test_a_whole_cutout_passes_every_gate():
    assert failing(square()) == []


def test_a_second_piece_counts_by_its_area():
    mask = square()
    mask[90:100, 0:100] = True
    assert loose_share(mask) == pytest.approx(1000 / 4600)
    assert failing(mask) == ["cut-out pieces"]


def test_holes_count_and_pin_holes_do_not():
    mask = square()
    mask[40:60, 30:70] = False
    mask[25, 25] = False
    assert hole_share(mask) == pytest.approx(800 / 3600)
    assert failing(mask) == ["cut-out holes"]


def test_a_cutout_that_covers_most_of_the_border_is_background():
    mask = ~square()
    mask[50, :] = True
    assert border_share(mask) == 1
    assert "cut-out border" in failing(mask)


def test_the_border_is_a_hundredth_of_the_longest_side_wide():
    mask = np.zeros((100, 300), bool)
    mask[3:-3, 3:-3] = True
    assert (border_share(mask), border_share(~mask)) == (0, 1)
    mask[2, 2] = True  # on the third line from the edge
    assert border_share(mask) == pytest.approx(1 / (100 * 300 - 94 * 294))
    tiny = np.zeros((9, 9), bool)
    tiny[0] = True  # a hundredth of nine pixels is at least one pixel
    assert border_share(tiny) == 9 / 32


def test_pixels_belong_to_the_cutout_from_half_of_their_alpha():
    alpha = torch.from_numpy(square())[None].float()
    alpha[0, 90:100] = 0.49
    assert evaluate_cutout(alpha, None, CutoutGateSettings())[0].value == 0
    alpha[0, 90:100] = 0.51
    assert evaluate_cutout(alpha, None, CutoutGateSettings())[0].value == pytest.approx(1000 / 4600)


def test_two_methods_that_disagree_fail_and_a_single_one_is_not_judged():
    assert failing(square(), 0.4) == ["cut-out agreement"]
    gates = evaluate_cutout(torch.from_numpy(square())[None].float(), None, CutoutGateSettings())
    assert [gate.name for gate in gates] == ["cut-out pieces", "cut-out holes", "cut-out border"]


def test_the_worst_frame_counts():
    torn = square()
    torn[45:55] = False
    gates = evaluate_cutout(torch.from_numpy(np.stack([square(), torn])).float(), None, CutoutGateSettings())
    assert gates[0].value == pytest.approx(0.5)


def test_an_empty_cutout_is_measured_without_an_error():
    assert (loose_share(np.zeros((9, 9), bool)), hole_share(np.zeros((9, 9), bool))) == (0, 0)
