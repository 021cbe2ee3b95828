"""License id on the model card in a folder of weights."""

import re
from pathlib import Path

CARD = "README.md"
LARGEST_CARD = 1 << 20  # bytes
FRONT_MATTER = re.compile(r"\A---\s*\n(.*?)^---\s*$", re.DOTALL | re.MULTILINE)
ENTRY = r"^{}:[ \t]*['\"]?([\w.+-]+)['\"]?[ \t]*$"


def card_license(folder: Path) -> str:
    """Return the `license` of the front matter of a folder's README.md, lower case; empty if there is none.

    A license called `other` has its own name in `license_name`.
    """
    card = folder / CARD
    try:
        if card.stat().st_size > LARGEST_CARD:
            return ""
        front = FRONT_MATTER.match(card.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return ""
    found = _entry(front.group(1), "license") if front else ""
    return (_entry(front.group(1), "license_name") or found) if front and found == "other" else found


def _entry(text: str, key: str) -> str:
    found = re.search(ENTRY.format(key), text, re.MULTILINE)
    return found.group(1).lower() if found else ""
