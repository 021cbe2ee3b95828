import pytest
import torch

from experiments.flicker import ERRORS_DEG, FRONT, OWN, measure_object, table


@pytest.mark.slow
def test_a_true_film_seen_beside_the_truth_flickers_more_than_one_that_stands_still() -> None:
    rows = {row.film: row for row in measure_object("jellyfish", frames=6, size=64)}
    off = [rows[f"ground truth, {degrees} degrees off"] for degrees in ERRORS_DEG]
    assert [row.flicker for row in off] == sorted(row.flicker for row in off)
    assert [row.temporal_error for row in off] == sorted(row.temporal_error for row in off)
    assert off[-1].flicker > rows[FRONT].flicker
    assert off[-1].temporal_error < 0.5 < rows[FRONT].temporal_error
    torch.testing.assert_close(rows[OWN].temporal_error, 1.0)
    assert table(list(rows.values())).row_count == len(rows)
