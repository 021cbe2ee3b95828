"""Commands `store ls`, `store show`, `store gc` and `store verify`."""

import re
import zipfile
from typing import TYPE_CHECKING, Annotated

import typer

from flows.commands.endings import exit_on_error
from flows.commands.options import finite
from flows.exit_status import EXIT_BAD_INPUT

if TYPE_CHECKING:
    from flows.engine.versions import Version
    from steps.store.artifact_store import ArtifactStore

LEAST_DIGITS = 6  # of an abbreviated digest
SHOWN_DIGITS = 12

store = typer.Typer(
    name="store",
    help="List, show, verify and collect versions and artifacts.",
    no_args_is_help=True,
)


@store.command("ls")
def list_versions() -> None:
    """List items and versions, newest first, with their disk space."""
    with exit_on_error():
        from rich.table import Column, Table

        from flows import home
        from flows.commands import terminal
        from flows.engine.versions import versions
        from flows.formatting.numbers import format_size

        place = home.store()
        sizes = {entry.name: entry.size_bytes for entry in place.artifacts()}
        known = versions(place)
        words = (Column("item", overflow="fold"), "version", "finished", "profile")
        numbers = (Column("package", justify="right"), Column("in all", justify="right"))
        table = Table(*words, *numbers, box=None, pad_edge=False)
        before = None
        for version in known:
            table.add_row(
                terminal.plain(version.item) if version.item != before else "",
                _short(version.order),
                _when(version),
                version.profile,
                format_size(version.package.size_bytes),
                format_size(sum(sizes.get(digest, 0) for digest in version.artifacts())),
            )
            before = version.item
        out = terminal.console()
        if known:
            out.print(table)
        items = len({version.item for version in known})
        total = f"{len(sizes)} artifacts, {format_size(sum(sizes.values()))}"
        out.print(f"{items} items, {len(known)} versions, {total} in {place.address}", markup=False)


@store.command()
def show(
    name: Annotated[str, typer.Argument(metavar="ITEM|DIGEST", help="an item, or a prefix of a digest")],
) -> None:
    """Show an item, a version, or the references to an artifact."""
    with exit_on_error():
        from dg4d_lib.errors import BadInput
        from flows import home
        from flows.engine.versions import versions

        place = home.store()
        known = versions(place)
        if of_item := [version for version in known if version.item == name]:
            for version in of_item:
                _show_version(version, place)
            return
        digits = name.removeprefix("sha256:").lower()
        if not re.fullmatch(rf"[0-9a-f]{{{LEAST_DIGITS},64}}", digits):
            items = sorted({version.item for version in known})
            some = ", ".join(items[:5]) + (", ..." if len(items) > 5 else "")
            raise BadInput(
                f"{name!r} is neither an item ({some or 'none yet'}) nor a digest of {LEAST_DIGITS} digits or more"
            )
        digest = f"sha256:{digits}"
        of_job = [version for version in known if version.order.startswith(digest)]
        artifacts = [entry for entry in place.artifacts() if entry.name.startswith(digest)]
        if not of_job and not artifacts:
            raise BadInput(f"no digest of a version or artifact in {place.address} begins with {digits}")
        for version in of_job:
            _show_version(version, place)
        for entry in artifacts:
            _show_artifact(entry.name, entry.size_bytes, known)


@store.command()
def gc(
    keep: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="versions to keep per item, newest first  [default: all]")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="list the artifacts without removing them")] = False,
    grace_hours: Annotated[
        float, typer.Option(min=0, callback=finite, metavar="H", help="keep artifacts younger than this many hours")
    ] = 24.0,
) -> None:
    """Remove artifacts that nothing refers to.

    Artifacts of kept versions and of running commands stay, so it is safe at any time.
    """
    with exit_on_error():
        from flows import home
        from flows.engine.collecting import collect
        from flows.formatting.numbers import format_size

        place = home.store()
        gone = collect(place, home.records(), keep, dry_run, grace_hours * 3600)
        for version in gone.versions:
            _echo(f"version {_short(version.order)} of {version.item}, {_when(version)}")
        size = format_size(sum(entry.size_bytes for entry in gone.artifacts))
        verb = "would be removed" if dry_run else "were removed"
        typer.echo(
            f"{len(gone.versions)} versions and {len(gone.artifacts)} artifacts ({size}) {verb} from {place.address}"
        )


@store.command()
def verify() -> None:
    """Verify every artifact; list damaged and missing ones."""
    with exit_on_error():
        from flows import home
        from flows.engine.versions import faults, users, versions

        place = home.store()
        known = versions(place)
        sizes = {entry.name: entry.size_bytes for entry in place.artifacts()}
        wrong = faults(place, known, sizes)
        of = users(known)
        for digest, what in sorted(wrong.items()):
            _echo(f"{digest} {what}: {_needed_by(of.get(digest, []))}")
        if wrong:
            typer.echo(
                f"dg4d: {len(wrong)} of {len(sizes | wrong)} artifacts are damaged or missing; "
                "the next run that needs them makes them again",
                err=True,
            )
            raise typer.Exit(EXIT_BAD_INPUT)
        typer.echo(f"{len(sizes)} artifacts of {len(known)} versions are intact")


def _show_version(version: "Version", place: "ArtifactStore") -> None:
    from flows.formatting.numbers import format_size

    sizes = {entry.name: entry.size_bytes for entry in place.artifacts()}
    _echo(f"{version.item}  version {version.order}")
    _echo(f"  finished  {_when(version)}, profile {version.profile}, seed {version.seed}")
    for digest, what in version.artifacts().items():
        size = format_size(sizes[digest]) if digest in sizes else "missing"
        _echo(f"  {_short(digest)}  {size:>9}  {what}")
    if version.package.digest in sizes:
        with zipfile.ZipFile(place.path(version.package)) as package:
            _echo("  files of the package")
            for entry in package.infolist():
                _echo(f"  {'':{SHOWN_DIGITS}}  {format_size(entry.file_size):>9}  {entry.filename}")


def _show_artifact(digest: str, size_bytes: int, known: list["Version"]) -> None:
    from flows.engine.versions import users
    from flows.formatting.numbers import format_size

    _echo(f"{digest}  {format_size(size_bytes)}")
    for version, what in users(known).get(digest, []):
        _echo(f"  {what} of {version.item}, version {_short(version.order)}")
    if digest not in users(known):
        _echo("  no version refers to it")


def _echo(text: str) -> None:
    """Print a line that contains names of users, escaped."""
    from flows.formatting.escaping import visible

    typer.echo(visible(text))


def _needed_by(of: list[tuple["Version", str]]) -> str:
    if not of:
        return "no version refers to it"
    version, what = of[0]
    more = f", and {len(of) - 1} more" if len(of) > 1 else ""
    return f"{what} of {version.item}, version {_short(version.order)}{more}"


def _short(digest: str) -> str:
    return digest.removeprefix("sha256:")[:SHOWN_DIGITS]


def _when(version: "Version") -> str:
    return version.finished.replace("T", " ").removesuffix("+00:00") + " UTC"
