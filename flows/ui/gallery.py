"""Gallery of a catalog in the Prefect UI: a progress bar while it runs, then one page with small pictures."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from prefect.artifacts import create_progress_artifact, update_progress_artifact

from flows.formatting.escaping import markdown
from flows.packages.summary import BatchProgress, Row
from flows.ui import pages
from flows.ui.showing import create_page

ROWS_SHOWN = 100  # of the page, which the server keeps in its database
PICTURES_BYTES = 60_000  # of all pictures of a page; as base64 they take a third more
PICTURE_SIZE = 96  # pixels of the longer side
PICTURE_QUALITY = 50  # of WebP
PICTURES = ("preview.webp", "contact_sheet.png")  # of a package, the first that is there
UPDATE_EVERY_S = 3.0


class Gallery:
    """Progress bar and page of a catalog, attached to the current flow run.

    Args:
        title: of the catalog; a colon and the text behind it are left out.
        progress: outcomes of its items.
        out: the folder of their packages.
    """

    def __init__(self, title: str, progress: BatchProgress, out: Path) -> None:
        self._name, self._progress, self._out = title.partition(":")[0], progress, out
        self._key = pages.key("catalog", self._name)
        self._bar: Any = create_progress_artifact(0.0, key=f"progress-{self._key}", description=self._text())
        self._next = 0.0

    def update(self) -> None:
        """Update the progress bar, at most every `UPDATE_EVERY_S` seconds."""
        if time.monotonic() >= self._next:
            update_progress_artifact(self._bar, 100 * self._progress.share, description=self._text())
            self._next = time.monotonic() + UPDATE_EVERY_S

    def finish(self) -> None:
        """Complete the progress bar and create the page."""
        self._next = 0.0
        self.update()
        rows = list(self._progress.rows.values())
        page = gallery_page(self._name, self._progress.line(), rows, self._out)
        create_page(self._key, page, self._text())

    def _text(self) -> str:
        return f"{markdown(self._name)}: {self._progress.line()}"


def gallery_page(name: str, line: str, rows: list[Row], out: Path) -> str:
    """Return the page: failed items first, then those that a gate rejects; at most `ROWS_SHOWN` rows.

    Args:
        name: name of the catalog.
        line: its counts in one line.
        rows: its items.
        out: folder of their packages.
    """
    ordered = sorted(rows, key=lambda row: (row.status != "failed", not row.failing))
    shown = ordered[:ROWS_SHOWN]
    head = [f"# {markdown(name)}", "", line, ""]
    if len(rows) > ROWS_SHOWN:
        head += [f"{ROWS_SHOWN} of {len(rows)} are shown; all are in summary.csv and index.html of the folder.", ""]
    table = ["| | item | result | seconds | |", "|---|---|---|---|---|"]
    return "\n".join([*head, *table, *_lines(shown, out)]) + "\n"


def _lines(rows: list[Row], out: Path) -> Iterator[str]:
    left = PICTURES_BYTES
    for row in rows:
        picture = small_picture(out / row.item) if row.has_package and left > 0 else None
        left -= len(picture or b"")
        image = pages.embedded("", "image/webp", picture) if picture and left >= 0 else ""
        name = markdown(row.item)
        item = f"[{name}](/artifacts/key/{pages.key('asset', row.item)})" if row.has_package else name
        why = markdown(", ".join(row.failing or ()) or row.message)
        yield f"| {image} | {item} | {verdict(row)} | {row.wall_s:.0f} | {why} |"


def verdict(row: Row) -> str:
    """Return the outcome of an item in a word or two."""
    if not row.has_package:
        return row.status
    return "not accepted" if row.failing else "made" if row.failing is None else "accepted"


def small_picture(folder: Path) -> bytes | None:
    """Return a picture of the package in a folder as a small WebP; None if none can be read."""
    picture = next((folder / name for name in PICTURES if (folder / name).is_file()), None)
    return pages.small_webp(picture, PICTURES_BYTES, (PICTURE_SIZE,), (PICTURE_QUALITY,)) if picture else None
