"""Quality of assets by what a user gives: a video alone, pictures of other sides, a turntable, a mesh.

    python -m benchmarks.inputs --views FOLDER --sheet sheet.png
    python -m benchmarks.inputs --views FOLDER --azimuths 180
    python -m benchmarks.inputs --turntable FOLDER
    python -m benchmarks.inputs --asset FOLDER
    python -m benchmarks.inputs --matting FOLDER
    python -m benchmarks.inputs --none FOLDER

FOLDER is a data set of `steps.artifacts.ground_truth` whose objects also have `static/az_AZIMUTH.png`, frame 0 from
other sides, and `bank/`. A fit takes a minute or more per object; `--first` scores the shape of frame 0 alone, in
seconds.
"""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks import matting, own_asset
from benchmarks.measure import new_console, parser_of, write_rows
from benchmarks.true_views import SIZE, Figures, Subject, figures, line, mean, prepared, read_subjects, score_fit

import torch  # isort: skip
from torch import Tensor

from benchmarks.true_views import write_sheet
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.images import over_white
from dg4d_lib.inflation.hints import DepthHint
from flows.inputs.manifest import parse_changes
from steps.artifacts.media import write_png, write_zip
from steps.fitting.priors import read_bank, read_bank_folder, subject_shapes
from steps.prepare_views import run as prepare_views
from steps.profiles import PREVIEW, PipelineSettings, revise, step_settings
from steps.runtime.job import Job
from steps.sources.views import VIEWS_JSON, GivenView, GivenViews

AZIMUTHS_DEG = (90.0, 180.0, 270.0)

Given = tuple[GivenViews, list[tuple[str, bytes]]]  # what a user gives: views.json and the files that it names


@dataclass(frozen=True)
class Way:
    """One way of giving more than a video.

    Attributes:
        help: description of its option.
        given: views of an object and their files, from a folder for scratch; None for none.
    """

    help: str
    given: Callable[[Subject, Sequence[float], Path], Given] | None


def pictures_of(subject: Subject, azimuths: Sequence[float], scratch: Path) -> Given:
    """Return pictures of frame 0 from other sides."""
    assert subject.truth is not None, "synthetic subjects have no files"
    folder = subject.truth.inputs[0].parents[1] / "static"
    names = [f"az_{azimuth:03.0f}.png" for azimuth in azimuths]
    views = [GivenView(file=name, name=name, azimuth=azimuth) for name, azimuth in zip(names, azimuths, strict=True)]
    return GivenViews(views=tuple(views)), [(name, (folder / name).read_bytes()) for name in names]


def turntable_of(subject: Subject, azimuths: Sequence[float], scratch: Path) -> Given:
    """Return frame 0 of the bank at elevation 0 as a folder of frames."""
    assert subject.truth is not None and subject.truth.bank is not None, f"{subject.name} has no bank"
    bank = read_bank_folder(subject.truth.bank)
    level = sorted((c.azimuth_deg % 360, row) for row, c in enumerate(bank.cameras) if c.elevation_deg == 0)
    frames = []
    for number, (_, row) in enumerate(level):
        write_png(scratch / "frame.png", bank.pictures[row, bank.frames.index(0)].float() / 255)
        frames.append((f"{number:03d}.png", (scratch / "frame.png").read_bytes()))
    write_zip(scratch / "frames.zip", frames)
    return GivenViews(turntable="turntable"), [("turntable", (scratch / "frames.zip").read_bytes())]


WAYS = {  # of giving views
    "none": Way("the video alone", None),
    "views": Way("the video, and frame 0 from other azimuths", pictures_of),
    "turntable": Way("the video, and a turntable of frame 0", turntable_of),
}


def sides_of(subject: Subject, way: Way, azimuths: Sequence[float], settings: PipelineSettings) -> Bank | None:
    """Return the known views of an object as `prepare_views` makes them."""
    if way.given is None:
        return None
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        given, files = way.given(subject, azimuths, scratch)
        write_zip(scratch / "views.zip", [(VIEWS_JSON, given.model_dump_json().encode()), *files])
        return known_bank(subject, scratch / "views.zip", settings)


