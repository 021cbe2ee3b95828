"""Command `doctor`."""

from typing import TYPE_CHECKING

import typer

from flows.commands.endings import exit_on_error
from flows.commands.options import AsJson, Profile
from flows.exit_status import EXIT_MISSING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from steps.runtime.readiness import Machine, Readiness

COLUMNS = 80
NONE = "-"


def doctor(profile: Profile = "preview", as_json: AsJson = False) -> None:
    """Check this machine against the needs of each profile.

    Shows hardware, packages and weights, and the one command that gets what is missing. The exit status is 0 if the
    profile can run, else 69.
    """
    with exit_on_error():
        from flows.commands import terminal
        from steps.profiles import PROFILES
        from steps.profiles import profile as find_profile
        from steps.runtime.readiness import examine_machine, examine_profile

        find_profile(profile)
        machine = examine_machine()
        found = {name: examine_profile(name, machine) for name in PROFILES}
        if as_json:
            typer.echo(_json(profile, machine, found))
        else:
            _print(terminal.console(), profile, machine, found)
        if found[profile].state == "missing":
            raise typer.Exit(EXIT_MISSING)


def _json(profile: str, machine: "Machine", found: dict[str, "Readiness"]) -> str:
    import json

    profiles = {
        name: {**one.model_dump(mode="json"), "missing_gb": round(one.missing_gb, 2)} for name, one in found.items()
    }
    facts = {"profile": profile, "state": found[profile].state, "machine": machine.model_dump(mode="json")}
    return json.dumps({**facts, "profiles": profiles}, indent=1)


def _print(out: "Console", profile: str, machine: "Machine", found: dict[str, "Readiness"]) -> None:
    from flows.formatting.escaping import visible

    for table in (_machine_table(machine), _profile_table(found)):
        out.print(table, width=min(COLUMNS, out.width), soft_wrap=False)
    readiness = found[profile]
    out.print(f"{profile}: {readiness.state}", markup=False)
    for lack in readiness.lacks:
        out.print(f"  lacks {visible(lack)}", markup=False)
    if readiness.command:
        out.print(f"  {readiness.command}", markup=False, soft_wrap=True)
    if readiness.weights and machine.gpu_problem:
        out.print("  Without a GPU its networks run on the CPU, which takes days.", markup=False)


def _machine_table(machine: "Machine") -> "Table":
    table = _table("this machine", ("part", "here"))
    packages = ", ".join(f"{name} {version}" for name, version in machine.packages.items() if version)
    absent = ", ".join(name for name, version in machine.packages.items() if not version)
    gpus = ", ".join(f"{gpu.name}, {gpu.memory_gib:g} GiB" for gpu in machine.gpus)
    driver = f"{machine.driver or NONE}, up to CUDA {machine.cuda}" if machine.cuda else NONE
    rows = {
        "processor": f"{machine.processor}, {machine.cores} cores",
        "memory": f"{machine.memory_gib:g} GiB",
        "disk": f"{machine.disk_free_gb:g} GB free for {machine.weights_folder}",
        "GPU": gpus or "none",
        "driver": driver,
        "GPU use": machine.gpu_problem or "works",
        "gsplat kernels": machine.gsplat_kernels,
        "packages": packages or NONE,
        "not installed": absent or NONE,
    }
    for part, value in rows.items():
        table.add_row(part, _plain(value))
    return table


def _profile_table(found: dict[str, "Readiness"]) -> "Table":
    table = _table("profiles", ("profile", "state", "GPU", "weights", "command"))
    for name, one in found.items():
        names = ", ".join(each.name + (" (damaged)" if each.state == "damaged" else "") for each in one.weights)
        size = f"; {one.missing_gb:.1f} GB missing" if one.missing_gb else ""
        gpu = f"{one.gpu_gib:g} GiB" if one.gpu_gib else NONE
        table.add_row(name, one.state, gpu, _plain(names or NONE) + size, one.command or NONE)
    return table


def _table(title: str, headings: tuple[str, ...]) -> "Table":
    from rich.table import Table

    table = Table(title=title, title_justify="left", title_style="bold", box=None, padding=(0, 2, 0, 0))
    for heading in headings:
        table.add_column(heading, overflow="fold", no_wrap=heading in ("part", "profile", "state", "GPU"))
    return table


def _plain(text: str) -> str:
    from flows.commands.terminal import plain

    return plain(text)
