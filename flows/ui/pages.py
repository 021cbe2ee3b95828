"""Pages of steps in the Prefect UI: Markdown with embedded thumbnails and tables of numbers."""

import base64
import hashlib
import io
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

from PIL import Image

from flows.formatting.escaping import markdown
from flows.formatting.numbers import format_size
from flows.packages import acceptance
from flows.serving.addresses import ARTIFACT_ADDRESS, VIEWER_ADDRESS
from flows.step_errors import StepError
from steps.contract import ArtifactRef, StepResult
from steps.runtime.installed_code import catalog
from steps.store.artifact_store import ArtifactMissing, ArtifactStore

THUMBNAIL_SIZES = (960, 640, 320)  # pixels of the longer side
QUALITIES = (80, 50, 20)  # of WebP
THUMBNAIL_BYTES = 30_000  # the server keeps pages in its database
THUMBNAILS_KEPT = 32  # the page of an asset repeats those of its steps
ROWS_OF_A_CURVE = 8
FIRST_LOOK = "first_look"  # output of `fit_gaussians`
LIVE = "live-"  # begins the keys of artifacts with a picture of a running fit


def key(label: str, item: str) -> str:
    """Return an artifact key in Prefect's alphabet (lower case, digits, dashes), unique for label and item."""
    slug = re.sub(r"[^a-z0-9]+", "-", f"{label} {item}".lower()).strip("-")[:80]
    return f"{slug}-{hashlib.sha256(f'{label}/{item}'.encode()).hexdigest()[:6]}"


def address(name: str, ref: ArtifactRef, suffix: str, place: str = ARTIFACT_ADDRESS) -> str:
    """Return the path on the background server of an artifact, or of a page made from it."""
    return f"{place}{ref.digest.removeprefix('sha256:')}/{ref.size_bytes}/{name}{suffix}"


def first_look_address(ref: ArtifactRef) -> str:
    """Return the path on the background server of the page that shows static splats."""
    return address(FIRST_LOOK, ref, ".html", VIEWER_ADDRESS)


def step_page(label: str, item: str, result: StepResult, store: ArtifactStore) -> str:
    """Return the page of a finished step: pictures, notes, curves, facts, and links to its files."""
    record = result.provenance
    lines = [f"# {label}: {markdown(item)}", ""]
    lines += [f"{image}\n" for image in pictures_of(result.outputs, store)]
    if FIRST_LOOK in result.outputs:
        lines += [f"[Preview of the static splats]({first_look_address(result.outputs[FIRST_LOOK])})", ""]
    lines += [f"> {markdown(note)}\n" for note in (*record.notes, *record.run_notes)]
    for ref in result.outputs.values():
        if ref.media_type.endswith("curves+json"):
            lines += curve_table(store.load_json(ref))
        if ref.media_type.endswith("gates+json"):
            lines += acceptance.markdown(store.load_json(ref))
    rows = {
        "compute_s": f"{record.duration_s:.1f}",
        "peak memory": f"{record.peak_memory_mb:.0f} MiB",
        "backend": record.backend,
        "seed": record.seed,
        "code": record.code_version,
        "request": f"`{record.request_digest[:19]}`",
        "record": f"`{record.digest()[:19]}`",
    }
    lines += ["| fact | value |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items()), ""]
    lines += ["| output | kind | size | digest |", "|---|---|---|---|"]
    suffixes = {name: port.suffix for name, port in catalog()[record.step].outputs.items()}
    lines += [
        f"| [{name}{suffixes[name]}]({address(name, ref, suffixes[name])}) | {ref.media_type} "
        f"| {format_size(ref.size_bytes)} | `{ref.digest[7:19]}` |"
        for name, ref in result.outputs.items()
    ]
    return "\n".join(lines) + "\n"


def failure_page(label: str, item: str, error: StepError, store: ArtifactStore) -> str:
    """Return the page of a failed step: its message and the pictures that explain it."""
    lines = [f"# {label}: {markdown(item)}", "", f"**{type(error).__name__}**", "", markdown(error.message), ""]
    return "\n".join([*lines, *(f"{image}\n" for image in pictures_of(error.pictures, store))])


def pictures_of(outputs: dict[str, ArtifactRef], store: ArtifactStore) -> list[str]:
    """Return every PNG among the outputs as an embedded thumbnail."""
    return [
        embedded(name, "image/webp", small)
        for name, ref in outputs.items()
        if ref.media_type == "image/png" and (small := thumbnail(ref, store)) is not None
    ]


def embedded(name: str, media_type: str, content: bytes) -> str:
    """Return the Markdown of a picture with its content in a data URL."""
    return f"![{name}](data:{media_type};base64,{base64.b64encode(content).decode()})"


def thumbnail(ref: ArtifactRef, store: ArtifactStore, most_bytes: int = THUMBNAIL_BYTES) -> bytes | None:
    """Return a picture of the store as `small_webp`; None if it is missing."""
    try:
        return _thumbnail(store.path(ref), most_bytes)
    except ArtifactMissing:
        return None


def small_webp(
    file: Path | io.BytesIO,
    most_bytes: int,
    sizes: tuple[int, ...] = THUMBNAIL_SIZES,
    qualities: tuple[int, ...] = QUALITIES,
) -> bytes | None:
    """Return the first frame of a picture as a WebP, as large and as good as `most_bytes` allows.

    Args:
        file: of the picture.
        most_bytes: of the result.
        sizes: longer side in pixels, the first choice first.
        qualities: of WebP, tried for each size.

    Returns:
        None if the picture cannot be read or no size fits: a page is not worth a failed step.
    """
    try:
        with Image.open(file) as picture:
            small = picture.convert("RGBA")
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None
    for size in sizes:
        small.thumbnail((size, size))
        for quality in qualities:
            content = io.BytesIO()
            small.save(content, "WEBP", quality=quality)
            if content.tell() <= most_bytes:
                return content.getvalue()
    return None


_thumbnail = lru_cache(THUMBNAILS_KEPT)(small_webp)  # for files of the store, which never change


def curve_table(curves: dict[str, Any]) -> list[str]:
    """Return a table with `ROWS_OF_A_CURVE` samples of a loss curve, the first and the last among them."""
    names, x = list(curves["series"]), curves["x"]
    if not x:
        return []
    picks = sorted({round(i * (len(x) - 1) / (ROWS_OF_A_CURVE - 1)) for i in range(ROWS_OF_A_CURVE)})
    head = [f"**{curves['title']}**", "", f"| iteration | {' | '.join(names)} |", "|" + "---|" * (len(names) + 1)]
    rows = [
        f"| {x[i]} | " + " | ".join(f"{_at(curves['series'][name], i):.5g}" for name in names) + " |" for i in picks
    ]
    return [*head, *rows, ""]


def _at(values: list[float], index: int) -> float:
    return values[min(index, len(values) - 1)] if values else float("nan")
