"""Generator of docs/cli.md, docs/settings.md and docs/provenance.schema.json from the program.

Run `make docs`, or `python docs/generate.py`; with `--check` it writes nothing and fails if a page is out of date.
"""

import json
import sys
from pathlib import Path

import typer
from typer.testing import CliRunner

from flows import cli
from flows.inputs.setting_reference import SECTIONS, Setting, all_settings, value_in
from flows.packages.record_schema import record_schema
from steps.profiles import PROFILES

DOCS = Path(__file__).parent
NOTE = "<!-- Written by `make docs` from the program; do not edit. -->\n"
TERMINAL = {"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1", "DG4D_PRICE_PER_HOUR": ""}


def main(arguments: list[str]) -> None:
    """Write the pages, or check them."""
    stale = [name for name, text in pages().items() if _read(DOCS / name) != text]
    if "--check" in arguments:
        sys.exit(f"out of date: {', '.join(stale)}; run `make docs`" if stale else 0)
    for name in stale:
        (DOCS / name).write_text(pages()[name], encoding="utf-8")


def pages() -> dict[str, str]:
    """Return the generated pages by file name."""
    schema = json.dumps(record_schema(), indent=1) + "\n"
    return {"cli.md": commands_page(), "settings.md": settings_page(), "provenance.schema.json": schema}


def commands_page() -> str:
    """Return the page of all commands with their options."""
    parts = [NOTE, "# Commands\n", "`dg4d COMMAND --help` prints the same. `dg4d --install-completion` adds completion"]
    parts[-1] += " to your shell.\n"
    for path in _paths(typer.main.get_command(cli.app), ()):
        shown = CliRunner().invoke(cli.app, [*path, "--help"], prog_name="dg4d", env=TERMINAL).output.strip("\n")
        parts.append(f"## dg4d {' '.join(path)}".rstrip() + f"\n\n```text\n{shown}\n```\n")
    return "\n".join(parts)


def settings_page() -> str:
    """Return the page of all settings, a table per section and kind."""
    intro = (
        "Change a setting with `--set NAME=VALUE`; values are JSON or plain text. The column `default` holds the"
        "\npaper's numbers where the paper has them; a profile sets which models are used."
        "\n`dg4d settings --profile paper` prints the paper's configuration. `dg4d make` starts from the profile"
        "\n`preview`, whose values are listed where they differ. `dg4d settings NAME` prints the same."
        '\n"Ours" marks a choice that is in neither the paper nor its public code; "public code" is the authors\''
        "\nrepository.\n"
    )
    parts = [NOTE, "# Settings\n", intro]
    for section in SECTIONS:
        rows = [one for one in all_settings() if one.name == section or one.name.startswith(f"{section}.")]
        parts.append(f"## {section}\n")
        for condition in dict.fromkeys(one.only_with for one in rows):
            if condition:
                parts.append(f"### With `{condition}`\n")
            parts.append(_table([one for one in rows if one.only_with == condition]))
    return "\n".join(parts)


def _table(rows: list[Setting]) -> str:
    preview = PROFILES["preview"]
    lines = ["| name | default | `preview` | allowed | meaning |", "| --- | --- | --- | --- | --- |"]
    for one in rows:
        value = value_in(preview, one)
        differs = f"`{value}`" if value and value != one.default else ""
        default = f"`{one.default}`" if one.default else ""
        lines.append(f"| `{one.name}` | {default} | {differs} | {one.allowed} | {one.meaning.replace('|', '&#124;')} |")
    return "\n".join(lines) + "\n"


def _paths(command: object, path: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Return the path of a command and of those below it."""
    below = getattr(command, "commands", {})
    return [path, *(found for name, one in below.items() for found in _paths(one, (*path, name)))]


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.exists() else ""


if __name__ == "__main__":
    main(sys.argv[1:])
