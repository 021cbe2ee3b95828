"""Help texts: complete, in 80 columns, and true to the program."""

import subprocess
import sys
from typing import get_args

import pytest
import typer
from typer.testing import CliRunner

from dg4d_lib.input_settings import Motion
from flows.cli import app
from flows.commands import options
from steps.contract import LARGEST_SEED
from steps.profiles import PROFILES

NARROW = {"COLUMNS": "80", "TERM": "dumb"}


def paths(command: object, path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    below = getattr(command, "commands", {})
    return [path, *(found for name, one in below.items() for found in paths(one, (*path, name)))]


COMMANDS = paths(typer.main.get_command(app))


def run(*arguments: str) -> str:
    done = CliRunner().invoke(app, arguments, env=NARROW)
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_help_fits_80_columns_breaks_no_name_and_shows_no_type_for_flags(path: tuple[str, ...]) -> None:
    lines = run(*path, "--help").splitlines()
    assert max(map(len, lines)) <= 80
    assert not [line for line in lines if line.endswith("-")], "a name is broken at its hyphen"
    assert not [line for line in lines if "<bool>" in line]


@pytest.mark.parametrize("path", [path for path in COMMANDS if path in {(), ("weights",), ("store",)}], ids=" ".join)
def test_lists_of_commands_cut_no_sentence(path: tuple[str, ...]) -> None:
    assert "..." not in run(*path, "--help").split("Commands:")[1]


def test_help_of_make_lists_the_profiles_and_motions_that_there_are() -> None:
    shown = " ".join(run("make", "--help").split())
    assert set(options.PROFILES) == set(PROFILES) and set(options.MOTIONS) == set(get_args(Motion))
    assert f"preset: {', '.join(options.PROFILES)}" in shown
    assert f"driving.motion=NAME: {', '.join(options.MOTIONS)}" in shown
    assert options.SEED_MAX == LARGEST_SEED


def test_shell_completion_is_offered_and_knows_profiles_and_settings() -> None:
    assert "--install-completion" in run("--help")
    assert options.complete_profile("vid") == ["video", "video-fast"]
    assert options.complete_setting("motion.iter") == ["motion.iterations="]


def test_settings_prints_value_range_and_meaning() -> None:
    shown = run("settings", "motion.iterations", "--profile", "video")
    assert shown.startswith("motion.iterations = 500\n") and "integer, 1 to 20000; default 200" in shown
    assert "prior.weights" in run("settings") and "allowed" not in run("settings")


def test_settings_refuses_a_misspelt_name_with_the_nearest() -> None:
    done = CliRunner().invoke(app, ["settings", "motion.iteration"], env=NARROW)
    assert done.exit_code == 65 and "did you mean motion.iterations?" in done.output


BY_RICH = """
from flows.commands.endings import exit_on_error
from flows.commands.terminal import console
import typer

def hello() -> None:
    with exit_on_error():
        console().print("hello")

typer.run(hello)
"""


@pytest.mark.parametrize("arguments", [["-m", "flows.cli", "settings"], ["-c", BY_RICH]], ids=["settings", "by rich"])
def test_output_that_nobody_reads_ends_the_command_without_a_message(arguments: list[str]) -> None:
    program = [sys.executable, "-P", *arguments]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as started:
        assert started.stdout is not None and started.stderr is not None
        started.stdout.close()
        said = started.stderr.read()
    assert (started.returncode, said) == (141, "")
