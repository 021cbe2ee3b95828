"""The proof of the profile `open` on a data set of one solid."""

import json
import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "dg4d_lib" / "visual_hull"))
from creatures import creature, seen

from benchmarks import generated_views
from benchmarks.true_views import read_subjects
from dg4d_lib.settings import OraclePriorSettings
from dg4d_lib.visual_hull.known import known_view
from steps.artifacts.archives import unpack
from steps.artifacts.media import write_png
from steps.sources.bank_writer import write_bank

SMALL = ("--set", "subject.size=64")


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a data set of one object that does not move, with a bank from above."""
    root = tmp_path_factory.mktemp("objects")
    thing = root / "thing"
    for name, azimuth in {"input": 0, "view_15": 15, "view_105": 105}.items():
        (thing / name).mkdir(parents=True)
        write_png(thing / name / "000.png", seen(creature(), azimuth, size=64).cutout)
    (thing / "static").mkdir()
    for azimuth in range(45, 360, 45):
        write_png(thing / "static" / f"az_{azimuth:03d}.png", seen(creature(), azimuth, size=64).cutout)
    above = [known_view(seen(creature(), azimuth, size=64).cutout, azimuth) for azimuth in (0, 90)]
    write_bank(root / "bank.zip", [above], root)
    (thing / "bank").mkdir()
    unpack(root / "bank.zip", thing / "bank", "the bank")
    (root / "bank.zip").unlink()
    return root


def test_errors_are_the_knobs_and_spoiled_views_are_upside_down(objects: Path) -> None:
    (subject,) = read_subjects(objects)
    perfect, imperfect, spoiled = (
        generated_views.imperfect_bank(subject, errors, spoil)
        for errors, spoil in ((OraclePriorSettings(), 0), (generated_views.ERRORS, 0), (OraclePriorSettings(), 1))
    )
    assert len(perfect.cameras) == 7
    assert perfect.cameras != imperfect.cameras and not torch.equal(perfect.pictures, imperfect.pictures)
    changed = [not torch.equal(a, b) for a, b in zip(perfect.pictures, spoiled.pictures, strict=True)]
    assert sum(changed) == 1


@pytest.mark.slow
def test_imperfect_views_give_a_shape_that_overlaps_the_true_one(objects: Path, tmp_path: Path) -> None:
    out = tmp_path / "found.json"
    generated_views.main([str(objects), "--first", "--json", str(out), "--sheet", str(tmp_path / "sheet.png"), *SMALL])
    assert json.loads(out.read_text())["thing"]["iou"] > 0.8
    assert (tmp_path / "sheet.png").stat().st_size > 1000
