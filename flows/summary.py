"""What lies beside the packages of a batch: `summary.json` for programs and `index.html` for people."""

import html
import json
from pathlib import Path
from typing import Literal
from urllib.parse import quote

from pydantic import BaseModel

from steps.store import write_atomically


class Row(BaseModel):
    """What became of one item."""

    item: str
    source: str = ""
    status: Literal["done", "unchanged", "failed"]
    kind: str = ""
    message: str = ""
    seconds: float = 0.0
    pictures: list[str] = []


def write_summary(out: Path, rows: list[Row], commercial_only: bool = False) -> None:
    """Write `summary.json` and `index.html`; the summary says whether weights had to allow commercial use.

    Raises:
        DiskFull: there is no room; what was there stays.
    """
    counts = {status: sum(row.status == status for row in rows) for status in ("done", "unchanged", "failed")}
    items = [row.model_dump(mode="json") for row in rows]
    summary = {"counts": counts, "commercial_only": commercial_only, "items": items}
    write_atomically(out / "summary.json", json.dumps(summary, indent=1, ensure_ascii=False) + "\n")
    write_atomically(out / "index.html", index(out, rows, counts))


def index(out: Path, rows: list[Row], counts: dict[str, int]) -> str:
    """A page with a moving picture of every asset, the failed ones first."""
    ordered = sorted(rows, key=lambda row: (row.status != "failed", row.item))
    tally = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    return _PAGE.format(tally=html.escape(tally), cards="\n".join(_card(out, row) for row in ordered))


def _card(out: Path, row: Row) -> str:
    folder, name = quote(row.item), html.escape(row.item)
    if row.status == "failed":
        return f"<article class=failed><h2>{name}</h2><p>{html.escape(row.message)}</p></article>"
    picture = ""
    if (out / row.item / "preview.mp4").is_file():
        poster = f' poster="{folder}/contact_sheet.png"' if (out / row.item / "contact_sheet.png").is_file() else ""
        picture = f'<video src="{folder}/preview.mp4"{poster} autoplay loop muted playsinline></video>'
    elif (out / row.item / "contact_sheet.png").is_file():
        picture = f'<img src="{folder}/contact_sheet.png" alt="">'
    return (
        f"<article><a href='{folder}/report.html'>{picture}<h2>{name}</h2></a>"
        f"<p>{row.status}{f', {row.seconds:.0f} s' if row.seconds else ''}"
        f" · <a href='{folder}/asset.glb'>asset.glb</a></p></article>"
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
.failed {{ border-color: #dc2626; }} .failed h2 {{ color: #dc2626; }}
</style>
<h1>{tally}</h1>
<main>
{cards}
</main>
</html>
"""
