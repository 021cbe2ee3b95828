from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from flows import home
from flows.convert import prepare
from flows.engine import executors
from flows.engine.versions import has_version, keep_version
from flows.inputs.conversion_job import ConversionRequest
from steps.profiles import PREVIEW


def test_processes_for_steps_begin_only_where_the_order_was_not_finished_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    begun: list[str] = []
    monkeypatch.setattr(executors, "prepare", lambda: begun.append("processes"))
    Image.new("RGBA", (8, 8)).save(tmp_path / "a.png")
    jobs = [
        ConversionRequest(item="a", picture=tmp_path / "a.png", profile="preview", settings=PREVIEW, seed=seed).to_job(
            home.store()
        )
        for seed in range(2)
    ]
    prepare(jobs[0])
    assert len(begun) == 1
    made: Any = SimpleNamespace(package=home.store().put_bytes(b"package", "a/b"), steps=[])
    keep_version(home.store(), jobs[0], made)
    assert [has_version(home.store(), job) for job in jobs] == [True, False]
    for job in jobs:
        prepare(job)
    assert len(begun) == 2
