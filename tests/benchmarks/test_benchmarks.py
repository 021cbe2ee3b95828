"""Benchmarks and experiments are run by hand; what they use of the product must still be there."""

import importlib
from pathlib import Path

import pytest
import torch

import benchmarks
import experiments
from benchmarks import preview
from benchmarks.paper_schedule import QUICK, Schedule, Sizes
from dg4d_lib.rasterizer.interface import preferred_device
from steps.profiles import profile, revise

NAMES = sorted(
    f"{package.__name__}.{path.stem}"
    for package in (benchmarks, experiments)
    for path in Path(package.__path__[0]).glob("[!_]*.py")
)


@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_finds_what_it_uses(name: str) -> None:
    module = importlib.import_module(name)
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    assert ('__name__ == "__main__"' in source) == hasattr(module, "main")


@pytest.mark.gpu
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:There are modules in")
def test_the_paper_schedule_is_measured_stage_by_stage() -> None:
    device = preferred_device("auto")
    rows = list(Schedule(revise(profile("paper"), QUICK), Sizes(), device).rows())
    assert [row.stage for row in rows] == ["video", "static", "dynamic", "refinement"]
    assert all(row.tflop > 0 and 0 < row.outside_networks < 1 for row in rows)
    assert all(bool(row.peak_gib) == torch.cuda.is_available() for row in rows)


def test_stages_before_and_after_are_medians_over_turns(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    taken = {"before": iter([(3.0, 6.0), (5.0, 9.0), (4.0, 8.0)]), "after": iter([(1.0, 2.0), (1.5, 3.0), (9.0, 9.0)])}
    calls = []

    def convert(picture, side, changes):
        calls.append(side.name)
        if preview.SMALL[0] in changes:
            return {}
        times = {"fit_motion": next(taken[side.name]), "command to package": (10.0, 0.0)}
        return {"plan_mesh": (0.5, 0.5), **times} if side.name == "after" else times

    monkeypatch.setattr(preview, "convert", convert)
    sides = preview.Side("before", tmp_path), preview.Side("after", tmp_path)
    rows = {row.stage: row for row in preview.compare(tmp_path / "newt.png", sides, 3, ())}
    assert calls == ["before", "after", "before", "after", "after", "before", "before", "after"]
    assert rows["fit_motion"] == preview.Row("fit_motion", 4.0, 1.5, 8.0, 3.0)
    assert rows["plan_mesh"] == preview.Row("plan_mesh", 0.0, 0.5, 0.0, 0.5)
