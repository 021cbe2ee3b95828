"""Foreign text as terminals, spreadsheets and the Markdown of a browser show it."""

import csv
import io

import pytest

from flows.formatting.escaping import csv_cell, markdown, visible

NASTY = (
    "![](http://tracker) | <img src=x onerror=alert(1)>\n# `a` *b* _c_ [d](e) ~~f~~ www.g.com h@i.com 1. -j \\ &amp;"
)


def test_a_terminal_gets_nothing_that_it_would_obey() -> None:
    assert visible("a\x1b[31mb\rc\x07d\x9b2Je\u202ef\udce9\0") == r"a\x1b[31mb\rc\x07d\x9b2Je\u202ef\udce9\x00"
    assert visible("Tab\tund Zeile\nbleiben, 猫 🦎 é auch") == "Tab\tund Zeile\nbleiben, 猫 🦎 é auch"
    for code in (*range(32), 127, *range(128, 160), 0xD800, 0xDFFF):
        shown = visible(chr(code))
        assert shown == chr(code) if chr(code) in "\t\n" else shown.isascii() and shown.isprintable()


@pytest.mark.parametrize("text", ["=cmd|calc!A1", "@SUM(1)", "+1", "-1", "\tx", "\r=1", "\uff1d1"])
def test_a_formula_becomes_text(text: str) -> None:
    assert csv_cell(text) == f"'{text}"


@pytest.mark.parametrize("value", [-1, -1.5, 0, None, "", "a=b", "1", True])
def test_what_is_no_formula_stays(value: object) -> None:
    assert csv_cell(value) is value


def test_markdown_has_no_letter_left_that_means_something() -> None:
    shown = markdown(NASTY)
    assert "\n" not in shown
    for letter in "`*[]<>#|~@&":
        assert shown.count(letter) == shown.count(f"\\{letter}") == NASTY.count(letter)
    assert "http://" not in shown and "www." not in shown and r" \_c\_ " in shown


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("fit_motion, 3.5 s (a-b)", "fit_motion, 3.5 s (a-b)"), ("1. one", r"1\. one"), ("- one", r"\- one"),
        ("===", r"\==="), ("---", r"\---"), ("12) x", r"12\) x"), ("HTTPS://x WWW.y", r"HTTPS\://x WWW\.y"),
    ],
)  # fmt: skip
def test_markdown_leaves_what_means_nothing_where_it_stands(text: str, shown: str) -> None:
    assert markdown(text) == shown


def test_a_table_with_a_nasty_cell_has_the_cells_that_it_should_have() -> None:
    lines = io.StringIO()
    csv.writer(lines).writerow([csv_cell(NASTY), csv_cell("=1"), csv_cell(2.5)])
    (row,) = csv.reader(io.StringIO(lines.getvalue(), newline=""))
    assert row == [NASTY, "'=1", "2.5"]
