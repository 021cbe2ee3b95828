"""The `dg4d` command: the only place that sees a user's paths.

Exit status: 0 done · 1 an item of a batch failed, or something broke · 2 wrong usage · 65 bad input, or no room ·
69 something needed is missing · 130 interrupted. Only what a command needs is imported, when it needs it.
"""

import os
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from flows.endings import EXIT_FAILED, clear_ending
from flows.weights import weights

if TYPE_CHECKING:
    from rich.console import Console

    from flows.manifest import Item
    from flows.orders import Order
    from flows.summary import Row
    from steps.store import ArtifactStore

Result = TypeVar("Result")

app = typer.Typer(
    name="dg4d",
    help="Pictures and videos become animated, textured 3D assets.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

app.add_typer(weights)

Profile = Annotated[str, typer.Option(help="named settings to start from")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="KNOB=VALUE", help="change a knob; may be repeated")]
Commercial = Annotated[
    bool, typer.Option("--commercial-only", help="refuse weights whose license forbids commercial use")
]
Seed = Annotated[int, typer.Option(min=0, help="of everything random; equal seeds give equal bytes")]


@app.command()
def make(
    picture: Annotated[Path | None, typer.Argument(help="a picture, or a video", show_default=False)] = None,
    text: Annotated[
        str, typer.Option(help="words instead of a picture; --set text.weights names the model that draws them")
    ] = "",
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
    commercial_only: Commercial = False,
    pick: Annotated[
        int | None, typer.Option(min=1, max=16, help="take this motion of those that `dg4d motions` shows")
    ] = None,
) -> None:
    """Make one animated asset."""
    if picture is None and not text:
        raise typer.BadParameter("give a picture, a video, or --text WORDS")
    with clear_ending():
        from dg4d_lib.errors import BadInput
        from flows import home, terminal
        from flows.manifest import parse_changes
        from flows.orders import Wish, name_of
        from flows.publish import check_folder, is_current, record_of
        from steps.profiles import profile as named
        from steps.profiles import revise

        console = terminal.console()
        if pick and video:
            raise BadInput("--pick takes one of the motions that are made up; with --video the video is followed")
        settings = revise(named(profile), parse_changes(changes or []) | ({"driving.pick": pick} if pick else {}))
        item = picture.stem if picture else name_of(text)
        wish = Wish(
            item=item,
            picture=picture,
            text=text,
            video=video,
            bank=bank,
            profile=profile,
            settings=settings,
            seed=seed,
            commercial_only=commercial_only,
        )
        wish.check()
        folder = out or Path("out") / item
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
def motions(
    picture: Annotated[Path, typer.Argument(help="a picture")],
    profile: Profile = "preview",
    changes: Set = None,
    seed: Seed = 0,
    commercial_only: Commercial = False,
    candidates: Annotated[int, typer.Option(min=2, max=16, help="how many motions")] = 6,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="folder of sheet and films  [default: out/<name>-motions]")
    ] = None,
) -> None:
    """Show the motions that a picture could make, the best first; `dg4d make PICTURE --pick K` takes number K."""
    with clear_ending():
        from flows import home, terminal
        from flows.make import make_motions
        from flows.manifest import parse_changes
        from flows.orders import Wish
        from flows.publish import check_writable
        from steps.profiles import profile as named
        from steps.profiles import revise

        console = terminal.console()
        several = {"driving.candidates": candidates, "driving.pick": 0}
        settings = revise(named(profile), parse_changes(changes or []) | several)
        wish = Wish(
            item=picture.stem,
            picture=picture,
            profile=profile,
            settings=settings,
            seed=seed,
            commercial_only=commercial_only,
        )
        wish.check()
        folder = out or Path("out") / f"{picture.stem}-motions"
        check_writable(folder)
        order = wish.order(home.store())
        ranking = _run(order, console, lambda: make_motions(order, folder))
        for row in ranking["candidates"]:
            remarks = "; ".join(row["remarks"])
            console.print(f"{row['number']:>3}  {row['total']:.2f}  {row['name']}  {remarks}".rstrip(), markup=False)
        console.print(f"sheet: {folder / 'motions.png'}", markup=False)


