"""Gallery of a catalog in the Prefect UI: a progress bar while it runs, then one page with small pictures."""

import io
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from PIL import Image
from prefect.artifacts import create_markdown_artifact, create_progress_artifact, update_progress_artifact

from flows.formatting.escaping import markdown
from flows.packages.summary import BatchProgress, Row
from flows.ui import pages
from flows.ui.showing import show

ROWS_SHOWN = 100  # of the page, which the server keeps in its database
PICTURES_BYTES = 60_000  # of all pictures of a page; as base64 they take a third more
PICTURE_SIZE = 96  # pixels of the longer side
PICTURE_QUALITY = 50  # of WebP
PICTURES = ("preview.webp", "contact_sheet.png")  # of a package, the first that is there
UPDATE_EVERY_S = 3.0


class Gallery:
    """Progress bar and page of a catalog, attached to the current flow run.

    Args:
        title: of the catalog; what follows a colon is left out.
        progress: what became of its items.
        out: the folder of their packages.
    """

    def __init__(self, title: str, progress: BatchProgress, out: Path) -> None:
        self._name, self._progress, self._out = title.partition(":")[0], progress, out
        self._key = pages.key("catalog", self._name)
        self._bar: Any = create_progress_artifact(0.0, key=f"progress-{self._key}", description=self._text())
        self._next = 0.0

    def update(self) -> None:
        """Show the progress, unless that was a moment ago."""
        if time.monotonic() >= self._next:
            update_progress_artifact(self._bar, 100 * self._progress.share, description=self._text())
            self._next = time.monotonic() + UPDATE_EVERY_S

    def finish(self) -> None:
        """Show the end, and the page."""
        self._next = 0.0
        self.update()
        rows = list(self._progress.rows.values())
        page = gallery_page(self._name, self._progress.line(), rows, self._out)
        show(create_markdown_artifact, key=self._key, markdown=page, description=self._text())

    def _text(self) -> str:
        return f"{markdown(self._name)}: {self._progress.line()}"


def gallery_page(name: str, line: str, rows: list[Row], out: Path) -> str:
    """Return the page: failed items first, then those that are not accepted; no more rows than can be read.

    Args:
        name: of the catalog.
        line: the numbers of it, in one line.
        rows: of its items.
        out: the folder of their packages.
    """
    ordered = sorted(rows, key=lambda row: (row.status != "failed", not row.failing))
    shown = ordered[:ROWS_SHOWN]
    head = [f"# {markdown(name)}", "", line, ""]
    if len(rows) > ROWS_SHOWN:
        head += [f"{ROWS_SHOWN} of {len(rows)} are shown; all are in summary.csv and index.html of the folder.", ""]
    table = ["| | item | verdict | seconds | |", "|---|---|---|---|---|"]
    return "\n".join([*head, *table, *_lines(shown, out)]) + "\n"


def _lines(rows: list[Row], out: Path) -> Iterator[str]:
    left = PICTURES_BYTES
    for row in rows:
        picture = small_picture(out / row.item) if row.made and left > 0 else None
        left -= len(picture or b"")
        image = pages.embedded("", "image/webp", picture) if picture and left >= 0 else ""
        name = markdown(row.item)
        item = f"[{name}](/artifacts/key/{pages.key('asset', row.item)})" if row.made else name
        why = markdown(", ".join(row.failing or ()) or row.message)
        yield f"| {image} | {item} | {verdict(row)} | {row.wall_s:.0f} | {why} |"


def verdict(row: Row) -> str:
    """Return what became of an item in a word or two."""
    if not row.made:
        return row.status
    return "not accepted" if row.failing else "made" if row.failing is None else "accepted"


def small_picture(folder: Path) -> bytes | None:
    """Return a picture of the package in a folder as a small WebP; None if there is none that can be read."""
    for name in PICTURES:
        if (folder / name).is_file():
            return _shrunk(folder / name)
    return None


def _shrunk(path: Path) -> bytes | None:
    """Return the first frame of a picture."""
    try:
        with Image.open(path) as picture:
            small = picture.convert("RGBA")
            small.thumbnail((PICTURE_SIZE, PICTURE_SIZE))
    except (OSError, ValueError):  # an item is not worth less for a picture that cannot be read
        return None
    content = io.BytesIO()
    small.save(content, "WEBP", quality=PICTURE_QUALITY)
    return content.getvalue()
