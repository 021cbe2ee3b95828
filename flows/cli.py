"""The `dg4d` command: the only place that sees a user's paths.

Exit status: 0 done · 1 an item of a batch failed, or something broke · 2 wrong usage · 65 bad input, or no room ·
69 something needed is missing · 130 interrupted, 129 by SIGHUP, 143 by SIGTERM.
Only what a command needs is imported, when it needs it.
"""

import io
import math
import os
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.commands.checking import bench, rebuild, score, verify
from flows.commands.endings import clear_ending
from flows.commands.options import Changes, Commercial, Profile, Rate, Seed, Texture, Triangles, finite, knobs_of
from flows.commands.services import down, env, up, watch
from flows.commands.store import store
from flows.commands.weights import weights

if TYPE_CHECKING:
    from rich.console import Console

    from flows.inputs.orders import Order

app = typer.Typer(
    name="dg4d",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

app.add_typer(weights)
app.add_typer(store)


def _say_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dg4d {version('dg4d')}")
        raise typer.Exit


@app.callback()
def dg4d(
    version: Annotated[
        bool, typer.Option("--version", help="say which version this is", callback=_say_version, is_eager=True)
    ] = False,
) -> None:
    """Pictures and videos become animated, textured 3D assets."""


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
    force: Annotated[bool, typer.Option("--force", help="replace the package of another asset in the folder")] = False,
    pick: Annotated[
        int | None, typer.Option(min=1, max=16, help="take this motion of those that `dg4d motions` shows")
    ] = None,
) -> None:
    """Make one animated asset."""
    if picture is None and not text:
        raise typer.BadParameter("give a picture, a video, or --text WORDS")
    with clear_ending():
        from dg4d_lib.errors import BadInput
        from flows import home
        from flows.commands import terminal
        from flows.inputs.manifest import parse_changes
        from flows.inputs.naming import clean
        from flows.inputs.orders import Wish, name_of
        from flows.inputs.package_record import record_of
        from flows.packages.acceptance import failing_in
        from flows.packages.publish import check_folder, is_current
        from steps.profiles import profile as named
        from steps.profiles import revise

        console = terminal.console()
        if pick and video:
            raise BadInput("--pick takes one of the motions that are made up; with --video the video is followed")
        short = knobs_of(triangles, texture, fps) | ({"driving.pick": pick} if pick else {})
        settings = revise(named(profile), parse_changes(changes or []) | short)
        item = (clean(picture.stem) or "asset") if picture else name_of(text)
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
        check_folder(folder, item, force)
        order = wish.order(home.store())
        if is_current(folder, order.digest()):
            console.print("nothing to do: every step was already done")
            files = (record_of(folder) or {"files": {}})["files"]
        else:
            files = _made(order, folder, console)
        terminal.tell_where(console, folder, {name: fact["size_bytes"] for name, fact in files.items()})
        if (folder / "report.html").is_file():
            console.print(f"report: {folder / 'report.html'}", markup=False)
        if failing := failing_in(folder):
            console.print(
                f"not accepted: {', '.join(failing)}; the report says what to do", markup=False, style="yellow"
            )


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
        from flows import home
        from flows.commands import terminal
        from flows.convert import make_motions
        from flows.inputs.manifest import parse_changes
        from flows.inputs.naming import clean
        from flows.inputs.orders import Wish
        from flows.packages.publish import check_writable
        from steps.profiles import profile as named
        from steps.profiles import revise

        console = terminal.console()
        several = {"driving.candidates": candidates, "driving.pick": 0}
        settings = revise(named(profile), parse_changes(changes or []) | several)
        item = clean(picture.stem) or "asset"
        wish = Wish(
            item=item,
            picture=picture,
            profile=profile,
            settings=settings,
            seed=seed,
            commercial_only=commercial_only,
        )
        wish.check()
        folder = out or Path("out") / f"{item}-motions"
        check_writable(folder)
        order = wish.order(home.store())
        ranking = terminal.with_steps(order, console, lambda: make_motions(order, folder))
        for row in ranking["candidates"]:
            remarks = "; ".join(row["remarks"])
            console.print(f"{row['number']:>3}  {row['total']:.2f}  {row['name']}  {remarks}".rstrip(), markup=False)
        console.print(f"sheet: {folder / 'motions.png'}", markup=False)


