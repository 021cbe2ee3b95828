"""Escaping of untrusted text for terminals, Markdown, and the spreadsheets that open CSV files."""

import re
from typing import Any

# control characters except tab and line feed, marks that change the writing direction, and lone surrogates
_INVISIBLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]")
# markup that works anywhere; emphasis outside of words; addresses that become links; lists, rules and headings
_MARKUP = re.compile(r"[\\`*\[\]<>#|~@&]|(?<!\w)_|_(?!\w)|(?<=www)\.|:(?=//)|^[-+=]", re.IGNORECASE)
_NUMBERED = re.compile(r"^(\d+)([.)])")
# first characters of a formula, by OWASP's "CSV Injection"; the last four are the fullwidth forms of the first
_FORMULA = ("=", "+", "-", "@", "\t", "\r", "\n", "\uff1d", "\uff0b", "\uff0d", "\uff20")


def visible(text: str) -> str:
    r"""Write out terminal control characters, as `\x1b`; line breaks and tabs stay.

    The result can always be encoded.
    """
    return _INVISIBLE.sub(lambda found: ascii(found.group())[1:-1], text)


def markdown(text: object) -> str:
    """Escape text for one line of Markdown: no links, pictures, tables, HTML or emphasis."""
    line = " ".join(visible(str(text)).split())
    return _NUMBERED.sub(r"\1\\\2", _MARKUP.sub(r"\\\g<0>", line))


def csv_cell(value: Any) -> Any:
    """Put an apostrophe before text that a spreadsheet would run as a formula; numbers stay numbers."""
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
