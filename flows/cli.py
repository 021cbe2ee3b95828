"""The `dg4d` command: the only place that sees a user's paths.

Exit status: 0 done · 1 an item of a batch failed, or something broke · 2 wrong usage · 65 bad input, or no room ·
69 something needed is missing · 130 interrupted. Only what a command needs is imported, when it needs it.
"""

import errno
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from flows.manifest import Item
    from flows.orders import Order
    from flows.summary import Row
    from steps.store import ArtifactStore

EXIT_FAILED = 1
EXIT_BAD_INPUT = 65
EXIT_MISSING = 69
EXIT_INTERRUPTED = 130

app = typer.Typer(
    name="dg4d",
    help="Pictures and videos become animated, textured 3D assets.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Profile = Annotated[str, typer.Option(help="named settings to start from")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="KNOB=VALUE", help="change a knob; may be repeated")]
Seed = Annotated[int, typer.Option(min=0, help="of everything random; equal seeds give equal bytes")]


@app.command()
def make(
    picture: Annotated[Path, typer.Argument(help="a picture, or a video")],
    video: Annotated[
        Path | None, typer.Option(help="a video or a folder of frames to follow; PICTURE then only names the asset")
    ] = None,
    profile: Profile = "preview",
    changes: Set = None,
    seed: Seed = 0,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="folder of the package  [default: out/<name>]")
    ] = None,
    bank: Annotated[Path | None, typer.Option(help="folder of true views, for --set prior.kind=oracle")] = None,
) -> None:
    """Make one animated asset."""
    with _clear_ending():
        from flows import home, terminal
        from flows.manifest import parse_changes
        from flows.orders import Wish
        from flows.publish import check_folder, is_current, record_of
        from steps.profiles import profile as named
        from steps.profiles import revise

        console = terminal.console()
        settings = revise(named(profile), parse_changes(changes or []))
        wish = Wish(
            item=picture.stem,
            picture=picture,
            video=video,
            bank=bank,
            profile=profile,
            settings=settings,
            seed=seed,
        )
        wish.check()
        folder = out or Path("out") / picture.stem
        check_folder(folder)
        order = wish.order(home.store())
        if is_current(folder, order.digest()):
            console.print("nothing to do: every step was already done")
            files = (record_of(folder) or {"files": {}})["files"]
        else:
            files = _made(order, folder, console)
        terminal.tell_where(console, folder, {name: fact["size_bytes"] for name, fact in files.items()})
        if (folder / "report.html").is_file():
            console.print(f"report: {folder / 'report.html'}", markup=False)


@app.command()
def batch(
    inputs: Annotated[Path, typer.Argument(help="a folder of pictures and videos, or a manifest (.csv, .json)")],
    out: Annotated[Path, typer.Option("-o", "--out", help="DIR/<item>/ is a package each")],
    profile: Profile = "preview",
    changes: Set = None,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(min=1, max=64, help="items at a time")] = 1,
) -> None:
    """Make many assets; those that are made already are left alone, and a bad one stops no other.

    A manifest has a row per item: path, and if you like video, name, profile, seed, bank, set ("a.b=c; d.e=f"), or any
    knob as a column of its own.
    """
    with _clear_ending():
        from flows import home, terminal
        from flows.manifest import items_of, parse_changes
        from flows.publish import check_writable
        from flows.summary import write_summary

        console = terminal.console()
        items = items_of(inputs, out, profile, parse_changes(changes or []), seed)
        check_writable(out)
        out.mkdir(parents=True, exist_ok=True)
        rows: dict[str, Row] = {}
        with terminal.batch_shown(console, [item.name for item in items]) as table:

            def settle(row: "Row") -> None:
                rows[row.item] = row
                table.settle(row.item, row.status, row.message)
                if not console.is_terminal:
                    console.print(f"{row.item}: {row.status} {row.message}", markup=False)
                write_summary(out, list(rows.values()))

            orders = [order for item in items if (order := _ready(item, out, home.store(), settle)) is not None]
            if orders:
                from flows.make import connect

                connect()
                from flows.catalog import convert_all

                convert_all(orders, out, workers, f"{inputs.name}: {len(items)} items", settle)
        write_summary(out, [rows[item.name] for item in items])
        failed = [row for row in rows.values() if row.status == "failed"]
        for row in failed:
            console.print(f"failed: {row.item}: {row.message}", markup=False, style="red")
        if not orders and not failed:
            console.print("nothing to do: every item was already done")
        console.print(f"{len(rows) - len(failed)} of {len(rows)} items are in {out}", markup=False)
        console.print(f"overview: {out / 'index.html'}", markup=False)
        if failed:
            raise typer.Exit(EXIT_FAILED)


