"""Escaping of foreign text for terminals, Markdown, and the spreadsheets that open CSV files."""

import re
from typing import Any

# control characters but for tab and line feed, marks that change the direction of writing, and lone surrogates
_INVISIBLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")
# what means something anywhere; emphasis outside of words; addresses that become links; lists, rules and headings
_MARKUP = re.compile(r"[\\`*\[\]<>#|~@&]|(?<!\w)_|_(?!\w)|(?<=www)\.|:(?=//)|^[-+=]", re.IGNORECASE)
_NUMBERED = re.compile(r"^(\d+)([.)])")
SHOWN = 80  # letters of a value in a message
# first letters of a formula, by OWASP's "CSV Injection"; the last four are the wide forms of the first
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")


def visible(text: str) -> str:
    r"""Return text in which what a terminal would obey is written out, as `\x1b`; line breaks and tabs stay.

    The result can always be encoded.
    """
    return _INVISIBLE.sub(lambda found: _written_out(ord(found.group())), text)


def markdown(text: object) -> str:
    """Return text that Markdown shows letter by letter, in one line: no links, pictures, tables, HTML or emphasis."""
    line = " ".join(visible(str(text)).split())
    return _NUMBERED.sub(r"\1\\\2", _MARKUP.sub(r"\\\g<0>", line))


def cell(value: Any) -> Any:
    """Return the value of a CSV cell; a text that a spreadsheet would take for a formula gets an apostrophe before it.

    Numbers stay numbers.
    """
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def quoted(value: object) -> str:
    """Return a value as messages show it: in quotes, and shortened."""
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _written_out(code: int) -> str:
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
