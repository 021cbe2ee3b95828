"""Commands for background services: up, studio, down, env, watch."""

import os
import shlex
import time
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flows.commands.endings import exit_on_error
from flows.commands.options import finite

if TYPE_CHECKING:
    from flows.serving.server import Server

POLL_S = 1.0  # between two scans of a watched folder
RESULTS_EVERY_S = 5.0  # between two polls for finished packages
OPEN_OWN = "open this address first: it signs the browser in to the Prefect UI"
WATCH_STOPPED = "stopped watching; conversions that were sent continue until `dg4d down`"
OPEN_OTHER = "open this address, the Prefect UI of $PREFECT_API_URL; a server of dg4d signs the browser in at"


def up(
    pools: Annotated[
        list[str] | None,
        typer.Option(
            "--pool",
            metavar="NAME",
            help="work pool of deploy/pools.yaml; may be repeated  [default: process-cpu, and process-gpu with a GPU]",
        ),
    ] = None,
    workers: Annotated[bool, typer.Option("--worker/--no-worker", help="start a worker on this machine")] = True,
    sources: Annotated[
        list[str] | None,
        typer.Option(
            "--sources",
            metavar="DIR",
            help="folder or s3://BUCKET/PREFIX that deployments may read, and write unless $DG4D_OUTPUTS is set; may "
            "be repeated  [default: $DG4D_SOURCES, else the current folder]",
        ),
    ] = None,
) -> None:
    """Start a Prefect server with deployments and a worker.

    Prints the address that signs a browser in. Server and worker run until `dg4d down`. With $PREFECT_API_URL set,
    pools and deployments are registered on that server.
    """
    with exit_on_error():
        from flows.serving.server import LOGIN

        server, forms = _serve(pools, workers, sources)
        api_url = os.environ["PREFECT_API_URL"]
        address, is_own = api_url.removesuffix("/api"), server.is_at(api_url)
        choose = f"; then choose Deployments, {forms[0].partition('/')[2]}, Run" if forms else ""
        typer.echo((OPEN_OWN if is_own else f"{OPEN_OTHER} {LOGIN}#NAME:PASSWORD") + choose, err=True)
        typer.echo(server.login_address(address) if is_own else address)
        if is_own:
            typer.echo('other programs: eval "$(dg4d env)"; server and workers run until `dg4d down`', err=True)


def studio(
    sources: Annotated[
        list[str] | None,
        typer.Option(
            "--sources",
            metavar="DIR",
            help="further folder or s3://BUCKET/PREFIX that deployments may read, besides what is dropped; may be "
            "repeated",
        ),
    ] = None,
    show: Annotated[bool, typer.Option("--open/--no-open", help="open the page in a browser")] = True,
) -> None:
    """Open a page to drop pictures on and to look at assets.

    Starts the Prefect server with deployments and a worker as `dg4d up` does, and prints the page's address, which
    signs the browser in. Server and worker run until `dg4d down`.
    """
    with exit_on_error():
        from dg4d_lib.errors import BadInput
        from flows import home
        from flows.serving.addresses import STUDIO_ADDRESS

        if "PREFECT_API_URL" in os.environ:
            raise BadInput(
                "PREFECT_API_URL is set, and the studio is a page of the background server: unset the variable, or "
                f"open {STUDIO_ADDRESS} on that server if it is one of dg4d's"
            )
        home.uploads().mkdir(mode=0o700, parents=True, exist_ok=True)
        home.make_private(home.studio().parent)
        server, _ = _serve(None, True, [str(home.uploads()), *(sources or ())], quiet=True)
        api_url = os.environ["PREFECT_API_URL"]
        address = server.login_address(api_url.removesuffix("/api"), STUDIO_ADDRESS)
        typer.echo("open this address: it signs the browser in; server and worker run until `dg4d down`", err=True)
        typer.echo(address)
        if show:
            from flows.packages.view import open_page

            open_page(address)


def _serve(
    pools: list[str] | None, workers: bool, sources: list[str] | None, quiet: bool = False
) -> tuple["Server", list[str]]:
    """Start the server, register pools and deployments, and start workers; see `up`.

    Args:
        pools: names; None: process-cpu, and process-gpu with a GPU.
        workers: start workers on this machine.
        sources: folders that deployments may read; None or empty: the default.
        quiet: print no list, and leave a worker that runs with other sources as it is.

    Returns:
        The server, and the deployments with forms as FLOW/NAME.

    Raises:
        BadInput: a pool is unknown, a source is not a folder, or a worker runs with other sources.
    """
    from dg4d_lib.errors import BadInput
    from dg4d_lib.rasterizer.backends import cuda_device_count
    from flows.convert import connect
    from flows.serving import background, roots
    from flows.serving.pools import read_pools
    from flows.serving.workers import Worker, limit

    known = read_pools()
    pool_names = pools or ["process-cpu", *(["process-gpu"] if cuda_device_count() else [])]
    if unknown := [name for name in pool_names if name not in known]:
        raise BadInput(f"unknown pool {unknown[0]!r}; deploy/pools.yaml has: {', '.join(known)}")
    server = background.background_server()
    variables = roots.environment(sources or ())
    limits = {name: limit(known[name].per_worker) for name in pool_names}
    own = [Worker(name, server.folder) for name in pool_names] if workers else []
    for worker in own:
        if sources and not quiet and worker.is_running() and worker.sources != variables[roots.SOURCES]:
            raise BadInput(f"the worker of {worker.pool} runs with --sources {worker.sources}; stop it: `dg4d down`")
    if "PREFECT_API_URL" not in os.environ:
        server.start()
        server.keep()
    connect()
    from flows.engine.item_runs import FLOW
    from flows.serving.registering import register

    # catalogs start the other deployments
    forms = [name for name in register(known, pool_names) if not name.startswith(f"{FLOW}/")]
    if forms and not quiet:
        typer.echo("deployments with forms in the Prefect UI:", err=True)
        for name in forms:
            typer.echo(name)
    api_url = os.environ["PREFECT_API_URL"]
    server.folder.mkdir(parents=True, exist_ok=True)
    for worker in own:
        worker.start(api_url, {**variables, **limits[worker.pool]})
        if not quiet:
            typer.echo(f"worker {worker.pool} reads files below {worker.sources}", err=True)
    return server, forms