@app.command()
def render(
    package: Annotated[Path, typer.Argument(help="the folder of a package")],
    out: Annotated[Path, typer.Option("-o", "--out", help="OUT/view_<azimuth>/NNN.png")],
    azimuths: Annotated[str, typer.Option(help="degrees, separated by commas, for example --azimuths=0,-75,15")] = "0",
    elevation: Annotated[float, typer.Option(min=-90, max=90, help="degrees")] = 0.0,
    size: Annotated[int, typer.Option(min=16, max=4096, help="pixels")] = 256,
    frames: Annotated[int | None, typer.Option(min=1, help="moments  [default: every frame]")] = None,
    mesh: Annotated[bool, typer.Option("--mesh", help="the textured mesh instead of the splats")] = False,
) -> None:
    """Render an asset from any side as RGBA pictures."""
    with _clear_ending():
        try:
            angles = [float(angle) for angle in azimuths.split(",")]
        except ValueError:
            raise typer.BadParameter(f"{azimuths!r} is not a list of degrees such as 0,-75,15") from None
        from flows.publish import check_writable

        check_writable(out)
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        from steps.render_asset import render_package

        for folder in render_package(package, angles, elevation, size, frames, mesh, out):
            typer.echo(folder)


@app.command()
def up() -> None:
    """Start the server that shows every run, and keep it until `dg4d down`; prints its address."""
    with _clear_ending():
        from flows import home

        server = home.background_server()
        server.start()
        server.keep()
        typer.echo(server.wait().removesuffix("/api"))


@app.command()
def down() -> None:
    """Stop the server."""
    with _clear_ending():
        from flows import home

        typer.echo("the server is stopped" if home.background_server().stop() else "no server was running")


def main() -> None:
    """The entry point of `dg4d`."""
    app()


def _made(order: "Order", folder: Path, console: "Console") -> dict[str, dict[str, int]]:
    """Run the flow of an order with its steps on the terminal; the files of the package."""
    from flows import terminal
    from flows.executors import StepBadInput
    from flows.make import connect, make, save_pictures

    with console.status("starting") if console.is_terminal else nullcontext():
        connect()
        from flows import image_to_4d  # noqa: F401 - takes a second
    try:
        with terminal.steps_shown(console):
            files, cached = make(order, folder)
    except StepBadInput as error:  # a step knows files by their content, the user by their names
        raise StepBadInput(error.step, f"{order.source_name}: {error.message}", error.pictures) from error
    except Exception as error:
        for path in save_pictures(order, error):
            typer.echo(f"the last good state: {path}", err=True)
        raise
    if cached:
        console.print("nothing to do: every step was already done")
    return files


def _ready(item: "Item", out: Path, store: "ArtifactStore", settle: Callable[["Row"], None]) -> "Order | None":
    """The order of an item; None if it is settled already."""
    from dg4d_lib.errors import DG4DError
    from flows.publish import check_folder, is_current
    from flows.summary import Row

    failed = Row(item=item.name, status="failed", kind="BadInput", message=item.error)
    if item.wish is None:
        settle(failed)
        return None
    source = (item.wish.video or item.wish.picture).name
    try:
        item.wish.check()
        check_folder(out / item.name)
        order = item.wish.order(store)
    except DG4DError as error:
        settle(failed.model_copy(update={"message": str(error), "source": source}))
        return None
    if is_current(out / item.name, order.digest()):
        settle(Row(item=item.name, source=source, status="unchanged"))
        return None
    return order


@contextmanager
def _clear_ending() -> Iterator[None]:
    """Turn every error into one message and an exit status."""
    try:
        yield
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except KeyboardInterrupt:
        _stop_steps()
        _end("stopped; the same command goes on after the last finished step", EXIT_INTERRUPTED)
    except Exception as error:
        _end(*_verdict(error))


def _verdict(error: Exception) -> tuple[str, int]:
    from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
    from flows.executors import StepBadInput, StepDiverged, StepError, StepMissing
    from flows.server import ServerUnavailable
    from steps.store import NO_SPACE, ArtifactMissing

    text = error.message if isinstance(error, StepError) else str(error)
    match error:
        case BadInput() | FitDiverged() | StepBadInput():
            return text, EXIT_BAD_INPUT
        case StepDiverged():
            return str(error), EXIT_BAD_INPUT
        case BackendUnavailable() | StepMissing() | ServerUnavailable() | ArtifactMissing():
            return text, EXIT_MISSING
        case StepError():
            return str(error), EXIT_FAILED
        case OSError() if error.errno in NO_SPACE or error.errno == errno.EROFS:
            return f"{error.strerror}: {error.filename or 'the disk'}; free some space and try again", EXIT_BAD_INPUT
    return f"something broke ({type(error).__name__}: {error}); details: {_saved_traceback(error)}", EXIT_FAILED


def _saved_traceback(error: Exception) -> str:
    from steps.store import home

    path = home() / "last-error.txt"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(traceback.format_exception(error)), encoding="utf-8")
    except OSError:
        return "could not be written"
    return str(path)


def _stop_steps() -> None:
    if "flows.executors" in sys.modules:
        from flows.executors import stop_all

        stop_all()


def _end(message: str, status: int) -> NoReturn:
    typer.echo(f"dg4d: {message}", err=True)
    raise typer.Exit(status)


if __name__ == "__main__":
    main()
