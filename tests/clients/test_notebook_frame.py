"""An asset in a notebook, in a real browser: it plays in its frame, and the frame reaches nothing."""

from pathlib import Path

from node import run_node

import dg4d
from flows.inputs.package_record import RECORD
from tests.dg4d.recording import add_record
from tests.steps.small_package import packed


def test_the_viewer_plays_in_a_frame_that_cannot_reach_the_notebook(tmp_path: Path) -> None:
    folder = packed(tmp_path)
    add_record(folder)
    assert (folder / RECORD).is_file()
    (tmp_path / "cell.html").write_text(dg4d.load(folder)._repr_html_(), encoding="utf-8")
    said = run_node("frame.mjs", str(tmp_path / "cell.html"))
    assert said["ready"] and said["drawn"] > 0.005
    assert not said["reached"] and said["requests"] == []
