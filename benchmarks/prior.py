"""Quality of the weights-free priors on unseen views: their own views, and whole fits.

    python -m benchmarks.prior FOLDER --frames 0 16 --sheet sheet.png
    python -m benchmarks.prior FOLDER --video
    python -m benchmarks.prior --synthetic 60
    python -m benchmarks.prior --synthetic 40 --hints
    python -m benchmarks.prior --pictures examples/newt.png examples/beetle.png --sheet sheet.png

FOLDER has a folder per object with cut-outs `input/NNN.png` and `view_AZIMUTH/NNN.png`, all taken at elevation 0.
"""

import hashlib
import json
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from benchmarks.depth_hints import hints_of, mesh_depth, sample_depth
from benchmarks.measure import parser_of
from benchmarks.true_views import (
    SIZE,
    Figures,
    Subject,
    figures,
    hint_of,
    line,
    mean,
    prepared,
    read_subjects,
    score_fit,
    write_sheet,
)

import numpy as np  # isort: skip
import torch  # isort: skip
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.images import over_white, resize
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.shape_prior import packaged
from dg4d_lib.video.subject import prepare_subject
from flows.inputs.manifest import parse_changes
from steps.artifacts.media import read_png
from steps.fitting.priors import subject_shapes
from steps.profiles import PREVIEW, PipelineSettings, revise
from training.shape_prior.samples import make_views

SYNTHETIC_SEED = 991  # no training run uses it
AZIMUTHS_DEG = (-75.0, 15.0, 105.0, 195.0)
KINDS = ("geometric", "learned")
SHEET, SHEET_ELEVATION_DEG = 256, 10.0  # pixels of a panel and elevation of the cameras in a sheet of surfaces


def synthetic_subjects(count: int) -> Iterator[Subject]:
    """Make subjects of one frame up, for tuning."""
    for index in range(count):
        sample, views = make_views(SYNTHETIC_SEED, index, AZIMUTHS_DEG)
        pictures = torch.from_numpy(np.concatenate([sample.picture[None].astype(np.float32) / 255, views]))
        straight = torch.cat([pictures[..., :3] / pictures[..., 3:].clamp(min=1e-3), pictures[..., 3:]], -1).clamp(0, 1)
        known = zip(AZIMUTHS_DEG, straight[1:, None], strict=True)
        yield Subject(f"{sample.family} {index}", straight[:1], dict(known), depth=sample_depth(sample))


def true_hints(subject: Subject) -> dict[str, DepthHint]:
    """Return hints at the depth of a subject that are true, or nearly so, by name.

    The depth belongs to the whole frame, so the framing must be kept.
    """
    depth = subject.depth
    if depth is None:
        assert subject.truth is not None and subject.truth.mesh is not None, "hints need a true depth"
        depth = mesh_depth(subject.truth.mesh, SIZE)
    alpha = resize(subject.footage[:1, ..., 3:], (len(depth), len(depth)))[0, ..., 0].clamp(0, 1)
    return hints_of(depth, alpha)


def score_prior(
    subject: Subject, settings: PipelineSettings, frames: Sequence[int], hint: DepthHint | None = None
) -> tuple[Figures, Tensor]:
    """Compare the prior's own views of some frames with the true ones.

    Args:
        subject: footage and true views.
        settings: of the pipeline.
        frames: that are compared.
        hint: at the depth of the subject, instead of the turn that the pipeline finds.

    Returns:
        Figures, and the views of the first of these frames side by side, over white.
    """
    cutouts = prepared(subject, settings)
    hint = hint or hint_of(cutouts, settings)
    shapes = subject_shapes(settings.prior, [cutouts[frame] for frame in frames], hint)
    size = next(iter(subject.views.values())).shape[1]
    rows, strip = [], []
    for azimuth, truth in subject.views.items():
        camera = OrbitCamera(0, azimuth, width=size, height=size)
        color, alpha = shapes.clean([GuidanceView(camera, number) for number in range(len(frames))])
        rows.append(figures(color, alpha, truth[list(frames)]))
        strip.append(color[0])
    return mean(rows), torch.cat(strip, 1)


def surface_strip(cutout: Tensor, settings: PipelineSettings) -> Tensor:
    """Return the picture and the surface of frame 0 from eight sides, over white."""
    shapes = subject_shapes(settings.prior, [cutout], DepthHint(settings.subject.turn_deg or None))
    cameras = [OrbitCamera(SHEET_ELEVATION_DEG, azimuth, width=SHEET, height=SHEET) for azimuth in range(0, 360, 45)]
    color, alpha = render_surface(shapes.surface(0), cameras)
    return torch.cat([over_white(resize(cutout[None], (SHEET, SHEET)))[0], *(color * alpha + 1 - alpha)], 1)


