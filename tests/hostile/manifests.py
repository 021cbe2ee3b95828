"""Manifests: broken as a whole, with rows that cannot be made, and sound ones that are unusual."""

import csv
import io
import json
from collections.abc import Callable
from typing import Any

Make = Callable[[], bytes]
DEEP = 100_000


def rows(*some: dict[str, Any]) -> Make:
    """Return a writer of a JSON manifest."""
    return lambda: json.dumps(some).encode()


def with_row(**cells: Any) -> Make:
    """Return a writer of a JSON manifest whose second row is sound."""
    return rows({"path": "cat.png", "name": "bad", **cells}, {"path": "cat.png", "name": "good"})


def raw_row(cell: str) -> Make:
    """Return a writer of a JSON manifest with a cell that Python would not write."""
    text = f'[{{"path": "cat.png", "name": "bad", {cell}}}, {{"path": "cat.png", "name": "good"}}]'
    return text.encode


def table(header: str, *lines: str) -> Make:
    """Return a writer of a CSV manifest."""
    return lambda: "\n".join([header, *lines, ""]).encode()


def _parquet_of_nothing() -> bytes:
    return b"PAR1" + bytes(100) + b"PAR1"


# suffix, content
WHOLE: dict[str, tuple[str, Make]] = {
    "manifest: empty CSV": (".csv", lambda: b""),
    "manifest: empty JSON": (".json", lambda: b""),
    "manifest: empty JSONL": (".jsonl", lambda: b""),
    "manifest: empty Parquet": (".parquet", lambda: b""),
    "manifest: header alone": (".csv", table("path,name")),
    "manifest: no rows": (".json", lambda: b"[]"),
    "manifest: null": (".json", lambda: b"null"),
    "manifest: a number": (".json", lambda: b"7"),
    "manifest: an object": (".json", lambda: b'{"path": "cat.png"}'),
    "manifest: rows that are lists": (".json", lambda: b'[["cat.png"]]'),
    "manifest: cut JSON": (".json", lambda: b'[{"path": "cat.png"}, {'),
    "manifest: cut JSONL": (".jsonl", lambda: b'{"path": "cat.png"}\n{'),
    "manifest: brackets without end": (".json", lambda: b"[" * DEEP),
    "manifest: brackets without end, JSONL": (".jsonl", lambda: b'{"path": "cat.png"}\n' + b"[" * DEEP),
    "manifest: a number of 5,000 digits": (".json", lambda: b"[" + b"9" * 5000 + b"]"),
    "manifest: not UTF-8": (".csv", lambda: b"path\ncaf\xe9.png\n"),
    "manifest: UTF-16": (".csv", lambda: "path\ncat.png\n".encode("utf-16")),
    "manifest: bytes of a picture": (".csv", lambda: b"\x89PNG\r\n\x1a\n" + bytes(range(256))),
    "manifest: zeros": (".csv", lambda: b"path\n" + bytes(100)),
    "manifest: Parquet of nothing": (".parquet", _parquet_of_nothing),
    "manifest: Parquet whose footer lies": (".parquet", lambda: b"PAR1" + bytes(100) + b"\xff\xff\xff\x7fPAR1"),
    "manifest: a field of 200,000 letters": (".csv", lambda: b"path,name\ncat.png," + b"a" * 200_000),
    "manifest: a quote without end": (".csv", lambda: b'path,name\n"cat.png,' + b"a" * 140_000 + b"\na\na\n"),
    "manifest: unknown column": (".csv", table("path,tint", "cat.png,red")),
    "manifest: too many cells": (".csv", table("path", "cat.png,red,green")),
    "manifest: neither path nor text": (".csv", table("path,seed", ",1")),
    "manifest: a column without a name": (".csv", table("path,", "cat.png,x")),
}

