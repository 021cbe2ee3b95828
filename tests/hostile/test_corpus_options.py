"""Command lines with mistakes: one sentence and status 65, or the usage and status 2, before anything is begun."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flows import cli
from tests.hostile.conftest import Place
from tests.hostile.options import OPTIONS, SOUND
from tests.hostile.outcomes import Refused
from tests.hostile.table import COMMANDS


class WorkBegins(BaseException):
    """Raised in the place of the first work."""


@pytest.fixture(autouse=True)
def no_work(furnished: Place, monkeypatch: pytest.MonkeyPatch) -> Place:
    def begin(*_: object, **__: object) -> None:
        raise WorkBegins

    monkeypatch.setattr("flows.convert.connect", begin)
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")  # quicker than reading the source
    return furnished


def tree(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_every_command_line_is_in_the_table() -> None:
    assert set(COMMANDS) == set(OPTIONS)
    assert len(OPTIONS) >= 36


@pytest.mark.parametrize("name", OPTIONS)
def test_a_mistake_is_refused_before_any_work(name: str, no_work: Place) -> None:
    expected = COMMANDS[name]
    before = tree(no_work.work)
    result = CliRunner().invoke(cli.app, OPTIONS[name])
    assert result.exit_code == expected.status, result.output
    assert re.search(expected.says, result.output), result.output
    assert "Traceback" not in result.output
    assert len(result.output) < 3000, "a sentence, not a listing"
    if expected.status != 2:
        assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    assert tree(no_work.work) == before
    assert no_work.stored() == []


@pytest.mark.parametrize("name", SOUND)
def test_what_is_odd_and_right_begins(name: str) -> None:
    with pytest.raises(WorkBegins):
        CliRunner().invoke(cli.app, SOUND[name])


def test_refusals_are_sentences() -> None:
    assert all(isinstance(expected, Refused) and expected.status in (2, 65, 69) for expected in COMMANDS.values())
