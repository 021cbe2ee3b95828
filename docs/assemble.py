"""Pages of the documentation site, collected from the repository.

    python docs/assemble.py out/pages

Pages keep their paths, so links between them stay valid; README.md becomes index.md. Files that pages link to, such as
examples, are copied beside them.
"""

import re
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = (
    *("README.md", "ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md", "DECISIONS.md", "SECURITY.md"),
    *("dg4d_lib/README.md", "benchmarks/RESULTS.md", "examples/README.md", "integrations/comfyui/README.md"),
    *(f"docs/{path.name}" for path in sorted(Path(__file__).parent.glob("*.md"))),
)
LINK = re.compile(r"(\]\()([^)#\s]+)(#[^)\s]*)?\)")


def main(target: Path) -> None:
    """Write all pages below a folder, which is emptied first."""
    shutil.rmtree(target, ignore_errors=True)
    for page in PAGES:
        place = target / ("index.md" if page == "README.md" else page)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(_converted(page, target), encoding="utf-8")
    shutil.copyfile(ROOT / "docs" / "site.css", target / "docs" / "site.css")


def _converted(page: str, target: Path) -> str:
    """Return the text of a page with its links to README.md renamed; copies the files that it links to."""

    def link(match: re.Match[str]) -> str:
        address = match[2]
        if "://" in address or address.startswith("mailto:"):
            return match[0]
        linked = (ROOT / page).parent.joinpath(address).resolve().relative_to(ROOT)
        if linked.as_posix() == "README.md":
            return f"](index.md{match[3] or ''})"
        if linked.as_posix() not in PAGES:
            copy = target / linked
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / linked, copy)
        return match[0]

    return LINK.sub(link, (ROOT / page).read_text(encoding="utf-8"))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
