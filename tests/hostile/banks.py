"""Folders of true views for the oracle prior: what `--bank` may be given by somebody else."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

from tests.hostile.archives import linked, overlapping, packed
from tests.hostile.formats import disc, saved, zeros_png

Place = Callable[[Path], None]
TILE = 64  # pixels


def about(**changes: Any) -> dict[str, Any]:
    """Return a sound bank.json of one view and two frames, with changes; None takes a key away."""
    view = {"file": "view.png", "azimuth": 0.0, "elevation": 0.0, "radius": 2.0}
    sound = {"frames": [0, 1], "tile": [1, 2], "tile_size": TILE, "views": [view]} | changes
    return {key: value for key, value in sound.items() if value is not None}


def view(**changes: Any) -> dict[str, Any]:
    """Return a view of a bank, with changes."""
    return about()["views"][0] | changes


def sheet() -> bytes:
    """Return two tiles side by side."""
    both = Image.new("RGBA", (2 * TILE, TILE))
    for i in range(2):
        both.paste(Image.fromarray(disc(12 + 4 * i)), (i * TILE, 0))
    return saved(both, "PNG")


def bank(document: Any = None, files: dict[str, bytes] | None = None) -> Place:
    """Return a writer of a bank; a document of bytes is written as it is."""

    def write(path: Path) -> None:
        path.mkdir()
        content = (
            document if isinstance(document, bytes) else json.dumps(about() if document is None else document).encode()
        )
        (path / "bank.json").write_bytes(content)
        for name, body in ({"view.png": sheet()} if files is None else files).items():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(body)

    return write


def also(extra: Place) -> Place:
    """Return a writer of a sound bank in which something else lies."""

    def write(path: Path) -> None:
        bank()(path)
        extra(path)

    return write


def instead(sheet_: Place) -> Place:
    """Return a writer of a bank in which something lies in the place of its picture."""

    def write(path: Path) -> None:
        bank(files={})(path)
        sheet_(path / "view.png")

    return write


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.write(sheet())
        file.truncate(9 * 2**30)


def _as_zip(content: Callable[[], bytes]) -> Place:
    return lambda path: _written(path, content())


def _written(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def _files(document: Any = None) -> dict[str, bytes]:
    return {"bank.json": json.dumps(about() if document is None else document).encode(), "view.png": sheet()}


# refused before a byte is stored
DOOR: dict[str, Place] = {
    "bank: nothing there": lambda path: None,
    "bank: a file": lambda path: _written(path, b"x"),
    "bank: a zip": _as_zip(lambda: packed(_files())),
    "bank: empty": lambda path: path.mkdir(),
    "bank: bank.json is a folder": lambda path: (path / "bank.json").mkdir(parents=True),
    "bank: bank.json is a link out": lambda path: (path.mkdir(), (path / "bank.json").symlink_to("/etc/hostname")),
    "bank: is a pipe": os.mkfifo,
    "bank: a sheet is a link out": instead(lambda path: path.symlink_to("/etc/hostname")),
    "bank: a sheet is a pipe": instead(os.mkfifo),
    "bank: a sheet of 9 GiB": instead(_sparse),
}

# refused when it is read
FOLDERS: dict[str, Place] = {
    "bank: no JSON": bank(b"{"),
    "bank: no text": bank(b"\xff\xfe\x00"),
    "bank: a list": bank([]),
    "bank: null": bank(b"null"),
    "bank: brackets without end": bank(b"[" * 50_000),
    "bank: no views": bank(about(views=[])),
    "bank: views are missing": bank(about(views=None)),
    "bank: frames are missing": bank(about(frames=None)),
    "bank: frames are null": bank(about() | {"frames": None}),
    "bank: no frames": bank(about(frames=[])),
    "bank: frames are words": bank(about(frames="ab")),
    "bank: a tile of none": bank(about(tile=[0, 0])),
    "bank: a tile of a billion": bank(about(tile=[10**9, 10**9])),
    "bank: a tile of one number": bank(about(tile=[2])),
    "bank: tiles of a negative size": bank(about(tile_size=-64)),
    "bank: tiles of half a pixel": bank(about(tile_size=0.5)),
    "bank: tiles of another size": bank(about(tile_size=48)),
    "bank: more frames than tiles": bank(about(frames=list(range(5)))),
    "bank: a view above the folder": bank(about(views=[view(file="../view.png")])),
    "bank: a view of the root": bank(about(views=[view(file="/etc/passwd")])),
    "bank: a view that is a number": bank(about(views=[view(file=7)])),
    "bank: a view that is not there": bank(about(views=[view(file="gone.png")])),
    "bank: an azimuth that is not a number": bank(json.dumps(about(views=[view(azimuth=float("nan"))])).encode()),
    "bank: an azimuth in words": bank(about(views=[view(azimuth="left")])),
    "bank: a radius of nothing": bank(about(views=[view(radius=0)])),
    "bank: a sheet of text": bank(files={"view.png": b"no picture"}),
    "bank: a sheet without bytes": bank(files={"view.png": b""}),
    "bank: a sheet of 8,000 a side, zeros": bank(files={"view.png": zeros_png(8000)}),
    "bank: a zip with a link": _as_zip(lambda: linked("view.png", "/etc/passwd", {"bank.json": _files()["bank.json"]})),
    "bank: a zip that leads out": _as_zip(lambda: packed({**_files(), "../evil.png": b"x"})),
    "bank: a zip of shared bodies": _as_zip(lambda: overlapping(70, 2**20)),
    "bank: a zip without bank.json": _as_zip(lambda: packed({"view.png": sheet()})),
    # sound
    "bank: sound": bank(),
    "bank: sound, with a pipe": also(lambda path: os.mkfifo(path / "pipe")),
    "bank: sound, hidden files": also(lambda path: _written(path / ".DS_Store", b"x")),
    "bank: sound, a link to a file outside": also(lambda path: (path / "key.png").symlink_to("/etc/hostname")),
    "bank: sound, a link to a folder outside": also(lambda path: (path / "etc").symlink_to("/etc")),
    "bank: sound, 9 GiB that it does not name": also(lambda path: _sparse(path / "huge.png")),
}