@app.command()
def batch(
    inputs: Annotated[
        str,
        typer.Argument(
            help="a folder of pictures and videos, a pattern ('photos/**/*.png', in quotes), s3://BUCKET/PREFIX, or a "
            "manifest (.csv, .json, .jsonl, .parquet)"
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="DIR/<item>/ is a package each")],
    profile: Profile = "preview",
    changes: Changes = None,
    triangles: Triangles = None,
    texture: Texture = None,
    fps: Rate = None,
    seed: Seed = 0,
    workers: Annotated[
        int | None, typer.Option(min=1, max=64, help="items at a time  [default: 1; 16 of a deployment]")
    ] = None,
    where: Annotated[
        str,
        typer.Option(
            help="where items run: local, dask://HOST:PORT, or deployment:POOL, on all machines whose workers serve "
            "that pool and share the store  [default: $DG4D_RUNNER, or local]",
            show_default=False,
        ),
    ] = "",
    commercial_only: Commercial = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="an asset that a gate does not let pass is a failure, and ends the batch")
    ] = False,
    root: Annotated[
        Path | None, typer.Option(help="where a manifest's files are, and must stay  [default: beside it]")
    ] = None,
    gpus: Annotated[
        int | None, typer.Option(min=0, help="use the first so many, a step on each  [default: all]")
    ] = None,
    cpus: Annotated[
        int | None,
        typer.Option(min=1, help="steps that compute on the processor at a time  [default: one per 4 cores]"),
    ] = None,
    price_per_hour: Annotated[
        float | None,
        typer.Option(
            min=0,
            callback=finite,
            envvar="DG4D_PRICE_PER_HOUR",
            help="of this machine; the summary has costs",
        ),
    ] = None,
) -> None:
    """Make many assets; those that are made already are left alone, and a bad one stops no other.

    A manifest has a row per item: path or text, and if you like video, name, profile, seed, bank, priority (higher
    first), set ("a.b=c; d.e=f"), or any knob as a column of its own.
    """
    with clear_ending():
        os.environ.update({name: str(n) for name, n in {"DG4D_GPUS": gpus, "DG4D_CPUS": cpus}.items() if n is not None})
        from flows.catalog_request import CatalogRequest, default_workers
        from flows.commands import terminal
        from flows.commands.batch import batch as make_all
        from flows.commands.batch import tell
        from flows.inputs.manifest import parse_changes

        console = terminal.console()
        request = CatalogRequest(
            inputs=inputs,
            out=out,
            profile=profile,
            changes=parse_changes(changes or []) | knobs_of(triangles, texture, fps),
            seed=seed,
            workers=workers or default_workers(where),
            where=where,
            commercial_only=commercial_only,
            strict=strict,
            root=root,
            price_per_hour=price_per_hour,
        )
        if status := tell(make_all(request, console), out, console):
            raise typer.Exit(status)


@app.command()
def render(
    package: Annotated[Path, typer.Argument(help="the folder of a package")],
    out: Annotated[Path, typer.Option("-o", "--out", help="OUT/view_<azimuth>/NNN.png")],
    azimuths: Annotated[str, typer.Option(help="degrees, separated by commas, for example --azimuths=0,-75,15")] = "0",
    elevation: Annotated[float, typer.Option(min=-90, max=90, callback=finite, help="degrees")] = 0.0,
    size: Annotated[int, typer.Option(min=16, max=4096, help="pixels")] = 256,
    frames: Annotated[int | None, typer.Option(min=1, help="moments  [default: every frame]")] = None,
    mesh: Annotated[bool, typer.Option("--mesh", help="the textured mesh instead of the splats")] = False,
) -> None:
    """Render an asset from any side as RGBA pictures."""
    with clear_ending():
        try:
            angles = [float(angle) for angle in azimuths.split(",")]
            if not all(map(math.isfinite, angles)):
                raise ValueError
        except ValueError:
            raise typer.BadParameter(f"{azimuths!r} is not a list of degrees such as 0,-75,15") from None
        from flows.packages.publish import check_writable

        check_writable(out)
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        from steps.artifacts.rendering import render_package

        for folder in render_package(package, angles, elevation, size, frames, mesh, out):
            typer.echo(folder)


@app.command()
def view(
    package: Annotated[Path, typer.Argument(help="the folder of a package")],
    show: Annotated[bool, typer.Option("--open/--no-open", help="open the page in a browser")] = True,
) -> None:
    """Check a package and show the page that plays it; prints where the page is."""
    with clear_ending():
        from flows.packages.view import view as check_and_show

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
    spacing: Annotated[
        float, typer.Option(min=0, max=1000, callback=finite, help="world units between neighbors in a row")
    ] = 0.25,
    preview: Annotated[bool, typer.Option("--preview", help="also a film, beside the scene")] = False,
) -> None:
    """Put several assets into one animated scene: side by side, or as a scene file says."""
    with clear_ending():
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        from flows.commands.compose import compose as compose_scene
        from flows.formatting.escaping import visible

        for note in compose_scene(packages or [], out, scene, spacing, preview):
            typer.echo(visible(note), err=True)
        typer.echo(out)


for command in (score, bench, verify, rebuild, up, down, env, watch):
    app.command()(command)


def main() -> None:
    """Run the command, with output that can hold file names in any encoding."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    app()


def _made(order: "Order", folder: Path, console: "Console") -> dict[str, dict[str, int]]:
    """Run the flow of an order with its steps on the terminal; the files of the package."""
    from flows.commands import terminal
    from flows.convert import make

    files, cached = terminal.with_steps(order, console, lambda: make(order, folder))
    if cached:
        console.print("nothing to do: every step was already done")
    return files


if __name__ == "__main__":
    main()
