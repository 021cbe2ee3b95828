"""The project's files and syntax trees, as the tests of its shape see them."""

import ast
import re
import subprocess
from functools import cache
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).parents[2]
PACKAGES = ("dg4d", "dg4d_lib", "steps", "flows")
CODE = (*PACKAGES, "examples", "benchmarks", "experiments", "tests", "deploy", "training", "integrations")
GENERATED = {".git", ".venv", "out", "build", "dist", "__pycache__"}  # where git is not asked


@cache
def files() -> tuple[str, ...]:
    """Every file of the project by its path from the root, and Python files that are not added to git yet."""
    known = _git("ls-files")
    if "README.md" not in known:
        return tuple(sorted(_walk(ROOT)))
    fresh = {path for path in _git("ls-files", "--others", "--exclude-standard") if path.split("/")[0] in CODE}
    known |= {path for path in fresh if path.endswith(".py")}
    return tuple(sorted(path for path in known if (ROOT / path).is_file()))


def modules(*folders: str) -> list[str]:
    """The Python files in these folders of the root."""
    return [path for path in files() if path.endswith(".py") and path.split("/")[0] in folders]


def text(path: str) -> str:
    """The content of a file."""
    return (ROOT / path).read_text(encoding="utf-8")


def pins() -> dict[str, str]:
    """Return the version of every locked package by its canonical name, without the part that names a build."""
    locks = (
        text(path)
        for path in files()
        if path.startswith("deploy/locks/") and not path.endswith(("/tools.txt", "/docs.txt"))
    )
    return dict(re.findall(r"^([a-z0-9-]+)==([^ +]+)", "\n".join(locks), re.MULTILINE))


@cache
def tree(path: str) -> ast.Module:
    """The syntax tree of a Python file."""
    return ast.parse(text(path), path)


def fenced(document: str, heading: str) -> str:
    """The first fenced block below a heading of a Markdown document."""
    below = document.split(f"\n{heading}\n", 1)
    assert len(below) == 2, f"there is no heading {heading!r}"
    return below[1].split("```", 2)[1].partition("\n")[2]


def _git(*arguments: str) -> set[str]:
    command = ["git", "-C", str(ROOT), *arguments, "-z"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return set()
    return {path for path in done.stdout.split("\0") if path} if done.returncode == 0 else set()


def _walk(folder: Path) -> set[str]:
    found = set()
    for path in folder.iterdir():
        cache_of_a_tool = path.name.startswith(".") and path.name.endswith("_cache")
        if path.name in GENERATED or cache_of_a_tool or path.name.endswith(".egg-info"):
            continue
        found |= _walk(path) if path.is_dir() else {PurePosixPath(path.relative_to(ROOT)).as_posix()}
    return found
