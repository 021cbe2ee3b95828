"""The page that plays a package, and the check of the package before it is shown; behind `dg4d view`."""

import os
import sys
import webbrowser
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dg4d_lib.assets.rendering.viewer_page import build_viewer_page
from dg4d_lib.errors import BadInput
from flows.formatting.sizes import readable
from flows.packages.publish import whole
from steps.store.files import room_for

VIEWER = "viewer.html"
# files of a package, as in steps/artifacts/packages.py, whose import would bring torch
ASSET = "asset.glb"
WEB_SPLATS = "splats/moving.websplats"
SUBJECT = "input/subject.png"
DRIVING = "input/driving.mp4"


def view(folder: Path, open_browser: bool) -> Path:
    """Check a package, see that its page is there and as it should be, and show it.

    Args:
        folder: a package.
        open_browser: show the page, where there is a screen to show it on.

    Returns:
        The page.

    Raises:
        BadInput: there is no package, a file of it is missing or altered (says which), or the page cannot be written.
    """
    record = whole(folder)
    if ASSET not in record["files"]:
        raise BadInput(f"{folder} has no {ASSET}; only animated assets can be viewed")
    page = folder / VIEWER
    try:
        text = page_of(record, lambda name: (folder / name).read_bytes())
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise BadInput(f"{folder} cannot be viewed: its provenance has another form ({error!r})") from error
    if not page.is_file() or page.read_bytes() != text.encode():
        _write(page, text)
    if open_browser and _has_screen():
        webbrowser.open(page.resolve().as_uri())
    return page


def page_of(record: Mapping[str, Any], read: Callable[[str], bytes]) -> str:
    """The page of a package; it depends on the package's files and on the covered part of its provenance only.

    Args:
        record: the provenance.
        read: gives the content of a file by its name in the package.
    """
    splats, picture, video = (
        read(name) if name in record["files"] else None for name in (WEB_SPLATS, SUBJECT, DRIVING)
    )
    return build_viewer_page(record.get("item", "asset"), read(ASSET), splats, picture, video, facts_of(record))


def page_of_package(package: Path, title: str) -> str:
    """The page of a package that is still a zip, without the provenance that goes with it when it is delivered.

    Raises:
        BadInput: it is no package.
    """
    try:
        with zipfile.ZipFile(package) as archive:
            sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
            splats, picture, video = (
                archive.read(name) if name in sizes else None for name in (WEB_SPLATS, SUBJECT, DRIVING)
            )
            facts = {"Files": {name: readable(size) for name, size in sizes.items()}}
            return build_viewer_page(title, archive.read(ASSET), splats, picture, video, facts)
    except (zipfile.BadZipFile, KeyError) as error:
        raise BadInput(f"{title} is no package that can be viewed") from error


def facts_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """What the page says about where an asset came from; what belongs to one run only is left out."""
    named = {
        "profile": "profile",
        "seed": "seed",
        "commercial only": "commercial_only",
        "source": "source",
        "order": "order",
        "package": "package",
    }
    return {
        "Provenance": {name: record[key] for name, key in named.items() if key in record},
        "Licenses": record.get("licenses") or "No weights were used: no license of a model follows this asset.",
        "Steps": {
            f"{number}. {step['step']}": {key: value for key, value in step.items() if key != "step" and value != {}}
            for number, step in enumerate(record.get("steps", ()), 1)
        },
        "Files": {
            name: {"size": readable(fact["size_bytes"]), "digest": fact["digest"]}
            for name, fact in record["files"].items()
        },
    }


def _write(page: Path, text: str) -> None:
    try:
        with room_for(page.parent):
            page.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BadInput(
            f"{page} cannot be written: {error.strerror or error}; copy the package to a folder of yours"
        ) from error


def _has_screen() -> bool:
    """Without one, Python would start a browser for terminals."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
