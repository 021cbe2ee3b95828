"""What the Prefect UI shows of a step: Markdown with small pictures inside, tables of numbers."""

import base64
import hashlib
import json
import re
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import OpenImageIO as oiio

from flows.engine.executors import StepError
from flows.packages import acceptance
from flows.packages.publish import readable
from flows.ui.escaping import markdown
from steps.contract import ArtifactRef, StepResult, StepSpec
from steps.store.artifact_store import ArtifactMissing, ArtifactStore

THUMBNAIL_SIZES = (960, 640, 320)  # pixels of the longer side
WEBP_METHOD = 4  # libwebp's own; with OpenImageIO's, 6, alpha takes a hundred times as long
THUMBNAIL_BYTES = 30_000  # the server keeps pages in its database
THUMBNAILS_KEPT = 32  # the page of an asset shows those of its steps again
ROWS_OF_A_CURVE = 8
ARTIFACT_ADDRESS = "/dg4d/artifacts/"  # of the background server
VIEWER_ADDRESS = "/dg4d/viewer/"


def key(label: str, item: str) -> str:
    """A key as Prefect wants it: lower case, digits and dashes; different names give different keys."""
    slug = re.sub(r"[^a-z0-9]+", "-", f"{label} {item}".lower()).strip("-")[:80]
    return f"{slug}-{hashlib.sha256(f'{label}/{item}'.encode()).hexdigest()[:6]}"


def address(name: str, ref: ArtifactRef, suffix: str, place: str = ARTIFACT_ADDRESS) -> str:
    """Where the background server has a file of the store, or a page made of it; relative to the server."""
    return f"{place}{ref.digest.removeprefix('sha256:')}/{ref.size_bytes}/{name}{suffix}"


def output_rows(result: StepResult, spec: StepSpec) -> list[dict[str, str]]:
    """A table of a step's outputs, each with the address of its file."""
    return [
        {
            "output": name,
            "kind": ref.media_type,
            "size": readable(ref.size_bytes),
            "digest": ref.digest[7:19],
            "file": f"[{name}{spec.outputs[name].suffix}]({address(name, ref, spec.outputs[name].suffix)})",
        }
        for name, ref in result.outputs.items()
    ]


def step_page(label: str, item: str, result: StepResult, store: ArtifactStore) -> str:
    """Picture, notes, curves and facts of one finished step."""
    record = result.provenance
    lines = [f"# {label}: {markdown(item)}", ""]
    lines += [f"{image}\n" for image in pictures_of(result.outputs, store)]
    lines += [f"> {markdown(note)}\n" for note in (*record.notes, *record.run_notes)]
    for ref in result.outputs.values():
        if ref.media_type.endswith("curves+json"):
            lines += curve_table(json.loads(store.path(ref).read_text(encoding="utf-8")))
        if ref.media_type.endswith("gates+json"):
            lines += acceptance.markdown(json.loads(store.path(ref).read_text(encoding="utf-8")))
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
    lines += ["| output | kind | size |", "|---|---|---|"]
    lines += [
        f"| {name} `{ref.digest[7:19]}` | {ref.media_type} | {readable(ref.size_bytes)} |"
        for name, ref in result.outputs.items()
    ]
    return "\n".join(lines) + "\n"


def failure_page(label: str, item: str, error: StepError, store: ArtifactStore) -> str:
    """The message of a step that failed, and the pictures that explain it."""
    lines = [f"# {label}: {markdown(item)}", "", f"**{type(error).__name__}**", "", markdown(error.message), ""]
    return "\n".join([*lines, *(f"{image}\n" for image in pictures_of(error.pictures, store))])


def pictures_of(outputs: dict[str, ArtifactRef], store: ArtifactStore) -> list[str]:
    """Every PNG among the outputs, small and inside the Markdown."""
    return [
        embedded(name, "image/webp", small)
        for name, ref in outputs.items()
        if ref.media_type == "image/png" and (small := thumbnail(ref, store)) is not None
    ]


def embedded(name: str, media_type: str, content: bytes) -> str:
    """A picture inside the Markdown."""
    return f"![{name}](data:{media_type};base64,{base64.b64encode(content).decode()})"


def thumbnail(ref: ArtifactRef, store: ArtifactStore, most_bytes: int = THUMBNAIL_BYTES) -> bytes | None:
    """A picture as a WebP of at most so many bytes, as large and as good as fits.

    Returns:
        None if it cannot be made, for a page is not worth a failed step.
    """
    try:
        return _small(store.path(ref), most_bytes)
    except ArtifactMissing:
        return None


@lru_cache(THUMBNAILS_KEPT)
def _small(path: Path, most_bytes: int) -> bytes | None:
    """As `thumbnail`, of a file that never changes."""
    with tempfile.TemporaryDirectory(prefix="dg4d-page-") as folder:
        named = Path(folder) / "picture.png"  # files of the store have no suffix, by which a reader is found
        named.symlink_to(path)
        picture = oiio.ImageBuf(str(named))
        if not picture.read() or not picture.spec().width:
            picture.geterror()  # it was taken note of
            return None
        target = Path(folder) / "small.webp"
        small = picture
        for size in THUMBNAIL_SIZES:
            small = _shrunk(small, size)
            for quality in (80, 50, 20):
                small.specmod().attribute("Compression", f"webp:{quality}")
                small.specmod().attribute("webp:method", WEBP_METHOD)
                if not small.write(str(target)):
                    return None
                if target.stat().st_size <= most_bytes:
                    return target.read_bytes()
    return None


def _shrunk(picture: oiio.ImageBuf, size: int) -> oiio.ImageBuf:
    """With no side longer than `size` pixels."""
    width, height, channels = picture.spec().width, picture.spec().height, picture.nchannels
    scale = min(1.0, size / max(width, height))
    region = oiio.ROI(0, max(1, round(width * scale)), 0, max(1, round(height * scale)), 0, 1, 0, channels)
    return oiio.ImageBufAlgo.resize(picture, filtername="triangle", roi=region)


def curve_table(curves: dict[str, Any]) -> list[str]:
    """A few rows of a loss curve, from first to last."""
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
