"""Untrusted JSON: bounded in depth, without NaN, lone surrogates and repeated keys."""

import json
import math
from pathlib import Path
from typing import Any

from dg4d_lib.errors import quoted
from steps.store.files import require_regular

DEEPEST = 100  # nested brackets; a provenance record has about ten
MOST_DIGITS = 100  # of an integer; Python itself refuses more than 4300


class UnfitJSON(ValueError):
    """Well-formed JSON that cannot be used."""


def loads(text: str) -> Any:
    """Parse JSON.

    Raises:
        UnfitJSON: it is nested too deeply, repeats a key, or holds a number or a text that cannot be stored.
        ValueError: it is not JSON.
    """
    try:
        value = json.loads(
            text, object_pairs_hook=_object, parse_int=_integer, parse_float=_finite, parse_constant=_finite
        )
    except RecursionError:
        raise UnfitJSON(f"brackets are nested more than {DEEPEST} deep") from None
    _check(value)
    return value


def read_object(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file; empty if there is no such file, or it holds something else."""
    try:
        require_regular(path)
        content = loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for name in names if names.count(name) > 1)
        raise UnfitJSON(f"the key {quoted(repeated)} is there twice")
    return found


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise UnfitJSON(f"a number has {len(digits)} digits; at most {MOST_DIGITS} are allowed")
    return int(digits)


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise UnfitJSON("a number is NaN, infinite, or too large; leave it out, or write null")
    return value


def _check(value: Any, depth: int = 1) -> None:
    """Refuse deep nesting and lone surrogates."""
    if depth > DEEPEST:
        raise UnfitJSON(f"brackets are nested more than {DEEPEST} deep")
    if isinstance(value, str) and not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value):
        raise UnfitJSON("a text holds half a character (a lone surrogate)")
    if isinstance(value, dict):
        value = [*value, *value.values()]
    for inner in value if isinstance(value, list) else ():
        _check(inner, depth + 1)