def compare_surfaces(pictures: Sequence[Path], kinds: Sequence[str], values: dict[str, object], sheet: Path) -> None:
    """Write the surfaces that priors guess for pictures: a row per picture and kind."""
    strips = []
    for path in pictures:
        for kind in kinds:
            settings = revise(PREVIEW, {"prior.kind": kind, **values})
            cutout = prepare_subject(read_png(path)[None], False, settings.subject).frames[0]
            strips.append(surface_strip(cutout, settings))
    write_sheet(sheet, strips)


def compare_hints(
    subjects: Iterable[Subject], kinds: Sequence[str], values: dict[str, object], frames: Sequence[int]
) -> tuple[dict[str, dict[str, dict[str, Figures]]], list[Tensor]]:
    """Score priors with true hints at the depth.

    Returns:
        Figures by subject, hint and kind, and strips: per subject and hint the picture, and the views of every kind.
    """
    found: dict[str, dict[str, dict[str, Figures]]] = {}
    strips = []
    for subject in subjects:
        rows: dict[str, dict[str, Figures]] = {}
        picture = over_white(resize(subject.footage[:1], (SIZE, SIZE)))[0]
        for name, hint in true_hints(subject).items():
            shown, rows[name] = [picture], {}
            for kind in kinds:
                settings = revise(PREVIEW, {"prior.kind": kind, "subject.framing": "keep", **values})
                rows[name][kind], strip = score_prior(subject, settings, frames, hint)
                shown.append(_fitted(strip))
            strips.append(torch.cat(shown, 1))
        found[subject.name] = rows
        sys.stderr.write(f"{subject.name}\n")
    for name in next(iter(found.values())):
        means = {kind: mean([rows[name][kind] for rows in found.values()]) for kind in kinds}
        sys.stdout.write(line(name, means))
    return found, strips


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare priors on objects whose views are known."""
    parser = parser_of(__doc__)
    parser.add_argument("objects", type=Path, nargs="?", help="folder of objects")
    parser.add_argument("--only", nargs="+", default=(), help="names of objects")
    parser.add_argument("--synthetic", type=int, default=0, metavar="N", help="synthetic shapes instead of a folder")
    parser.add_argument("--kinds", nargs="+", default=KINDS, help="values of prior.kind")
    parser.add_argument("--frames", type=int, nargs="+", default=(0,), help="frames of which priors are compared")
    parser.add_argument(
        "--hints", action="store_true", help="mean scores with hints from ground truth: yaw, layers and depth"
    )
    parser.add_argument("--video", action="store_true", help="fit Gaussians and motion with the profile preview")
    parser.add_argument("--weights", type=Path, help="network instead of the shipped one")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, for all kinds")
    parser.add_argument("--pictures", type=Path, nargs="+", help="PNG cut-outs whose guessed surfaces are rendered")
    parser.add_argument("--sheet", type=Path, help="picture: input, truth, and the views of every kind")
    given = parser.parse_args(arguments)
    if sum((given.objects is not None, given.synthetic > 0, given.pictures is not None)) != 1:
        parser.error("give a folder of objects, --synthetic N or --pictures FILE ...")
    if given.pictures and not given.sheet:
        parser.error("--pictures needs --sheet FILE")
    if given.weights:
        packaged.WEIGHTS = given.weights
        packaged.SHA256 = hashlib.sha256(given.weights.read_bytes()).hexdigest()
    values = parse_changes(given.set)
    if given.pictures:
        compare_surfaces(given.pictures, given.kinds, values, given.sheet)
        return
    subjects = synthetic_subjects(given.synthetic) if given.synthetic else read_subjects(given.objects, given.only)
    if given.hints:
        scored, strips = compare_hints(subjects, given.kinds, values, given.frames)
        if given.json:
            given.json.write_text(json.dumps(scored, indent=1))
        if given.sheet:
            write_sheet(given.sheet, strips)
        return
    found: dict[str, dict[str, Figures]] = {}
    strips = []
    for subject in subjects:
        shown = [over_white(resize(subject.footage[:1], (SIZE, SIZE)))[0]]
        shown += [over_white(resize(view[:1], (SIZE, SIZE)))[0] for view in subject.views.values()]
        found[subject.name] = {}
        for kind in given.kinds:
            settings = revise(PREVIEW, {"prior.kind": kind, **values})
            judge = score_fit(subject, settings) if given.video else score_prior(subject, settings, given.frames)
            found[subject.name][kind] = judge[0]
            shown.append(_fitted(judge[1]))
        sys.stdout.write(line(subject.name, found[subject.name]))
        sys.stdout.flush()
        strips.append(torch.cat(shown, 1))
    sys.stdout.write(line("mean", {kind: mean([row[kind] for row in found.values()]) for kind in given.kinds}))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))
    if given.sheet:
        write_sheet(given.sheet, strips)


def _fitted(strip: Tensor) -> Tensor:
    """Return a strip in the height of the sheet's rows; of a fit, the first row."""
    height = strip.shape[0]
    if height == 2 * SIZE:
        return strip[:SIZE]
    return strip if height == SIZE else resize(strip[None], (SIZE, SIZE * strip.shape[1] // height))[0]


if __name__ == "__main__":
    main()
