"""`dg4d` command line, the only module that receives paths from users.

Exit codes: 0 done; 1 an item of a batch failed, or an internal error; 2 wrong usage; 65 bad input, or a full disk;
69 a library or server is missing; 130 interrupted, 129 by SIGHUP, 143 by SIGTERM.
Commands import their modules when they run, so that `--help` and completion are fast.
"""

import io
import logging
import math
import os
import shlex
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.commands.checking import bench, rebuild, score, verify
from flows.commands.doctor import doctor
from flows.commands.endings import exit_on_error
from flows.commands.options import (
    Box,
    Cameras,
    Changes,
    Commercial,
    Compress,
    Depth,
    Ground,
    Height,
    Layers,
    Mask,
    Profile,
    Rate,
    Seed,
    Texture,
    Triangles,
    Turntable,
    Views,
    finite,
    shortcut_settings,
)
from flows.commands.services import down, env, studio, up, watch
from flows.commands.settings import settings as list_settings
from flows.commands.store import store
from flows.commands.weights import weights

if TYPE_CHECKING:
    from flows.inputs.conversion_job import ConversionRequest

app = typer.Typer(
    name="dg4d",
    no_args_is_help=True,
    rich_markup_mode=None,  # plain text: tables of rich break identifiers and show a type for every flag
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
        bool, typer.Option("--version", help="print the version", callback=_say_version, is_eager=True)
    ] = False,
) -> None:
    """Convert pictures and videos to animated, textured 3D assets."""
    with exit_on_error():
        from steps.store.files import make_folders_absolute

        make_folders_absolute()


@app.command()
def make(
    pictures: Annotated[
        list[Path] | None,
        typer.Argument(metavar="PICTURE", help="a picture or a video; several make an asset each", show_default=False),
    ] = None,
    text: Annotated[
        str,
        typer.Option(
            metavar="PROMPT",
            help="a prompt instead of a picture; text-to-image model: --set text.weights=FOLDER_OR_HUB_ID",
        ),
    ] = "",
    video: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="driving video or folder of frames; its first frame is the subject, and PICTURE (optional) only names "
            "the asset",
        ),
    ] = None,
    view: Views = None,
    turntable: Turntable = None,
    cameras: Cameras = None,
    profile: Profile = "preview",
    changes: Changes = None,
    triangles: Triangles = None,
    texture: Texture = None,
    fps: Rate = None,
    height_m: Height = None,
    ground: Ground = None,
    compress: Compress = False,
    seed: Seed = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--out",
            metavar="DIR",
            help="output folder; with several pictures DIR/NAME; duplicate names are made unique with suffix and "
            "number (DIR/newt-png-2)  [default: out/NAME]",
        ),
    ] = None,
    bank: Annotated[
        Path | None, typer.Option(metavar="DIR", help="ground-truth views, for --set prior.kind=oracle")
    ] = None,
    mask: Mask = None,
    box: Box = "",
    depth: Depth = None,
    layers: Layers = None,
    asset: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="a model of your own that is set in motion: .glb, .gltf, .obj, .usdz, .ply, or splats as .ply, .spz",
        ),
    ] = None,
    asset_azimuth: Annotated[
        float | None,
        typer.Option(
            min=-360, max=360, callback=finite, metavar="DEG", help="azimuth of the model that the first frame shows"
        ),
    ] = None,
    commercial_only: Commercial = False,
    force: Annotated[
        bool, typer.Option("--force", help="replace an asset with a different name in the output folder")
    ] = False,
    pick: Annotated[int | None, typer.Option(min=1, max=16, metavar="K", help="use motion K of `dg4d motions`")] = None,
) -> None:
    """Make an animated asset of each picture.

    Motions without a driving video, for --set driving.motion=NAME: sway, bend, breathe, bounce, wave, turn.
    """
    if not (pictures or text or video or asset):
        raise typer.BadParameter("give a picture, a video, --text PROMPT, or --asset FILE")
    if asset_azimuth is not None and asset is None:
        raise typer.BadParameter("--asset-azimuth needs --asset")
    with exit_on_error():
        from flows.commands import terminal
        from flows.commands.make import MakeArguments, make_each
        from flows.inputs.given_views import ViewsRequest, parse_views

        short = shortcut_settings(
            triangles, texture, fps, box=box, height_m=height_m, ground=ground, compress=compress
        ) | ({"driving.pick": pick} if pick else {})
        if asset_azimuth is not None:
            short |= {"asset.find_azimuth": False, "asset.azimuth_deg": asset_azimuth}
        sides = ViewsRequest(views=parse_views(view or []), turntable=turntable, cameras=cameras)

        def request(item: str, picture: Path | None) -> "ConversionRequest":
            files: dict[str, Any] = {
                "picture": picture,
                "text": text,
                "video": video,
                "bank": bank,
                "mask": mask,
                "depth": depth,
                "layers": layers,
                "asset": asset,
            }
            files["given_views"] = sides
            return _request(profile, changes, short, item=item, seed=seed, commercial_only=commercial_only, **files)

        for_one = {
            "--text": text,
            "--video": video,
            "--mask": mask,
            "--depth": depth,
            "--layers": layers,
            "--asset": asset,
            "--view": bool(sides),
        }
        alone = next((option for option, value in for_one.items() if value), "")
        arguments = MakeArguments(tuple(pictures or ()), text, video, asset, alone, out, force, bool(pick), request)
        if status := make_each(arguments, terminal.console()):
            raise typer.Exit(status)


