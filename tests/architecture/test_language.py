"""Openings of docstrings: a verb or a noun, not a question word."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("dg4d", "dg4d_lib", "steps", "flows", "training", "benchmarks", "experiments", "examples", "deploy", "docs")
QUESTION_WORDS = {"What", "How", "Where", "Which", "Whether", "Who", "Whoever", "Whom", "Whose"}
MOST = 0.005  # share of docstrings; 24 % of flows had such an opening once
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def docstrings(path: Path) -> list[tuple[str, str]]:
    """Return place and text of every docstring in a file."""
    nodes = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, DOCUMENTED)]
    return [(f"{path}:{getattr(node, 'lineno', 1)}", text) for node in nodes if (text := ast.get_docstring(node))]


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_do_not_open_with_a_question_word(package: str) -> None:
    found = [each for path in sorted((ROOT / package).rglob("*.py")) for each in docstrings(path)]
    asked = [f"{place}: {text.splitlines()[0]}" for place, text in found if text.split()[0] in QUESTION_WORDS]
    assert len(asked) <= MOST * len(found), "\n".join(asked)


def test_a_question_word_is_found(tmp_path: Path) -> None:
    (tmp_path / "riddle.py").write_text('"""What eats steps."""\n\ndef f():\n    """Return one."""\n')
    (module, _), (function, opening) = sorted(docstrings(tmp_path / "riddle.py"), key=lambda each: each[0])
    assert (module.rsplit(":", 1)[1], function.rsplit(":", 1)[1], opening) == ("1", "3", "Return one.")
