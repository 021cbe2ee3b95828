"""The page of a catalog: what stands first, what is shown of an item, how large it may be."""

import base64
import io
import random
import re
from pathlib import Path

import pytest
from PIL import Image

from flows.packages.summary import NOT_ACCEPTED, Row
from flows.ui import gallery, pages
from flows.ui.gallery import PICTURE_SIZE, PICTURES_BYTES, ROWS_SHOWN, gallery_page, small_picture, verdict

MOST_BYTES = 100_000  # of a page in the server's database


def noise(folder: Path, name: str, size: int = 256) -> None:
    """Write a picture that is hard to compress, of two frames where the format moves."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = [Image.frombytes("RGBA", (size, size // 2), random.Random(i).randbytes(size * size * 2)) for i in (0, 1)]
    moving = {"save_all": True, "append_images": frames[1:]} if name.endswith(".webp") else {}
    frames[0].save(folder / name, **moving)


def cells(page: str) -> list[list[str]]:
    """Rows of the table, without its head."""
    lines = [line for line in page.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


def test_an_item_has_a_small_picture_a_verdict_and_a_link_to_its_page(tmp_path: Path) -> None:
    noise(tmp_path / "fox", "preview.webp")
    row = Row(item="fox", status="done", failing=[], wall_s=12.3)
    (shown,) = cells(gallery_page("animals", "1 of 1 items", [row], tmp_path))
    picture, item, said, seconds, _ = shown
    content = base64.b64decode(picture.partition("base64,")[2].rstrip(")"))
    with Image.open(io.BytesIO(content)) as small:
        assert (small.format, small.size) == ("WEBP", (PICTURE_SIZE, PICTURE_SIZE // 2))
    assert item == f"[fox](/artifacts/key/{pages.key('asset', 'fox')})"
    assert (said, seconds) == ("accepted", "12")


def test_what_failed_stands_first_then_what_is_not_accepted(tmp_path: Path) -> None:
    rows = [
        Row(item="good", status="done", failing=[]),
        Row(item="torn", status="done", failing=["silhouette"]),
        Row(item="bad", status="failed", message="not a picture"),
    ]
    shown = cells(gallery_page("mixed", "", rows, tmp_path))
    assert [(row[1].partition("]")[0].strip("["), row[4].strip("| ")) for row in shown] == [
        ("bad", "not a picture"), ("torn", "silhouette"), ("good", ""),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("row", "said"),
    [
        (Row(item="a", status="done"), "made"),
        (Row(item="a", status="unchanged", failing=[]), "accepted"),
        (Row(item="a", status="done", failing=["motion"]), "not accepted"),
        (Row(item="a", status="failed", kind=NOT_ACCEPTED, failing=["motion"]), "not accepted"),
        (Row(item="a", status="failed"), "failed"),
        (Row(item="a", status="skipped"), "skipped"),
    ],
)
def test_a_verdict_is_a_word_or_two(row: Row, said: str) -> None:
    assert verdict(row) == said


def test_a_page_of_a_large_catalog_is_no_larger_than_its_place_in_the_database(tmp_path: Path) -> None:
    rows = []
    for i in range(3 * ROWS_SHOWN):
        rows.append(Row(item=f"{i:03d}", status="done", failing=[]))
        noise(tmp_path / f"{i:03d}", "contact_sheet.png", 96)
    page = gallery_page("many", "300 of 300 items", rows, tmp_path)
    pictures = re.findall(r"base64,([^)]+)\)", page)
    assert 5 < len(pictures) < ROWS_SHOWN
    assert sum(len(base64.b64decode(picture)) for picture in pictures) <= PICTURES_BYTES
    assert len(page.encode()) <= MOST_BYTES
    assert len(cells(page)) == ROWS_SHOWN and "all are in summary.csv" in page


def test_names_cannot_add_cells_or_links(tmp_path: Path) -> None:
    row = Row(item="a|b](http://x)", status="failed", message="<b>| no |</b>\n| x |")
    page = gallery_page("a|b", "", [row], tmp_path)
    assert "](http://x)" not in page and "<b>" not in page
    assert len([line for line in page.splitlines() if line.startswith("|")]) == 3


def test_a_picture_that_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    assert small_picture(tmp_path) is None
    (tmp_path / gallery.PICTURES[1]).write_bytes(b"\x89PNG broken")
    assert small_picture(tmp_path) is None