@app.command()
def motions(
    picture: Annotated[Path, typer.Argument(metavar="PICTURE", help="a picture")],
    profile: Profile = "preview",
    changes: Changes = None,
    seed: Seed = 0,
    mask: Mask = None,
    box: Box = "",
    depth: Depth = None,
    layers: Layers = None,
    commercial_only: Commercial = False,
    candidates: Annotated[int, typer.Option(min=2, max=16, metavar="N", help="number of motions")] = 6,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="output folder  [default: out/NAME-motions]")
    ] = None,
) -> None:
    """Generate and rank several motions of a picture.

    `dg4d make PICTURE --pick K` uses motion K.
    """
    with exit_on_error():
        from dg4d_lib.errors import BadInput
        from flows.commands import terminal
        from flows.convert import rank_motions, stored
        from flows.inputs.naming import name_from_path
        from flows.packages.publish import check_writable

        console = terminal.console()
        several = shortcut_settings(None, None, None, box=box) | {"driving.candidates": candidates, "driving.pick": 0}
        item = name_from_path(picture)
        files = {"item": item, "picture": picture, "mask": mask, "depth": depth, "layers": layers}
        request = _request(profile, changes, several, seed=seed, commercial_only=commercial_only, **files)
        if request.has_motion:
            raise BadInput(f"motions are generated for a picture, and {picture.name} is a video; give a picture of it")
        folder = out or Path("out") / f"{item}-motions"
        check_writable(folder)
        steps = ("prepare_subject", "drive_video")
        with stored(request) as job:
            ranking = terminal.run_with_progress(job, console, lambda: rank_motions(job, folder), steps)
        rows = [
            (f"{row['number']:>4}", f"{row['total']:.2f}", f"{row['name']}  {'; '.join(row['remarks'])}".rstrip())
            for row in ranking["candidates"]
        ]
        terminal.print_rows(console, [("pick", "score", "motion, best first"), *rows])
        console.print(f"sheet: {folder / 'motions.png'}", markup=False)
        options: dict[str, object] = {
            "--profile": profile if profile != "preview" else "",
            "--seed": seed or "",
            "--mask": mask,
            "--box": box,
            "--depth": depth,
            "--layers": layers,
            "--pick": ranking["candidates"][0]["number"],
        }
        given = [*(("--set", change) for change in changes or ()), *options.items()]
        words = [word for option, value in given if value for word in (option, str(value))]
        flags = ["--commercial-only"] if commercial_only else []
        end = ["--"] if str(picture).startswith("-") else []
        best = shlex.join(["dg4d", "make", *words, *flags, *end, str(picture)])
        console.print(f"make the asset with one of them: {best}", markup=False, soft_wrap=True)


