"""Conversion of one picture or a few; behind `dg4d make`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dg4d_lib.errors import BadInput
from flows.commands import terminal
from flows.commands.endings import describe
from flows.convert import convert_job, stored
from flows.engine.output_lock import is_up_to_date
from flows.exit_status import exit_status_of
from flows.inputs.conversion_job import ConversionRequest, name_from_text
from flows.inputs.naming import name_from_path, unique_names
from flows.inputs.package_record import record_of
from flows.packages.acceptance import failing_gates
from flows.packages.publish import check_folder

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class MakeArguments:
    """Arguments of `dg4d make` that concern the sources and the output.

    Attributes:
        pictures: pictures or videos.
        text: prompt instead of a picture.
        video: driving video.
        asset: the user's own model.
        alone: an option of the command line that makes one asset; empty if none is given.
        out: output folder; of several pictures the folder above those of the assets.
        force: replace an asset with a different name in the output folder.
        picked: true if `--pick` chooses a motion.
        request: returns the checked request of an item with its picture.
    """

    pictures: tuple[Path, ...]
    text: str
    video: Path | None
    asset: Path | None
    alone: str
    out: Path | None
    force: bool
    picked: bool
    request: Callable[[str, Path | None], ConversionRequest]


def make_each(arguments: MakeArguments, console: "Console") -> int:
    """Make an asset of every picture; return the exit status.

    One picture that fails raises its error; of several, the others are made nevertheless.

    Raises:
        BadInput: arguments cannot be combined, or the only picture cannot be used.
        StepError: a step of the only picture failed.
    """
    if len(arguments.pictures) < 2:
        picture = arguments.pictures[0] if arguments.pictures else None
        named = picture or arguments.asset or arguments.video
        item = name_from_path(named) if named else name_from_text(arguments.text)
        _make(arguments, item, picture, arguments.out or Path("out") / item, console)
        return 0
    if arguments.alone:
        raise BadInput(
            f"{arguments.alone} makes one asset, and {len(arguments.pictures)} pictures are given; give one of them"
        )
    items = unique_names([(name_from_path(path), path.suffix.lstrip(".")) for path in arguments.pictures])
    failed: dict[str, str] = {}  # kind of failure by item
    for number, (item, picture) in enumerate(zip(items, arguments.pictures, strict=True), 1):
        console.print(f"{number} of {len(items)}: {picture}", markup=False)
        try:
            _make(arguments, item, picture, (arguments.out or Path("out")) / item, console)
        except Exception as error:  # must not stop the other pictures
            from flows.engine.item_runs import failure

            failed[item] = failure(error).kind
            console.print(f"failed: {item}: {describe(error)[0]}", markup=False, style="red")
    console.print(
        f"{len(items) - len(failed)} of {len(items)} assets are in {arguments.out or Path('out')}", markup=False
    )
    if not failed:
        return 0
    return exit_status_of(failed.get(item, "") for item in items)


def _make(arguments: MakeArguments, item: str, picture: Path | None, folder: Path, console: "Console") -> None:
    """Make one asset, and print its files and how to see it."""
    request = arguments.request(item, picture)
    if arguments.picked and request.has_motion:
        raise BadInput(f"--pick chooses a generated motion, and {request.source_name} is a video; leave --pick out")
    for sentence in (*request.unused(), *request.license_conditions()):
        console.print(f"note: {sentence}", markup=False)
    check_folder(folder, item, arguments.force)
    with stored(request) as job:
        before = record_of(folder) or {}
        named = before.get("item", item)  # `--force` replaces the asset of another name
        up_to_date = cached = named == item and is_up_to_date(folder, job.digest())
        if not up_to_date:
            if named == item and before.get("source", job.source.digest) != job.source.digest:
                console.print(
                    f"note: {folder} holds the asset {item} of another source; it is replaced (the store keeps the "
                    "earlier version); -o chooses another folder",
                    markup=False,
                )
            _, cached = terminal.run_with_progress(
                job, console, lambda: convert_job(job, folder, force=arguments.force)
            )
    if up_to_date:
        console.print("nothing to do: every step was already done")
    elif cached:
        console.print("no step was run: the package was written from finished steps")
    written = (record_of(folder) or {"files": {}})["files"]
    terminal.print_package(console, folder, {name: fact["size_bytes"] for name, fact in written.items()})
    terminal.print_next(console, folder)
    if failing := failing_gates(folder):
        console.print(f"not accepted: {', '.join(failing)}; the report says what to do", markup=False, style="yellow")
