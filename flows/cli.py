"""The `dg4d` command: the only place that sees a user's paths.

Exit status: 0 done · 1 an item of a batch failed, or something broke · 2 wrong usage · 65 bad input, or no room ·
69 something needed is missing · 130 interrupted. Only what a command needs is imported, when it needs it.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.checking import bench, rebuild, score, verify
from flows.endings import EXIT_FAILED, clear_ending
from flows.options import Changes, Commercial, Profile, Rate, Seed, Texture, Triangles
from flows.store import store
from flows.weights import weights

if TYPE_CHECKING:
    from rich.console import Console

    from flows.manifest import Item
    from flows.orders import Order
    from flows.summary import Row
    from steps.store import ArtifactStore

app = typer.Typer(
    name="dg4d",
    help="Pictures and videos become animated, textured 3D assets.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

app.add_typer(weights)
app.add_typer(store)


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
    changes: Changes = None,
    triangles: Triangles = None,
    texture: Texture = None,
    fps: Rate = None,
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
        short = _short(triangles, texture, fps) | ({"driving.pick": pick} if pick else {})
        settings = revise(named(profile), parse_changes(changes or []) | short)
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
    changes: Changes = None,
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
        ranking = terminal.with_steps(order, console, lambda: make_motions(order, folder))
        for row in ranking["candidates"]:
            remarks = "; ".join(row["remarks"])
            console.print(f"{row['number']:>3}  {row['total']:.2f}  {row['name']}  {remarks}".rstrip(), markup=False)
        console.print(f"sheet: {folder / 'motions.png'}", markup=False)


@app.command()
def batch(
    inputs: Annotated[Path, typer.Argument(help="a folder of pictures and videos, or a manifest (.csv, .json)")],
    out: Annotated[Path, typer.Option("-o", "--out", help="DIR/<item>/ is a package each")],
    profile: Profile = "preview",
    changes: Changes = None,
    triangles: Triangles = None,
    texture: Texture = None,
    fps: Rate = None,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(min=1, max=64, help="items at a time")] = 1,
    commercial_only: Commercial = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="an asset that a gate does not let pass is a failure, and ends the batch")
    ] = False,
) -> None:
    """Make many assets; those that are made already are left alone, and a bad one stops no other.

    A manifest has a row per item: path or text, and if you like video, name, profile, seed, bank,
    set ("a.b=c; d.e=f"), or any knob as a column of its own.
    """
    with clear_ending():
        from flows import home, terminal
        from flows.manifest import items_of, only_commercial, parse_changes
        from flows.publish import check_writable
        from flows.summary import NOT_ACCEPTED, write_summary

        console = terminal.console()
        wanted = parse_changes(changes or []) | _short(triangles, texture, fps)
        items = items_of(inputs, out, profile, wanted, seed)
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

            ready = (_ready(item, out, home.store(), settle, strict) for item in items)
            orders = [order for order in ready if order is not None]
            if orders:
                from flows.make import connect

                connect()
                from flows.catalog import convert_all

                refused = [row.item for row in rows.values() if row.kind == NOT_ACCEPTED]
                convert_all(orders, out, workers, f"{inputs.name}: {len(items)} items", settle, strict, refused)
        write_summary(out, [rows[item.name] for item in items], commercial_only)
        failed = [row for row in rows.values() if row.status == "failed"]
        for row in failed:
            console.print(f"failed: {row.item}: {row.message}", markup=False, style="red")
        doubtful = [row for row in rows.values() if row.failing and row.status != "failed"]
        for row in doubtful:
            console.print(f"not accepted: {row.item}: {', '.join(row.failing or ())}", markup=False, style="yellow")
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
def view(
    package: Annotated[Path, typer.Argument(help="the folder of a package")],
    show: Annotated[bool, typer.Option("--open/--no-open", help="open the page in a browser")] = True,
) -> None:
    """Check a package and show the page that plays it; prints where the page is."""
    with clear_ending():
        from flows.view import view as check_and_show

        typer.echo(check_and_show(package, show))


@app.command()
def compose(
    out: Annotated[Path, typer.Option("-o", "--out", help="the scene, a file ending in .glb or .usdz")],
    packages: Annotated[
        list[Path] | None, typer.Argument(help="folders of packages, from left to right", show_default=False)
    ] = None,
    scene: Annotated[
        Path | None, typer.Option(help="a scene file (JSON): which packages stand where, and when")
    ] = None,
    spacing: Annotated[float, typer.Option(min=0, max=1000, help="world units between neighbors in a row")] = 0.25,
    preview: Annotated[bool, typer.Option("--preview", help="also a film, beside the scene")] = False,
) -> None:
    """Put several assets into one animated scene: side by side, or as a scene file says."""
    with clear_ending():
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        from flows.compose import compose as compose_scene

        for note in compose_scene(packages or [], out, scene, spacing, preview):
            typer.echo(note, err=True)
        typer.echo(out)


for command in (score, bench, verify, rebuild):
    app.command()(command)


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


def _short(triangles: int | None, texture: int | None, fps: float | None) -> dict[str, Any]:
    """The knobs behind options that are short for them."""
    given = {"mesh.max_faces": triangles, "mesh.texture_size": texture, "pack.fps": fps}
    return {knob: value for knob, value in given.items() if value is not None}


def _made(order: "Order", folder: Path, console: "Console") -> dict[str, dict[str, int]]:
    """Run the flow of an order with its steps on the terminal; the files of the package."""
    from flows import terminal
    from flows.make import make

    files, cached = terminal.with_steps(order, console, lambda: make(order, folder))
    if cached:
        console.print("nothing to do: every step was already done")
    return files


def _ready(
    item: "Item", out: Path, store: "ArtifactStore", settle: Callable[["Row"], None], strict: bool
) -> "Order | None":
    """The order of an item; None if it is settled already."""
    from dg4d_lib.errors import DG4DError
    from flows.publish import check_folder, is_current
    from flows.summary import Row, judged

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
        settle(judged(Row(item=item.name, source=source, status="unchanged"), out / item.name, strict))
        return None
    return order


if __name__ == "__main__":
    main()