@app.command()
def batch(
    inputs: Annotated[
        str,
        typer.Argument(
            metavar="INPUTS",
            help="a folder, a quoted pattern such as 'photos/**/*.png', s3://BUCKET/PREFIX, or a manifest (.csv, "
            ".json, .jsonl, .parquet)",
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="output folder; each item gets DIR/ITEM")],
    profile: Profile = "preview",
    changes: Changes = None,
    triangles: Triangles = None,
    texture: Texture = None,
    fps: Rate = None,
    height_m: Height = None,
    ground: Ground = None,
    compress: Compress = False,
    seed: Seed = 0,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, max=64, metavar="N", help="items converted at a time  [default: 1; 16 with --where deployment:POOL]"
        ),
    ] = None,
    where: Annotated[
        str,
        typer.Option(
            metavar="PLACE",
            help="local, dask://HOST:PORT, or deployment:POOL, on all machines whose workers serve that pool and share "
            "the store  [default: $DG4D_RUNNER, or local]",
            show_default=False,
        ),
    ] = "",
    commercial_only: Commercial = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="treat an asset that fails a quality gate as a failed item, and stop")
    ] = False,
    root: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="folder that contains a manifest's files  [default: the manifest's folder]"),
    ] = None,
    gpus: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="number of GPUs to use, one step on each  [default: all]")
    ] = None,
    cpus: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="CPU steps at a time  [default: one per 4 cores]"),
    ] = None,
    price_per_hour: Annotated[
        float | None,
        typer.Option(
            min=0,
            callback=finite,
            envvar="DG4D_PRICE_PER_HOUR",
            metavar="PRICE",
            help="price of this machine; adds costs to the summary",
        ),
    ] = None,
) -> None:
    """Make many assets.

    Finished items are skipped; a failed item does not stop the others. A manifest has one row per item with these
    columns: path, text or asset, and optionally video, name, profile, seed, views ("90=right.png; 180=back.png"),
    turntable, cameras, bank, mask, box ("X,Y,W,H"), depth, layers, priority (higher first), set ("a.b=c; d.e=f"), or
    any setting by its name.
    """
    with exit_on_error():
        os.environ.update({name: str(n) for name, n in {"DG4D_GPUS": gpus, "DG4D_CPUS": cpus}.items() if n is not None})
        from flows.catalog_request import CatalogRequest, default_workers
        from flows.commands import terminal
        from flows.commands.batch import batch as make_all
        from flows.commands.batch import print_summary
        from flows.inputs.manifest import parse_changes

        console = terminal.console()
        request = CatalogRequest(
            inputs=inputs,
            out=out,
            profile=profile,
            changes=parse_changes(changes or [])
            | shortcut_settings(triangles, texture, fps, height_m=height_m, ground=ground, compress=compress),
            seed=seed,
            workers=workers or default_workers(where),
            where=where,
            commercial_only=commercial_only,
            strict=strict,
            root=root,
            price_per_hour=price_per_hour,
        )
        if status := print_summary(make_all(request, console), out, console):
            raise typer.Exit(status)