# the first row cannot be made, the second one can
ROWS: dict[str, tuple[str, Make]] = {
    "row: set is a number": (".json", with_row(set=7)),
    "row: set is a list": (".json", with_row(set=[1, 2])),
    "row: set is true": (".json", with_row(set=True)),
    "row: set of a list in words": (".json", with_row(set="[1, 2]")),
    "row: set is deep": (".json", raw_row('"set": {"mesh.grid": ' + "[" * 900 + "]" * 900 + "}")),
    "row: set is deep, in words": (".json", with_row(set="mesh.grid=" + "[" * 5000)),
    "row: set is deep and whole, in words": (".json", with_row(set="mesh.grid=" + "[" * 5000 + "]" * 5000)),
    "row: set is deep, CSV": (
        ".csv",
        lambda: _csv(
            ["path", "name", "set"], ["cat.png", "bad", "mesh.grid=" + '{"a":' * 5000], ["cat.png", "good", ""]
        ),
    ),
    "row: set is a number of 5,000 digits": (".json", with_row(set="mesh.grid=" + "9" * 5000)),
    "row: set without an equals sign": (".json", with_row(set="mesh.grid")),
    "row: set of nothing": (".json", with_row(set="=7")),
    "row: unknown knob": (".json", with_row(**{"mesh.grit": 1})),
    "row: knob out of range": (".json", with_row(**{"mesh.grid": -1})),
    "row: knob is not a number": (".json", raw_row('"mesh.grid": NaN')),
    "row: knob is infinite": (".json", raw_row('"motion.rigidity_weight": Infinity')),
    "row: knob is deep": (".json", raw_row('"mesh.grid": ' + "[" * 900 + "]" * 900)),
    "row: knob is an object": (".json", with_row(**{"mesh.grid": {"a": 1}})),
    "row: a knob of dots": (".json", with_row(**{"...": 1})),
    "row: a knob of a private name": (".json", with_row(**{"mesh.__class__": 1})),
    "row: seed is not a number": (".json", raw_row('"seed": NaN')),
    "row: seed is infinite": (".json", raw_row('"seed": Infinity')),
    "row: seed is half": (".json", with_row(seed=0.5)),
    "row: seed is negative": (".json", with_row(seed=-1)),
    "row: seed is a word": (".json", with_row(seed="x")),
    "row: seed is a list": (".json", with_row(seed=[1])),
    "row: seed is an object": (".json", with_row(seed={"a": 1})),
    "row: seed of 23 digits": (".json", with_row(seed=99999999999999999999999)),
    "row: seed of 5,000 digits in words": (".json", with_row(seed="9" * 5000)),
    "row: priority is a word": (".json", with_row(priority="high")),
    "row: priority is not a number": (".json", raw_row('"priority": NaN')),
    "row: priority is infinite": (".json", raw_row('"priority": -Infinity')),
    "row: profile is unknown": (".json", with_row(profile="perfect")),
    "row: profile is a list": (".json", with_row(profile=["preview"])),
    "row: path is a number": (".json", with_row(path=7)),
    "row: path is a list": (".json", with_row(path=["cat.png"])),
    "row: path is gone": (".json", with_row(path="gone.png")),
    "row: path of 5,000 letters": (".json", with_row(path="a" * 5000 + ".png")),
    "row: path above": (".json", with_row(path="../cat.png")),
    "row: path of the root": (".json", with_row(path="/etc/hostname")),
    "row: path with a zero": (".json", with_row(path="cat\0.png")),
    "row: path of half a character": (".json", with_row(path="caf\udce9.png")),
    "row: path is a folder": (".json", with_row(path=".")),
    "row: path is an address of this machine": (".json", with_row(path="http://127.0.0.1/cat.png")),
    "row: path is an address of a file": (".json", with_row(path="file:///etc/passwd")),
    "row: video is gone": (".json", with_row(video="gone.mp4")),
    "row: video is a number": (".json", with_row(video=1)),
    "row: bank is gone": (".json", with_row(bank="gone", **{"prior.kind": "oracle"})),
    "row: text and path": (".json", with_row(text="a fox", **{"text.weights": "some/pictures"})),
    "row: text is a number": (".json", with_row(path="", text=7)),
    "row: text of 5,000 letters": (".json", with_row(path="", text="a" * 5000, **{"text.weights": "some/pictures"})),
    "row: name of 300 letters": (".json", with_row(name="a" * 300)),
    "row: weights above": (".json", with_row(**{"prior.kind": "zero123", "prior.weights": "../../../etc"})),
}

SOUND: dict[str, tuple[str, Make]] = {
    "sound: byte order mark": (".csv", lambda: b"\xef\xbb\xbfpath\ncat.png\n"),
    "sound: lines of Windows": (".csv", lambda: b"path,name\r\ncat.png,hero\r\n"),
    "sound: lines of an old Mac": (".csv", lambda: b"path,name\rcat.png,hero\r"),
    "sound: empty cells": (".csv", table("path,name,seed,set,mesh.grid", "cat.png,,,,")),
    "sound: fewer cells": (".csv", table("path,name,seed", "cat.png")),
    "sound: quoted commas": (".csv", table("path,name", '"cat.png","a,b"')),
    "sound: null cells": (".json", rows({"path": "cat.png", "name": None, "seed": None, "set": None})),
    "sound: seed as words": (".json", rows({"path": "cat.png", "seed": "7"})),
    "sound: seed 7.0": (".json", rows({"path": "cat.png", "seed": 7.0})),
    "sound: empty lines": (".jsonl", lambda: b'\n\n{"path": "cat.png"}\n\n'),
    "sound: the same twice": (".json", rows({"path": "cat.png"}, {"path": "cat.png"})),
    "sound: a key twice": (".json", lambda: b'[{"path": "gone.png", "path": "cat.png"}]'),
    "sound: capitals in the suffix": (".JSON", rows({"path": "cat.png"})),
    "sound: a name of many languages": (".json", rows({"path": "cat.png", "name": "猫/قط/кот"})),
}


def _csv(*lines: list[str]) -> bytes:
    text = io.StringIO()
    csv.writer(text).writerows(lines)
    return text.getvalue().encode()
