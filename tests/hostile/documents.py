"""JSON that other people may have written: scene files and the records of packages."""

import json
from collections.abc import Callable
from typing import Any

Make = Callable[[], bytes]


def scene(**item: Any) -> Make:
    """Return a writer of a scene of one package."""
    return lambda: json.dumps({"items": [{"package": "gem", **item}]}).encode()


def raw(text: str) -> Make:
    """Return a writer of these words."""
    return text.encode


SCENES: dict[str, Make] = {
    "scene: nothing": lambda: b"",
    "scene: no UTF-8": lambda: b"\xff\xfe\x00",
    "scene: brackets without end": lambda: b"[" * 100_000,
    "scene: braces without end": lambda: b'{"items":' * 20_000,
    "scene: a list": raw("[]"),
    "scene: null": raw("null"),
    "scene: no items": raw('{"items": []}'),
    "scene: 1,001 items": lambda: json.dumps({"items": [{"package": "gem"}] * 1001}).encode(),
    "scene: an unknown key": scene(tint="red"),
    "scene: a package above": scene(package="../gem"),
    "scene: a package of the root": scene(package="/etc"),
    "scene: a package with a zero": scene(package="a\0b"),
    "scene: a package of 5,000 letters": scene(package="a" * 5000),
    "scene: a package that is gone": scene(package="gone"),
    "scene: a package that is a number": scene(package=7),
    "scene: a position that is not a number": raw('{"items": [{"package": "gem", "position": [NaN, 0, 0]}]}'),
    "scene: an infinite position": raw('{"items": [{"package": "gem", "position": [1e400, 0, 0]}]}'),
    "scene: a position of two numbers": scene(position=[0, 0]),
    "scene: no size": scene(scale=0),
    "scene: a size of 10^300": scene(scale=1e300),
    "scene: a negative start": scene(start_s=-1),
    "scene: no speed": scene(speed=0),
    "scene: a length of a year": raw('{"items": [{"package": "gem"}], "duration_s": 31536000}'),
    "scene: 10,000 frames a second": raw('{"items": [{"package": "gem"}], "fps": 10000}'),
    "scene: a number of 5,000 digits": raw('{"items": [{"package": "gem", "scale": ' + "9" * 5000 + "}]}"),
}


def record(**changes: Any) -> Make:
    """Return a writer of a record of no files, with changes; None takes a key away."""
    whole: dict[str, Any] = {
        "format": 2, "files": {}, "beside": [], "steps": [], "recipe": {}, "signatures": {}, "package": "sha256:0",
        "source": "", "seed": 0, "commercial_only": False, "run": {},
    }  # fmt: skip
    whole |= changes
    return lambda: json.dumps({key: value for key, value in whole.items() if value is not None}).encode()


def _fact(**changes: Any) -> dict[str, Any]:
    return {"digest": "sha256:" + "0" * 64, "size_bytes": 1} | changes


RECORDS: dict[str, Make] = {
    "record: nothing": lambda: b"",
    "record: no UTF-8": lambda: b"\xff\xfe\x00",
    "record: brackets without end": lambda: b"[" * 100_000,
    "record: braces without end": lambda: b'{"files":' * 20_000,
    "record: a deep value": raw('{"format": 2, "files": {}, "steps": ' + "[" * 5000 + "]" * 5000 + "}"),
    "record: a list": raw("[]"),
    "record: null": raw("null"),
    "record: a number of 5,000 digits": raw('{"files": {}, "format": ' + "9" * 5000 + "}"),
    "record: no files": record(files=None),
    "record: files are a list": record(files=["asset.glb"]),
    "record: a file above": record(files={"../evil": _fact()}),
    "record: a file of the root": record(files={"/etc/passwd": _fact()}),
    "record: a file with a zero": record(files={"a\0b": _fact()}),
    "record: a file of 5,000 letters": record(files={"a" * 5000: _fact()}),
    "record: a file beside, above": record(beside=["../evil"]),
    "record: a file beside, of 5,000 letters": record(beside=["9" * 5000]),
    "record: beside is a number": record(beside=7),
    "record: beside are numbers": record(beside=[7]),
    "record: facts are a number": record(files={"asset.glb": 7}),
    "record: facts without a digest": record(files={"asset.glb": {}}),
    "record: of another format": record(format=99),
    "record: of no format": record(format=None),
    "record: no steps": record(steps=None),
    "record: steps are numbers": record(steps=[1, 2]),
    "record: steps without names": record(steps=[{}]),
    "record: no recipe": record(recipe=None),
    "record: a recipe of words": record(recipe="soup"),
    "record: a run of null": raw(record()().decode().replace('"run": {}', '"run": null')),
    "record: no signatures": record(signatures=None),
    "record: signatures above": record(signatures={"files": {"../evil": {"sidecar": "../evil.c2pa"}}}),
    "record: signatures of numbers": record(signatures={"files": {"a": 7}}),
    "record: not a number": raw(
        '{"format": 2, "files": {}, "beside": [], "steps": [{"step": "x", "seconds": NaN, "digest": ""}]}'
    ),
}