@app.command()
def render(
    package: Annotated[Path, typer.Argument(metavar="PACKAGE", help="folder of an asset")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="writes DIR/view_AZIMUTH/NNN.png")],
    azimuths: Annotated[
        str, typer.Option(metavar="LIST", help="degrees, separated by commas: --azimuths=0,-75,15")
    ] = "0",
    elevation: Annotated[float, typer.Option(min=-90, max=90, metavar="DEG", callback=finite, help="degrees")] = 0.0,
    size: Annotated[int, typer.Option(min=16, max=4096, metavar="N", help="pixels")] = 256,
    frames: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="number of pictures, evenly spaced from the first to the last frame of the fit  "
            "[default: every frame]",
        ),
    ] = None,
    mesh: Annotated[bool, typer.Option("--mesh", help="render the textured mesh instead of the splats")] = False,
    fit: Annotated[
        bool, typer.Option("--fit", help="widen the field of view until it holds the whole asset from all sides")
    ] = False,
) -> None:
    """Render an asset from given azimuths as RGBA pictures."""
    with exit_on_error():
        try:
            angles = [float(angle) for angle in azimuths.split(",")]
            if not all(map(math.isfinite, angles)):
                raise ValueError
        except ValueError:
            raise typer.BadParameter(f"{azimuths!r} is not a list of degrees such as 0,-75,15") from None
        from flows.inputs.package_record import check_is_folder
        from flows.packages.publish import check_writable

        check_is_folder(package)
        check_writable(out)
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        from steps.artifacts.packages import read_manifest
        from steps.artifacts.rendering import render_package

        views, cropped = render_package(package, angles, elevation, size, frames, mesh, out, fit=fit)
        for folder in views:
            typer.echo(folder)
        if cropped and not fit:
            advice = (
                "--fit shows all of it"
                if read_manifest(package).camera.whole_fov_y_deg is not None
                else "make the asset again with this dg4d, then --fit shows all of it"
            )
            typer.echo(f"pictures in which the asset touches the edge: {cropped}; {advice}", err=True)


@app.command()
def view(
    package: Annotated[Path, typer.Argument(metavar="PACKAGE", help="folder of an asset")],
    show: Annotated[bool, typer.Option("--open/--no-open", help="open the page in a browser")] = True,
) -> None:
    """Verify a package, open its viewer and print the page's path."""
    with exit_on_error():
        from flows.packages.view import view as check_and_show

        typer.echo(check_and_show(package, show))


@app.command()
def compose(
    out: Annotated[Path, typer.Option("-o", "--out", metavar="FILE", help="output file, .glb or .usdz")],
    packages: Annotated[
        list[Path] | None,
        typer.Argument(metavar="PACKAGE", help="folders of assets, from left to right", show_default=False),
    ] = None,
    scene: Annotated[
        Path | None, typer.Option(metavar="FILE", help="JSON file with positions and start times of the assets")
    ] = None,
    spacing: Annotated[
        float, typer.Option(min=0, max=1000, metavar="X", callback=finite, help="meters between neighbors")
    ] = 0.25,
    preview: Annotated[bool, typer.Option("--preview", help="also render a video of the scene")] = False,
) -> None:
    """Combine several assets in one animated scene.

    They stand side by side, or as a scene file places them.
    """
    with exit_on_error():
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        from flows.commands.compose import compose as compose_scene
        from flows.formatting.escaping import visible

        for note in compose_scene(packages or [], out, scene, spacing, preview):
            typer.echo(visible(note), err=True)
        typer.echo(out)


for command in (score, bench, verify, rebuild, doctor, up, studio, down, env, watch):
    app.command()(command)
app.command("settings")(list_settings)


def main() -> None:
    """Run the command, with output that can hold file names in any encoding."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    logging.raiseExceptions = False  # Prefect prints an error for log lines that do not reach the server
    app()


def _request(profile: str, changes: list[str] | None, short: dict[str, Any], **fields: Any) -> "ConversionRequest":
    """Return a checked request.

    Args:
        profile: name of the profile.
        changes: values of `--set`.
        short: settings of other options, which win.
        fields: further fields of the request.
    """
    from flows.inputs.conversion_job import ConversionRequest
    from flows.inputs.manifest import parse_changes
    from steps.profiles import profile as named
    from steps.profiles import revise

    settings = revise(named(profile), parse_changes(changes or []) | short)
    request = ConversionRequest(profile=profile, settings=settings, **fields)
    request.check()
    return request


if __name__ == "__main__":
    main()
