"""Commands that judge and check what is made: score, bench, verify, rebuild."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.commands.endings import clear_ending
from flows.commands.options import Changes, Profile, Seed

if TYPE_CHECKING:
    from flows.commands.rebuild import Rebuilt
    from flows.packages.verify import Verdict


def score(
    asset: Annotated[Path, typer.Argument(help="the folder of a package")],
    truth: Annotated[Path, typer.Option(help="pictures from known sides, meshes if there are; or one picture")],
    mesh: Annotated[bool, typer.Option("--mesh", help="the textured mesh instead of the splats")] = False,
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="score.KNOB=VALUE", help="change a knob; may be repeated")
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="also write the results here, as JSON")] = None,
) -> None:
    """Judge an asset against the truth, beside what costs nothing: the input repeated, the first frame held."""
    with clear_ending():
        from flows.commands import terminal
        from flows.commands.benchmark import score as judge_one
        from flows.packages.scores import markdown

        console = terminal.console()
        results = judge_one(asset, truth, console, mesh, changes, out)
        console.print(markdown(results), markup=False)


def bench(
    dataset: Annotated[Path, typer.Argument(help="a folder per object, with pictures from known sides")],
    out: Annotated[Path, typer.Option("-o", "--out", help="results, films, and packages in DIR/assets")],
    profile: Profile = "preview",
    changes: Changes = None,
    seed: Seed = 0,
    mesh: Annotated[bool, typer.Option("--mesh", help="judge the textured meshes instead of the splats")] = False,
    bank: Annotated[bool, typer.Option("--bank", help="every object's true views are its prior")] = False,
    limit: Annotated[int | None, typer.Option(min=1, help="only so many objects, the first by name")] = None,
    workers: Annotated[int, typer.Option(min=1, max=64, help="objects at a time")] = 1,
) -> None:
    """Make an asset of every object of a data set and judge it: the paper's table, as JSON, CSV and a page."""
    with clear_ending():
        from flows.commands import terminal
        from flows.commands.benchmark import bench as judge_all
        from flows.packages.scores import markdown

        console = terminal.console()
        results = judge_all(dataset, out, console, profile, changes, seed, mesh, bank, limit, workers)
        if len(results.failed) < len(results.objects):
            console.print(markdown(results), markup=False)
        for one in results.failed:
            console.print(f"failed: {one.object}: {one.error}", markup=False, style="red")
        console.print(f"overview: {out / 'index.html'}", markup=False)
        if results.exit_code:
            raise typer.Exit(results.exit_code)


def verify(
    package: Annotated[Path, typer.Argument(help="the folder of a package")],
    trust: Annotated[
        Path | None,
        typer.Option(help="certificates (PEM) of who vouches for signers; then all must be signed"),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="for machines")] = False,
) -> None:
    """Check every digest and signature of a package; says what was altered, is missing or was added."""
    with clear_ending():
        from flows.packages.verify import verify as check

        _tell(check(package, trust), as_json)


def rebuild(
    package: Annotated[Path, typer.Argument(help="the folder of a package")],
    source: Annotated[
        Path | None, typer.Option(help="the picture, video or folder of frames, where the store does not have it")
    ] = None,
    bank: Annotated[Path | None, typer.Option(help="the folder of true views, likewise")] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="keep the new package here")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="for machines")] = False,
) -> None:
    """Make a package again from its record, every step anew, and compare step by step."""
    with clear_ending():
        from flows import home
        from flows.commands import terminal
        from flows.inputs.orders import order_again
        from flows.packages.publish import check_folder, whole

        record = whole(package)
        if out is not None:
            check_folder(out)
        order = order_again(record, home.store(), source, bank)
        console = terminal.console(stderr=as_json)

        def work() -> "Rebuilt":
            from flows.commands.rebuild import rebuild as do_again

            return do_again(package, record, order, out)

        _tell(terminal.with_steps(order, console, work), as_json)


def _tell(found: "Verdict | Rebuilt", as_json: bool) -> None:
    """What was found, as JSON or as a table, and the exit status that says so."""
    from flows.commands import terminal

    if as_json:
        typer.echo(found.model_dump_json(indent=1))
    else:
        terminal.tell_rows(terminal.console(), found.rows())
    if found.exit_code:
        raise typer.Exit(found.exit_code)