@app.command()
def batch(
    inputs: Annotated[Path, typer.Argument(help="a folder of pictures and videos, or a manifest (.csv, .json)")],
    out: Annotated[Path, typer.Option("-o", "--out", help="DIR/<item>/ is a package each")],
    profile: Profile = "preview",
    changes: Set = None,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(min=1, max=64, help="items at a time")] = 1,
    commercial_only: Commercial = False,
) -> None:
    """Make many assets; those that are made already are left alone, and a bad one stops no other.

    A manifest has a row per item: path, and if you like video, name, profile, seed, bank, set ("a.b=c; d.e=f"), or any
    knob as a column of its own.
    """
    with clear_ending():
        from flows import home, terminal
        from flows.manifest import items_of, only_commercial, parse_changes
        from flows.publish import check_writable
        from flows.summary import write_summary

        console = terminal.console()
        items = items_of(inputs, out, profile, parse_changes(changes or []), seed)
        items = only_commercial(items) if commercial_only else items
        check_writable(out)
        out.mkdir(parents=True, exist_ok=True)
        rows: dict[str, Row] = {}
        with terminal.batch_shown(console, [item.name for item in items]) as table:

            def settle(row: "Row") -> None:
                rows[row.item] = row
                table.settle(row.item, row.status, row.message)
                if not console.is_terminal:
                    console.print(f"{row.item}: {row.status} {row.message}", markup=False)
                write_summary(out, list(rows.values()), commercial_only)

            orders = [order for item in items if (order := _ready(item, out, home.store(), settle)) is not None]
            if orders:
                from flows.make import connect

                connect()
                from flows.catalog import convert_all

                convert_all(orders, out, workers, f"{inputs.name}: {len(items)} items", settle)
        write_summary(out, [rows[item.name] for item in items], commercial_only)
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
    with clear_ending():
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
    with clear_ending():
        from flows import home

        server = home.background_server()
        server.start()
        server.keep()
        typer.echo(server.wait().removesuffix("/api"))


@app.command()
def down() -> None:
    """Stop the server."""
    with clear_ending():
        from flows import home

        typer.echo("the server is stopped" if home.background_server().stop() else "no server was running")


def main() -> None:
    """The entry point of `dg4d`."""
    app()


def _made(order: "Order", folder: Path, console: "Console") -> dict[str, dict[str, int]]:
    """Run the flow of an order with its steps on the terminal; the files of the package."""
    from flows.make import make

    files, cached = _run(order, console, lambda: make(order, folder))
    if cached:
        console.print("nothing to do: every step was already done")
    return files


def _run(order: "Order", console: "Console", work: Callable[[], Result]) -> Result:
    """What `work` gives, which runs a flow of this order, with its steps on the terminal."""
    from flows import terminal
    from flows.executors import StepBadInput
    from flows.make import connect, save_pictures

    with console.status("starting") if console.is_terminal else nullcontext():
        connect()
        from flows import image_to_4d  # noqa: F401 - takes a second
    try:
        with terminal.steps_shown(console):
            return work()
    except StepBadInput as error:  # a step knows files by their content, the user by their names
        raise StepBadInput(error.step, f"{order.source_name}: {error.message}", error.pictures) from error
    except Exception as error:
        for path in save_pictures(order, error):
            typer.echo(f"the last good state: {path}", err=True)
        raise


def _ready(item: "Item", out: Path, store: "ArtifactStore", settle: Callable[["Row"], None]) -> "Order | None":
    """The order of an item; None if it is settled already."""
    from dg4d_lib.errors import DG4DError
    from flows.publish import check_folder, is_current
    from flows.summary import Row

    failed = Row(item=item.name, status="failed", kind="BadInput", message=item.error)
    if item.wish is None:
        settle(failed)
        return None
    source = item.wish.source_name
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


if __name__ == "__main__":
    main()