def down() -> None:
    """Stop the server and the workers of this machine."""
    with exit_on_error():
        from flows.serving import background
        from flows.serving.workers import running

        server = background.background_server()
        stopped = []
        for worker in running(server.folder):
            runs = worker.runs()
            typer.echo(f"stopping worker {worker.pool}" + (f" and its {runs} run{'s' * (runs > 1)}" if runs else ""))
            stopped.append(worker.stop())
        if server.address() is not None and server.is_used():
            typer.echo("stopping the server, which a running command uses and will start again")
        typer.echo("stopped" if server.stop() or stopped else "nothing was running")


def env() -> None:
    """Print the environment variables that Prefect's commands need.

    Use: eval "$(dg4d env)"
    """
    with exit_on_error():
        from flows.serving import background
        from flows.serving.server import ServerUnavailable

        server = background.background_server()
        if (address := server.address()) is None:
            raise ServerUnavailable("no server is running; start one with `dg4d up`")
        typer.echo(f"export PREFECT_API_URL={address}/api")
        typer.echo(f"export PREFECT_API_AUTH_STRING={shlex.quote(server.auth_string())}")


def watch(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="folder into which pictures, videos or a manifest are dropped")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="output folder; each item gets DIR/ITEM")],
    rest_s: Annotated[
        float,
        typer.Option(
            "--rest", min=1, metavar="S", callback=finite, help="seconds without a change before conversion starts"
        ),
    ] = 10.0,
) -> None:
    """Convert the files that are dropped into a folder.

    Uses the deployment "Catalog to 4D" of `dg4d up`, and runs until it is stopped. A manifest directly in the folder
    names what is converted; without one, that is every picture and video. Other files are ignored, and models need a
    manifest. When the command is started again, it sends the folder once more: finished items are skipped, failed ones
    are tried again.
    """
    with exit_on_error(WATCH_STOPPED):
        from dg4d_lib.errors import BadInput
        from flows.convert import connect
        from flows.packages.publish import check_writable
        from flows.serving.results import Results, check_watched

        check_watched(folder, out)
        check_writable(out)
        connect()
        import httpx

        from flows.serving.roots import granted
        from flows.serving.watching import FailedRuns, Watcher, announce, check_registered
        from flows.ui.showing import revive

        check_registered()
        watcher = Watcher(folder, out, rest_s)
        typer.echo(
            f"watching {watcher.folder} for pictures, videos and manifests (other files are ignored, models need a "
            f"manifest); packages go to {watcher.out}; stop with Ctrl-C"
        )
        results, runs = Results(watcher.out), FailedRuns(watcher.out)
        looked, trouble = 0.0, ""
        with granted(watcher.folder, watcher.out):
            while True:
                if time.monotonic() - looked >= RESULTS_EVERY_S:
                    lines = results.poll()
                    with suppress(httpx.HTTPError):  # retried by the next poll
                        lines += runs.poll()
                    for line in lines:
                        typer.echo(line)
                    looked = time.monotonic()
                if (digest := watcher.poll(time.monotonic())) is not None:
                    before, trouble = trouble, ""
                    try:
                        announce(watcher.folder, watcher.inputs(), watcher.out, digest)
                    except BadInput as error:  # the user can change the folder
                        trouble = str(error)
                    except (httpx.TransportError, httpx.HTTPStatusError) as error:
                        if isinstance(error, httpx.HTTPStatusError) and not _is_passing(error.response.status_code):
                            raise
                        trouble = "the server is unavailable; the files are sent when it answers"
                        revive()
                    else:
                        watcher.mark_announced()
                        typer.echo(
                            f"no change for {rest_s:g} s: files sent to the server; finished packages are listed below"
                        )
                    if trouble not in {"", before}:
                        typer.echo(trouble, err=True)
                time.sleep(POLL_S)


def _is_passing(status: int) -> bool:
    """Return True for an HTTP status of a server that may accept the same request later."""
    return status == HTTPStatus.TOO_MANY_REQUESTS or status >= HTTPStatus.INTERNAL_SERVER_ERROR