def known_bank(subject: Subject, views: Path, settings: PipelineSettings) -> Bank:
    """Return the bank that `prepare_views` makes of the zip of views of an object; print its notes."""
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        write_png(scratch / "subject.png", prepared(subject, settings)[0])
        (scratch / "pictures").mkdir()
        (scratch / "bank").mkdir()
        inputs = {"views": views, "subject": scratch / "subject.png", "source": scratch / "subject.png"}
        outputs = {"known_views": scratch / "known.zip", "picture": scratch / "picture.png"}
        made = step_settings("prepare_views", settings)
        report = prepare_views(Job(inputs, outputs, made, 0, lambda *_: None, scratch / "pictures"))
        for note in report.notes:
            sys.stderr.write(f"{subject.name}: {note}\n")
        return read_bank(scratch / "known.zip", scratch / "bank")


def score_first(subject: Subject, settings: PipelineSettings, sides: Bank | None) -> tuple[Figures, Tensor]:
    """Compare the shape of frame 0, without any fit, with the true views."""
    shapes = subject_shapes(
        settings.prior, [prepared(subject, settings)[0]], DepthHint(settings.subject.turn_deg or None), sides
    )
    rows, strips = [], []
    for azimuth, truth in subject.views.items():
        color, alpha = shapes.clean([GuidanceView(OrbitCamera(0, azimuth, width=SIZE, height=SIZE))])
        rows.append(figures(color, alpha, truth[:1]))
        strips.append(torch.cat([color[0], over_white(truth[:1])[0]]))
    return mean(rows), torch.cat(strips, 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Score one way of input on the objects of a data set."""
    parser = parser_of(__doc__)
    ways = parser.add_mutually_exclusive_group(required=True)
    for name, way in WAYS.items():
        ways.add_argument(f"--{name}", type=Path, metavar="FOLDER", help=way.help)
    ways.add_argument("--asset", type=Path, metavar="FOLDER", help="the video, and the true mesh of frame 0")
    ways.add_argument("--matting", type=Path, metavar="FOLDER", help="the input over backdrops; scores its cut-out")
    parser.add_argument("--only", nargs="+", default=(), help="names of objects")
    parser.add_argument("--azimuths", type=float, nargs="+", default=AZIMUTHS_DEG, help="of the pictures of --views")
    parser.add_argument("--first", action="store_true", help="score the shape of frame 0 alone, without a fit")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting")
    parser.add_argument("--sheet", type=Path, help="picture: unseen views over time, above the ground truth")
    parser.add_argument("--sheets", type=Path, metavar="DIR", help="folder for a contact sheet of each --asset")
    given = parser.parse_args(arguments)
    changes = parse_changes(given.set)
    if given.asset:
        models = own_asset.read_models(given.asset, given.only)
        measured = own_asset.measure(models, revise(PREVIEW, changes).asset, own_asset.write_line, given.sheets)
        if given.json:
            given.json.write_text(json.dumps(measured, indent=1))
        return
    if given.matting:
        rows = matting.measure_matting(given.matting, objects=given.only)
        new_console().print(matting.table(rows))
        if given.json:
            write_rows(given.json, rows)
        return
    name = next(name for name in WAYS if getattr(given, name))
    settings = revise(PREVIEW, changes)
    found: dict[str, Figures] = {}
    strips = []
    for subject in read_subjects(getattr(given, name), given.only):
        sides = sides_of(subject, WAYS[name], given.azimuths, settings)
        score = score_first(subject, settings, sides) if given.first else score_fit(subject, settings, sides=sides)
        found[subject.name] = score[0]
        strips.append(score[1])
        sys.stdout.write(line(subject.name, {name: score[0]}))
        sys.stdout.flush()
    sys.stdout.write(line("mean", {name: mean(list(found.values()))}))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))
    if given.sheet:
        write_sheet(given.sheet, strips)


if __name__ == "__main__":
    main()
