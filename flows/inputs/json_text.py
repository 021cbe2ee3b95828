"""JSON that somebody else wrote: bounded in depth, without NaN, lone surrogates and repeated keys."""

import json
import math
from typing import Any

from flows.formatting.escaping import quoted

DEEPEST = 100  # brackets within brackets; a provenance record has about ten
MOST_DIGITS = 100  # of a whole number; Python itself refuses more than 4300


class UnfitJSON(ValueError):
    """JSON that is well-formed and still cannot be used; says why."""


def loads(text: str) -> Any:
    """Parse JSON.

    Raises:
        UnfitJSON: it is nested too deeply, repeats a key, or holds a number or a text that no file could hold.
        ValueError: it is no JSON.
    """
    try:
        value = json.loads(text, object_pairs_hook=_object, parse_int=_integer)
    except RecursionError:
        raise UnfitJSON(f"brackets are nested more than {DEEPEST} deep") from None
    _check(value)
    return value


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise UnfitJSON(f"the key {quoted(twice)} is there twice")
    return found


def _integer(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise UnfitJSON(f"a number has {len(digits)} digits; at most {MOST_DIGITS} are read")
    return int(digits)


def _check(value: Any) -> None:
    """Look at everything in a value, without recursion."""
    waiting = [(value, 1)]
    while waiting:
        one, depth = waiting.pop()
        if depth > DEEPEST:
            raise UnfitJSON(f"brackets are nested more than {DEEPEST} deep")
        match one:
            case dict():
                waiting += [(key, depth) for key in one]
                waiting += [(inner, depth + 1) for inner in one.values()]
            case list():
                waiting += [(inner, depth + 1) for inner in one]
            case str() if not one.isascii() and any("\ud800" <= letter <= "\udfff" for letter in one):
                raise UnfitJSON("a text holds half a character (a lone surrogate)")
            case float() if not math.isfinite(one):
                raise UnfitJSON("a number is NaN, infinite, or too large; leave it out, or write null")
            case _:
                pass
