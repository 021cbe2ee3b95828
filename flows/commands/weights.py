"""Commands `weights list`, `weights pull` and `weights check`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.commands.endings import exit_on_error
from flows.commands.settings import indented

if TYPE_CHECKING:
    from dg4d_lib.weights.lock import LockEntry
    from dg4d_lib.weights.registry import Weights

weights = typer.Typer(
    name="weights",
    help="List, download and verify pretrained weights.",
    no_args_is_help=True,
)

NOT_COMPARED = "there are no published digests to compare with"
Names = Annotated[
    list[str],
    typer.Argument(metavar="NAME", help="a name from `dg4d weights list`, or the id of a Hugging Face repository"),
]


@weights.command("list")
def show(
    files: Annotated[bool, typer.Option("--files", help="also list every file: SHA-256, bytes, name")] = False,
) -> None:
    """List known and pulled weights with license, size and state."""
    with exit_on_error():
        from dg4d_lib.weights.lock import read_lock
        from flows.formatting.escaping import visible
        from steps.runtime.weights import weights_home

        locks = read_lock(weights_home())
        rows = [(one, _row(one, locks.get(one.name))) for one in _all_of_them()]
        width = max(len(one.name) for one, _ in rows)
        typer.echo(_columns(("name", "here", "GB", "revision", "commercial"), width))
        for one, (*columns, license_text) in rows:
            typer.echo(_columns(columns, width))
            for text in (license_text, one.purpose, one.hub_id):  # below the row, so that no name is broken
                typer.echo(indented(visible(text)))
        typer.echo(f"folder: {weights_home()}; a setting may name another folder instead")
        typer.echo("the first pull records revision and digests; later uses are checked against them")
        for one in _all_of_them() if files else ():
            for path, sha256, size in _files_of(one, locks.get(one.name)):
                typer.echo(f"{sha256}  {size:>12}  {one.name}/{path}")


@weights.command()
def pull(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME",
            help="a profile, whose weights are all downloaded; a name from `dg4d weights list`; or the id of a "
            "Hugging Face repository",
        ),
    ],
) -> None:
    """Download weights and record their revision and digests.

    Sizes are shown first. Weights that are present are skipped, and an interrupted download resumes.
    """
    with exit_on_error():
        from dg4d_lib.weights.pull import download, plan_pull
        from dg4d_lib.weights.registry import lookup_weights
        from flows.engine.free_space import require_room_for_weights
        from steps.runtime.weights import license_of, weights_home

        wanted = _expand(names)
        home = weights_home()
        plans = [plan_pull(lookup_weights(name), home) for name in wanted]
        for name, plan in zip(wanted, plans, strict=True):
            typer.echo(f"{name}: {_gb(plan.missing_bytes)} of {_gb(plan.total_bytes)} GB to download")
        missing = sum(plan.missing_bytes for plan in plans)
        require_room_for_weights(home, missing)
        if len(plans) > 1:
            typer.echo(f"all: {_gb(missing)} of {_gb(sum(plan.total_bytes for plan in plans))} GB to download")
        home.mkdir(parents=True, exist_ok=True)
        for name, plan in zip(wanted, plans, strict=True):
            locked = download(plan, home)
            typer.echo(f"{name}: {_size(locked)} GB, revision {locked.revision}; {license_of(name)}")


@weights.command()
def check(
    names: Annotated[list[str] | None, typer.Argument(metavar="NAME", help="default: all that are present")] = None,
) -> None:
    """Verify every file against recorded or published digests."""
    with exit_on_error():
        from dg4d_lib.errors import BackendUnavailable
        from dg4d_lib.weights.locate import find_problems, find_unpublished, find_weights
        from dg4d_lib.weights.lock import read_lock
        from dg4d_lib.weights.registry import lookup_weights
        from steps.runtime.weights import weights_home

        home = weights_home()
        locks = read_lock(home)
        broken = []
        wanted = names or [one.name for one in _all_of_them() if _place(one) is not None]
        if not wanted:
            typer.echo("nothing to check: no weights are on this machine")
        for name in wanted:
            one = lookup_weights(name)
            folder = _place(one) or find_weights(name, home)
            locked = locks.get(one.name) if folder.parent == home else None
            wrong = find_problems(folder, one, locked) or (find_unpublished(folder, one) if locked is None else {})
            for file, what in wrong.items():
                typer.echo(f"{name}: {file} {what}")
            if wrong:
                broken.append(name)
            elif locked is None:
                known = sum((folder / file).is_file() for file in one.published)
                typer.echo(
                    f"{name}: complete, but not pulled by this command: "
                    + (f"{known} file{'s' * (known != 1)} as published" if known else NOT_COMPARED)
                )
            else:
                count = f"{len(locked.files)} file{'s' * (len(locked.files) != 1)}"
                typer.echo(f"{name}: intact, {count}, {_size(locked)} GB")
        if broken:
            raise BackendUnavailable(f"damaged or incomplete; download again: `dg4d weights pull {' '.join(broken)}`")


def _expand(names: Sequence[str]) -> list[str]:
    """Replace profiles by the weights that they name; every weights once.

    Raises:
        BadInput: a folder, or a profile without weights.
    """
    from dg4d_lib.errors import BadInput
    from dg4d_lib.weights.locate import given_folder
    from steps.profiles import PROFILES
    from steps.runtime.weights import weights_in

    found: list[str] = []
    for name in names:
        if name in PROFILES:
            if not (of_profile := list(weights_in(PROFILES[name].model_dump(mode="json")))):
                raise BadInput(f"profile {name} needs no weights; it runs as it is")
            found += of_profile
        elif given_folder(name) is not None:
            raise BadInput(f"{name} is a folder on this machine; give a name, or the id of a Hugging Face repository")
        else:
            found.append(name)
    return list(dict.fromkeys(found))


def _gb(size_bytes: int) -> str:
    return f"{size_bytes / 1e9:.2f}"


def _all_of_them() -> list["Weights"]:
    from dg4d_lib.weights.lock import read_lock
    from dg4d_lib.weights.registry import KNOWN, lookup_weights
    from steps.runtime.weights import weights_home

    pulled = {name: one for name, one in read_lock(weights_home()).items() if name not in KNOWN}
    return [*KNOWN.values(), *(lookup_weights(name, one.license, one.digests) for name, one in pulled.items())]


def _place(one: "Weights") -> Path | None:
    """Return the folder of weights, complete or not; None if they are not on this machine."""
    from dg4d_lib.weights.locate import folder_name, hub_cache_snapshot
    from steps.runtime.weights import weights_home

    folder = weights_home() / folder_name(one)
    return folder if folder.exists() else hub_cache_snapshot(one)


def _columns(texts: Sequence[str], width: int) -> str:
    """Return a line of the list; names are padded to `width` characters."""
    name, here, size, revision, commercial = texts
    return f"{name:<{width}}  {here:<7}  {size:<5}  {revision:<10}  {commercial}".rstrip()


def _row(one: "Weights", locked: "LockEntry | None") -> list[str]:
    from dg4d_lib.weights.locate import DIGEST_CACHE, find_problems
    from steps.runtime.weights import weights_home

    place = _place(one)
    here = "no"
    if place is not None:
        own = place.parent == weights_home()
        whole = not find_problems(place, one, locked if own else None, weights_home() / DIGEST_CACHE)
        here = ("yes" if own else "hub cache") if whole else "damaged"
    size = _size(locked) if locked else f"~{one.about_gb:g}" if one.about_gb else "?"
    revision = locked.revision if locked else one.revision or "-"
    return [one.name, here, size, revision[:10], one.license.commercial, str(one.license)]


def _files_of(one: "Weights", locked: "LockEntry | None") -> list[tuple[str, str, str]]:
    """Return path, sha256 and bytes of the pulled files, else of the published ones."""
    if locked:
        return [(path, file.sha256, str(file.size)) for path, file in locked.files.items()]
    return [(path, sha256, "-") for path, sha256 in one.published.items()]


def _size(locked: "LockEntry") -> str:
    return _gb(sum(file.size for file in locked.files.values()))
