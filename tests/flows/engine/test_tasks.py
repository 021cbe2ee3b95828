"""What Prefect is told about the task of a step."""

from pathlib import Path

import pytest

from flows.engine import tasks


def test_runs_for_different_items_have_the_same_tags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prefect keeps a thread and a client for every set of tags that it has seen, as long as the process lives."""
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    one, other = (tasks._task("fit_motion", item, "fit_motion") for item in ("fox", "owl"))
    assert set(one.tags) == set(other.tags) == {"step:fit_motion", "resource:gpu"}
    assert "fox" in str(one.task_run_name)
