"""What Prefect is told about the task of a step."""

from pathlib import Path

import pytest

from flows.engine import tasks


def test_runs_for_different_items_and_steps_have_the_same_tags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prefect keeps a thread and a client for every set of tags that it has seen, as long as the process lives."""
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    one, other = (tasks._task(step) for step in ("fit_motion", "fit_gaussians"))
    assert set(one.tags) == set(other.tags) == {"resource:gpu"}
    assert (one.name, one.task_run_name) == ("fit_motion", "{label}: {item}")
