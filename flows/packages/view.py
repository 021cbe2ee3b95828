"""Viewer page of a package; behind `dg4d view`."""

import json
import os
import sys
import webbrowser
import zipfile
from collections.abc import Callable, Container, Mapping
from pathlib import Path
from typing import Any

from dg4d_lib.assets.rendering.viewer_page import build_viewer_page
from dg4d_lib.errors import BadInput
from flows.formatting.numbers import format_size
from flows.inputs.package_record import RECORD
from flows.packages.publish import load_verified
from steps.artifacts.package_files import ASSET, DRIVING, MANIFEST, MERGED, SUBJECT, WEB_SPLATS
from steps.store.files import room_for

VIEWER = "viewer.html"
WEB_SPLATS_MAGIC = b"D4WS"  # first bytes of web splats, as in dg4d_lib/assets/formats/web_splats.py
PROVENANCE = ("profile", "seed", "commercial_only", "source", "order", "package")  # fields of the record


def view(folder: Path, open_browser: bool) -> Path:
    """Verify a package, restore its page if necessary, and return the page's path.

    Args:
        folder: a package.
        open_browser: open the page if there is a display.

    Raises:
        BadInput: there is no package, a file of it is missing or altered, or the page cannot be written.
    """
    record = load_verified(folder)
    if ASSET not in record["files"]:
        raise BadInput(f"{folder} has no {ASSET}; only animated assets can be viewed")
    page = folder / VIEWER
    try:
        text = viewer_html(record, lambda name: (folder / name).read_bytes())
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise BadInput(f"{folder} cannot be viewed: its {RECORD} has an unknown format ({error!r})") from error
    if not page.is_file() or page.read_bytes() != text.encode():
        _write(page, text)
    if open_browser:
        open_page(page.resolve().as_uri())
    return page


def open_page(address: str) -> None:
    """Open an address in a browser if there is a display."""
    if _has_screen():
        webbrowser.open(address)


def viewer_html(record: Mapping[str, Any], read: Callable[[str], bytes]) -> str:
    """Render the page of a package from its files and the run-independent part of its provenance.

    Args:
        record: provenance.
        read: returns the content of a file by its name in the package.
    """
    return _page(record.get("item", "asset"), record["files"], read, viewer_facts(record))


def viewer_of_package(package: Path, title: str) -> str:
    """Render the page of a package that is still a zip, without provenance.

    Raises:
        BadInput: it is not a package.
    """
    try:
        with zipfile.ZipFile(package) as archive:
            sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
            facts = {"Files": {name: format_size(size) for name, size in sizes.items()}}
            return _page(title, sizes, archive.read, facts)
    except (zipfile.BadZipFile, KeyError) as error:
        raise BadInput(f"{title} is not a package that can be viewed") from error


def viewer_of_splats(splats: bytes, title: str) -> str:
    """Render the page of web splats without a mesh: a preview of an asset whose motion is being fitted.

    Args:
        splats: output of `write_web_splats`.
        title: name of the asset.
    """
    facts = {"Preview": {"shown": "the splats of the first frame", "to come": "motion, mesh and files"}}
    return build_viewer_page(f"{title}: static splats", None, splats, None, None, facts)


def viewer_of_artifact(path: Path, title: str) -> str:
    """Render the page of an artifact: of a package, or of web splats.

    Raises:
        BadInput: it is neither.
    """
    with path.open("rb") as file:
        is_splats = file.read(len(WEB_SPLATS_MAGIC)) == WEB_SPLATS_MAGIC
    return viewer_of_splats(path.read_bytes(), title) if is_splats else viewer_of_package(path, title)


def viewer_facts(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the facts that the page lists, without those of a single run."""
    return {
        "Provenance": {name.replace("_", " "): record[name] for name in PROVENANCE if name in record},
        "Licenses": record.get("licenses")
        or "No downloaded weights were used; no model license applies to this asset.",
        "Steps": {
            f"{number}. {step['step']}": {key: value for key, value in step.items() if key != "step" and value != {}}
            for number, step in enumerate(record.get("steps", ()), 1)
        },
        "Files": {
            name: {"size": format_size(fact["size_bytes"]), "digest": fact["digest"]}
            for name, fact in record["files"].items()
        },
    }


def _page(title: str, names: Container[str], read: Callable[[str], bytes], facts: dict[str, Any]) -> str:
    splats, picture, video = (read(name) if name in names else None for name in (WEB_SPLATS, SUBJECT, DRIVING))
    camera = json.loads(read(MANIFEST)).get("camera", {}) if MANIFEST in names else {}
    body = read(MERGED if MERGED in names else ASSET)
    return build_viewer_page(title, body, splats, picture, video, facts, camera)


def _write(page: Path, text: str) -> None:
    try:
        with room_for(page.parent):
            page.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BadInput(
            f"{page} cannot be written: {error.strerror or error}; copy the package to a folder of yours"
        ) from error


def _has_screen() -> bool:
    """Return True if there is a display; without one Python would start a text browser."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
