"""What lies beside the packages of a batch: `summary.json` for programs and `index.html` for people."""

import html
import json
from pathlib import Path
from typing import Literal, get_args
from urllib.parse import quote

from pydantic import BaseModel

from flows.acceptance import failing_in
from steps.store import write_atomically

Status = Literal["done", "unchanged", "failed", "skipped"]
NOT_ACCEPTED = "NotAccepted"  # the kind of failure of an item that was made, but fails a gate in a strict batch


class Row(BaseModel):
    """What became of one item."""

    item: str
    source: str = ""
    status: Status
    kind: str = ""
    message: str = ""
    seconds: float = 0.0
    pictures: list[str] = []
    failing: list[str] | None = None  # gates; None where there is no verdict


def write_summary(out: Path, rows: list[Row], commercial_only: bool = False) -> None:
    """Write `summary.json` and `index.html`; the summary says whether weights had to allow commercial use.

    Raises:
        DiskFull: there is no room; what was there stays.
    """
    counts = {status: sum(row.status == status for row in rows) for status in get_args(Status)}
    items = [row.model_dump(mode="json") for row in rows]
    summary = {
        "counts": counts,
        "not_accepted": [row.item for row in rows if row.failing],
        "commercial_only": commercial_only,
        "items": items,
    }
    write_atomically(out / "summary.json", json.dumps(summary, indent=1, ensure_ascii=False) + "\n")
    write_atomically(out / "index.html", index(out, rows, counts))


def judged(row: Row, folder: Path, strict: bool) -> Row:
    """The row of an item whose package lies in `folder`, with what the gates say; with `strict` a verdict counts."""
    failing = failing_in(folder)
    row = row.model_copy(update={"failing": failing})
    if not strict or not failing:
        return row
    message = f"not accepted: {', '.join(failing)}; {folder / 'report.html'} says what to do"
    return row.model_copy(update={"status": "failed", "kind": NOT_ACCEPTED, "message": message})


def index(out: Path, rows: list[Row], counts: dict[str, int]) -> str:
    """A page with a moving picture of every asset; the failed ones first, then those that are not accepted."""
    ordered = sorted(rows, key=lambda row: (row.status != "failed", not row.failing, row.item))
    tally = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    if refused := sum(bool(row.failing) for row in rows):
        tally += f"; {refused} not accepted"
    return _PAGE.format(tally=html.escape(tally), cards="\n".join(_card(out, row) for row in ordered))


def _card(out: Path, row: Row) -> str:
    folder, name = quote(row.item), html.escape(row.item)
    if row.status == "skipped" or (row.status == "failed" and row.failing is None):
        return f"<article class={row.status}><h2>{name}</h2><p>{html.escape(row.message)}</p></article>"
    picture = ""
    if (out / row.item / "preview.mp4").is_file():
        poster = f' poster="{folder}/contact_sheet.png"' if (out / row.item / "contact_sheet.png").is_file() else ""
        picture = f'<video src="{folder}/preview.mp4"{poster} autoplay loop muted playsinline></video>'
    elif (out / row.item / "contact_sheet.png").is_file():
        picture = f'<img src="{folder}/contact_sheet.png" alt="">'
    return (
        f"<article class={'failed' if row.failing else row.status}>"
        f"<a href='{folder}/report.html'>{picture}<h2>{name}</h2></a>"
        f"<p>{row.status}{f', {row.seconds:.0f} s' if row.seconds else ''}"
        f" · <a href='{folder}/asset.glb'>asset.glb</a></p>{_verdict(row)}</article>"
    )


def _verdict(row: Row) -> str:
    if row.failing is None:
        return ""
    return (
        f"<p class=verdict>not accepted: {html.escape(', '.join(row.failing))}</p>"
        if row.failing
        else "<p>accepted</p>"
    )


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{tally}</title>
<style>
:root {{ color-scheme: light dark; }}
body {{ font: 15px/1.5 system-ui, sans-serif; margin: 2rem; }}
main {{ display: grid; grid-template-columns: repeat(auto-fill, minmax(240px, 1fr)); gap: 1rem; }}
article {{ border: 1px solid #8884; border-radius: 8px; padding: .6rem; overflow-wrap: anywhere; }}
h2 {{ font-size: 1rem; margin: .4rem 0 0; }} p {{ margin: .2rem 0 0; font-size: .85rem; }}
video, img {{ width: 100%; border-radius: 4px;
  background: repeating-conic-gradient(#fff 0 25%, #eee 0 50%) 0 0 / 20px 20px; }}
.failed {{ border-color: #dc2626; }} .failed h2, .verdict {{ color: #dc2626; }}
.skipped {{ opacity: .6; }}
</style>
<h1>{tally}</h1>
<main>
{cards}
</main>
</html>
"""
