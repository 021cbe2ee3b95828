"""Commands `score`, `bench`, `verify` and `rebuild`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.commands.endings import exit_on_error
from flows.commands.options import AsJson, Changes, Package, Profile, Seed

if TYPE_CHECKING:
    from rich.console import Console

    from flows.commands.rebuild import RebuildReport
    from flows.packages.scores import Results
    from flows.packages.verify import Verification


def score(
    package: Package,
    truth: Annotated[Path, typer.Option(metavar="PATH", help="ground-truth views and meshes, or one picture")],
    mesh: Annotated[bool, typer.Option("--mesh", help="score the textured mesh instead of the splats")] = False,
    actionbench: Annotated[
        bool, typer.Option("--actionbench", help="also compare the meshes by ActionBench's CD-3D, CD-4D and CD-M")
    ] = False,
    changes: Annotated[
        list[str] | None, typer.Option("--set", metavar="score.NAME=VALUE", help="change a setting; may be repeated")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE", help="also write the results, as Markdown (.md) or as JSON"),
    ] = None,
) -> None:
    """Score an asset and three baselines against ground truth."""
    with exit_on_error():
        from flows.commands import terminal
        from flows.commands.benchmark import score as score_asset

        console = terminal.console()
        _print_scores(score_asset(package, truth, console, mesh, changes, out, actionbench), console)


def bench(
    dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="a folder per object, with ground-truth views")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="output folder; assets in DIR/assets")],
    profile: Profile = "preview",
    changes: Changes = None,
    seed: Seed = 0,
    mesh: Annotated[bool, typer.Option("--mesh", help="score the textured meshes instead of the splats")] = False,
    bank: Annotated[bool, typer.Option("--bank", help="use each object's ground-truth views as the prior")] = False,
    limit: Annotated[int | None, typer.Option(min=1, metavar="N", help="first N objects by name only")] = None,
    workers: Annotated[int, typer.Option(min=1, max=64, metavar="N", help="objects converted at a time")] = 1,
) -> None:
    """Convert and score every object of a data set.

    Writes the paper's table as JSON, CSV and HTML.
    """
    with exit_on_error():
        from flows.commands import terminal
        from flows.commands.benchmark import bench as run_benchmark

        console = terminal.console()
        results = run_benchmark(dataset, out, console, profile, changes, seed, mesh, bank, limit, workers)
        if len(results.failed) < len(results.objects):
            _print_scores(results, console)
        for one in results.failed:
            console.print(f"failed: {one.object}: {one.error}", markup=False, style="red")
        console.print(f"overview: {out / 'index.html'}", markup=False)
        if results.exit_code:
            raise typer.Exit(results.exit_code)


def verify(
    package: Package,
    trust: Annotated[
        Path | None,
        typer.Option(metavar="PEM", help="trusted CA certificates; requires every file to be signed"),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Verify every digest and signature of a package.

    Lists altered, missing and added files.
    """
    with exit_on_error():
        from flows.packages.verify import verify as check

        _print_result(check(package, trust), as_json)


def rebuild(
    package: Package,
    source: Annotated[
        Path | None, typer.Option(metavar="PATH", help="source file, if the store no longer has it")
    ] = None,
    bank: Annotated[
        Path | None, typer.Option(metavar="DIR", help="ground-truth views, if the store no longer has them")
    ] = None,
    mask: Annotated[
        Path | None, typer.Option(metavar="PATH", help="mask of the subject, if the store no longer has it")
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(metavar="FILE", help="depth picture, if the store no longer has it")
    ] = None,
    layers: Annotated[
        Path | None, typer.Option(metavar="FILE", help="picture of layers, if the store no longer has it")
    ] = None,
    asset: Annotated[
        Path | None, typer.Option(metavar="FILE", help="the user's own model, if the store no longer has it")
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", metavar="DIR", help="keep the new package in DIR")] = None,
    as_json: AsJson = False,
) -> None:
    """Make a package again from its record and compare every step."""
    with exit_on_error():
        from flows import home
        from flows.commands import terminal
        from flows.engine.leases import running
        from flows.inputs.conversion_job import job_from_record
        from flows.packages.publish import check_folder, load_verified

        record = load_verified(package)
        if out is not None:
            check_folder(out)
        console = terminal.console(stderr=as_json)

        def work() -> "RebuildReport":
            from flows.commands.rebuild import rebuild as rebuild_package

            return rebuild_package(package, record, job, out)

        with running(home.store(), str(package)):  # protects the files of the job until `work` does
            job = job_from_record(record, home.store(), source, bank, mask, depth, layers, asset)
            found = terminal.run_with_progress(job, console, work)
        _print_result(found, as_json)


def _print_scores(results: "Results", console: "Console") -> None:
    """Print scores as tables, and below them the missing metrics."""
    from flows.commands import terminal
    from flows.packages.scores import remarks, titled_tables

    terminal.print_tables(console, titled_tables(results))
    for line in remarks(results):
        console.print(line, markup=False)


def _print_result(found: "Verification | RebuildReport", as_json: bool) -> None:
    """Print a result as JSON or as a table, and exit with its status."""
    from flows.commands import terminal

    if as_json:
        typer.echo(found.model_dump_json(indent=1))
    else:
        terminal.print_rows(terminal.console(), found.rows())
    if found.exit_code:
        raise typer.Exit(found.exit_code)
