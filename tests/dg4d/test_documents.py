"""Examples of docs/api.md and the notebook, with the real steps and tiny settings; they share their steps."""

import ast
import doctest
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import dg4d

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "api.md"
NOTEBOOK = ROOT / "examples" / "api.ipynb"
FLAGS = doctest.ELLIPSIS


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the picture, and a home."""
    folder = tmp_path_factory.mktemp("place")
    shutil.copyfile(ROOT / "examples" / "newt.png", folder / "newt.png")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(folder / "home"))
        patch.chdir(folder)
        yield folder


def test_every_example_of_the_page_is_true(place: Path) -> None:
    text = "\n".join("" if line.startswith("```") else line for line in PAGE.read_text(encoding="utf-8").splitlines())
    examples = doctest.DocTestParser().get_doctest(text, {}, PAGE.name, str(PAGE), 0)
    assert len(examples.examples) > 20
    said: list[str] = []
    outcome = doctest.DocTestRunner(optionflags=FLAGS).run(examples, out=said.append, clear_globs=False)
    assert outcome.failed == 0, "".join(said)


def test_the_page_has_every_public_name_and_argument() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert not [name for name in dg4d.__all__ if f"`{name}" not in text and f"dg4d.{name}" not in text]
    arguments = dg4d.make.__kwdefaults__
    assert not [name for name in arguments if f"`{name}`" not in text]


def test_the_notebook_runs(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each code cell in order, as a kernel runs it: statements, then the value of a last expression."""
    shutil.copyfile(place / "newt.png", tmp_path / "newt.png")
    monkeypatch.chdir(tmp_path)
    cells = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    shown = []
    for cell in cells:
        body = ast.parse("".join(cell["source"])).body
        last = body.pop() if isinstance(body[-1], ast.Expr) else None
        exec(compile(ast.Module(body, []), NOTEBOOK.name, "exec"), names)
        if isinstance(last, ast.Expr):
            shown.append(eval(compile(ast.Expression(last.value), NOTEBOOK.name, "eval"), names))
    lines, asset, (mesh, count), views, (path, _) = shown
    assert lines[-1].startswith("step 8 of 8: check_asset finished")
    assert "<iframe" in asset._repr_html_()
    assert len(mesh.faces) > 100 and count > 100
    assert views.size == (512, 128)
    assert path.stat().st_size > 1000


def test_the_notebook_is_kept_without_output() -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert not [cell for cell in cells if cell.get("outputs") or cell.get("execution_count")]
