"""Command `settings`."""

import textwrap
from typing import TYPE_CHECKING, Annotated

import typer

from flows.commands.endings import exit_on_error
from flows.commands.options import Profile

if TYPE_CHECKING:
    from flows.inputs.setting_reference import Setting

COLUMNS = 80  # width of the text below each name
INDENT = "    "


def settings(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="setting or section, for example motion.iterations or motion")
    ] = None,
    profile: Profile = "preview",
) -> None:
    """List settings, their values, allowed values and meanings.

    Without NAME, only names and values. Change one with --set NAME=VALUE.
    """
    with exit_on_error():
        from flows.inputs.setting_reference import all_settings, find_settings, value_in
        from steps.profiles import profile as find_profile

        pipeline = find_profile(profile)
        for one in find_settings(name) if name else all_settings():
            kind = f"  (with {one.only_with})" if one.only_with else ""
            typer.echo(f"{one.name} = {value_in(pipeline, one) or one.default}{kind}")
            if name:
                typer.echo(_details(one))


def _details(one: "Setting") -> str:
    default = f"; default {one.default}" if one.default else ""
    paragraphs = (one.meaning, f"allowed: {one.allowed}{default}")
    return "\n".join(map(indented, paragraphs))


def indented(text: str) -> str:
    """Return a paragraph, indented and broken between words."""
    return textwrap.fill(
        text,
        COLUMNS,
        initial_indent=INDENT,
        subsequent_indent=INDENT,
        break_long_words=False,
        break_on_hyphens=False,
    )
