import io
from pathlib import Path

import pytest
from rich.console import Console

from flows.commands.batch import print_summary
from flows.commands.terminal import (
    BatchTable,
    StepBars,
    batch_shown,
    console,
    numbers,
    print_package,
    print_rows,
    print_tables,
    steps_shown,
)
from flows.engine.events import StepEvent, emit
from flows.packages.summary import Row

EVENT = StepEvent("newt", "fit_gaussians", "progress", done=114, total=250, values={"loss": 9.437, "reference": 12.57})


def test_numbers_say_how_far_and_how_good():
    assert numbers(EVENT) == "114/250  loss 9.437  reference 12.57"
    assert numbers(EVENT, 1) == "114/250  loss 9.437"


@pytest.mark.parametrize(
    ("width", "shown", "hidden"), [(80, "loss 9.437", "reference"), (160, "reference 12.57", None)]
)
def test_the_loss_of_a_step_fits_on_a_terminal_of_any_width(width: int, shown: str, hidden: str | None):
    screen = io.StringIO()
    bars = StepBars(Console(file=screen, width=width, force_terminal=True, color_system=None))
    with bars.progress:
        bars(EVENT)
    text = screen.getvalue()
    assert "fit_gaussians" in text
    assert "…" not in text
    assert shown in text
    assert hidden is None or hidden not in text


def test_what_the_library_has_to_say_is_shown():
    note = StepEvent("newt", "fit_gaussians", "note", text="compiling kernels")
    for interactive in (True, False):
        screen = io.StringIO()
        with steps_shown(Console(file=screen, width=100, force_terminal=interactive, color_system=None)):
            emit(note)
        assert "compiling kernels" in screen.getvalue()


def test_the_error_of_an_item_of_a_batch_is_printed_when_it_happens_and_at_the_end(tmp_path: Path) -> None:
    screen = io.StringIO()
    out, row = Console(file=screen, soft_wrap=True), Row(item="fox", status="failed", message="row 1: no subject")
    BatchTable(["fox"]).show(row, out)
    print_summary([row], tmp_path, out)
    assert screen.getvalue().splitlines()[:2] == [
        "fox: failed row 1: no subject",
        "failed: fox: row 1: no subject",
    ]


def test_rows_stand_in_columns_and_words_in_brackets_stay():
    screen = io.StringIO()
    print_rows(Console(file=screen, width=200), [("a", "whole", ""), ("asset.glb", "altered", "[why]")])
    assert screen.getvalue() == "a          whole\nasset.glb  altered  [why]\n"


def test_tables_for_programs_are_not_wrapped(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    name = "n" * 120
    print_tables(console(), [("objects", [{"object": name, "psnr": "1.0"}])])
    print_package(console(), Path("out"), {name: 1})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if "nn" in line] == [name, name]


def test_a_long_batch_shows_what_runs_and_what_failed_last_and_no_more_than_fits():
    table = BatchTable([f"item-{i:04d}" for i in range(1000)])
    for i in range(900):
        table.settle(f"item-{i:04d}", "failed" if i % 2 else "done", "no reason")
    table(StepEvent("item-0901", "fit_gaussians", "started"))
    screen = io.StringIO()
    Console(file=screen, width=120, color_system=None).print(table)
    text = screen.getvalue()
    assert "900 of 1000" in text
    assert "item-0901" in text and "item-0899" in text
    assert "item-0001" not in text and "item-0898" not in text
    assert len(text.splitlines()) < 40


def test_an_item_that_is_tried_again_is_running_again():
    table = BatchTable(["a"])
    table.settle("a", "failed", "crashed")
    table(StepEvent("a", "fit_gaussians", "started"))
    assert table.status["a"] == "running"


NASTY = "[/x] [bold]\x1b[31m\x07 fox"
SHOWN = r"[/x] [bold]\x1b[31m\x07 fox"


def test_names_and_messages_are_shown_letter_by_letter(capsys: pytest.CaptureFixture[str]) -> None:
    console().print(f"{NASTY}: failed", markup=False)
    assert capsys.readouterr().out == f"{SHOWN}: failed\n"

    table = BatchTable([NASTY])
    table.settle(NASTY, "failed", NASTY)
    screen = io.StringIO()
    terminal = Console(file=screen, width=200, force_terminal=True, color_system=None)
    bars = StepBars(terminal)
    with bars.progress:
        bars(StepEvent("a", "fit_motion", "note", text=NASTY))
    assert SHOWN in screen.getvalue()
    terminal.print(table)
    assert screen.getvalue().count(SHOWN) >= 3
    print_package(terminal, Path(NASTY), {"[a] name that is as long as that of its folder": 1})
    assert screen.getvalue().count(SHOWN) >= 4 and "[a] name" in screen.getvalue()
    assert "\x07" not in screen.getvalue() and "\x1b[31m" not in screen.getvalue()


def narrow(screen: io.StringIO, interactive: bool) -> Console:
    return Console(
        file=screen, width=40, force_terminal=interactive, color_system=None, soft_wrap=not interactive, highlight=False
    )


REMARK = StepEvent("newt", "prepare_subject", "remark", text="This is a guess. Source, matte and cut-out: /a/b.png")


@pytest.mark.parametrize("interactive", [True, False])
def test_a_remark_stays_on_the_screen_in_one_piece(interactive: bool):
    screen = io.StringIO()
    with steps_shown(narrow(screen, interactive)):
        emit(REMARK)
        emit(StepEvent("newt", "prepare_subject", "finished", seconds=1.0))
    assert "prepare_subject: This is a guess. Source, matte and cut-out: /a/b.png\n" in screen.getvalue()


@pytest.mark.parametrize("interactive", [True, False])
def test_a_batch_shows_remarks_with_their_item(interactive: bool):
    screen = io.StringIO()
    with batch_shown(narrow(screen, interactive), ["newt"]) as table:
        emit(REMARK)
    assert f"newt: prepare_subject: {REMARK.text}\n" in screen.getvalue()
    assert table.status["newt"] == "waiting"
