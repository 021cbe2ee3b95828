"""The figures of meshes in packages."""

from pathlib import Path

import pytest

from benchmarks.meshes import Row, atlas_table, mean_row, measure, measure_atlas, table
from tests.steps.small_package import packed


@pytest.mark.parametrize(
    ("mode", "moments"), [("tracked", ["rest", "mean", "worst"]), ("per_frame", ["mean", "worst"])]
)
def test_a_clean_package_has_clean_figures(tmp_path: Path, mode: str, moments: list[str]) -> None:
    rows = list(measure(packed(tmp_path, mode)))
    assert [row.moment for row in rows] == moments
    assert all((row.crossing, row.flipped, row.folds, row.genus) == (0, 0, 0, 0) for row in rows)
    assert all(row.deviation_deg == pytest.approx(41.8, abs=0.1) for row in rows)  # an icosahedron
    assert table(rows).row_count == len(rows)


def test_packages_have_a_mean() -> None:
    rows = [Row(name, "worst", 100, share, 0, share, 0, 10, 1) for name, share in (("a", 1.0), ("b", 3.0))]
    assert mean_row(rows) == Row("mean", "worst", 100, 2, 0, 2, 0, 10, 1)


@pytest.mark.parametrize("mode", ["tracked", "per_frame"])
def test_the_atlas_of_a_package_is_measured(tmp_path: Path, mode: str) -> None:
    """All its texture coordinates are equal."""
    quality = measure_atlas(packed(tmp_path, mode))
    assert (quality.islands, quality.mirrored, quality.coverage, quality.seam_mean) == (1, 0, 0, 0)
    assert atlas_table({"a": quality, "b": quality}).row_count == 2
