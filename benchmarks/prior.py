"""Quality of the weights-free priors on unseen views: their own views, and whole fits.

    python -m benchmarks.prior FOLDER --frames 0 16 --sheet sheet.png
    python -m benchmarks.prior FOLDER --video
    python -m benchmarks.prior --made-up 60

FOLDER has a folder per object with cut-outs `input/NNN.png` and `view_AZIMUTH/NNN.png`, all taken at elevation 0.
"""

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import benchmarks.measure  # noqa: F401 (before torch: how its threads wait)

import numpy as np  # isort: skip
import torch  # isort: skip
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.motion import fit_motion
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.images import over_white, resize
from dg4d_lib.inflation.ground import ground_turn
from dg4d_lib.metrics.image import iou, psnr
from dg4d_lib.metrics.video import motion_amount, temporal_error
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import LearnedPriorSettings, LgmStartSettings
from dg4d_lib.shape_prior import packaged
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.subject import prepare_subject
from steps.artifacts.motions import new_deformation
from steps.fit_gaussians import initial_gaussians
from steps.fitting.priors import make_prior, subject_shapes
from steps.profiles import PREVIEW, PipelineSettings, revise
from training.shape_prior.samples import make_views

SIZE = 256  # pixels of the compared pictures
MADE_UP_SEED = 991  # no training run uses it
AZIMUTHS_DEG = (-75.0, 15.0, 105.0, 195.0)
KINDS = ("geometric", "learned")
COLUMNS = ("psnr", "psnr_obj", "iou", "terr", "motion", "input")


@dataclass(frozen=True)
class Subject:
    """Footage of one object and its true views.

    Attributes:
        name: of the object.
        footage: cut-outs, straight alpha.
        views: azimuth to cut-outs.
    """

    name: str
    footage: Float[Tensor, "t h w 4"]
    views: dict[float, Float[Tensor, "t s s 4"]]


def read_subjects(folder: Path, names: Sequence[str]) -> Iterator[Subject]:
    """Read the objects of a folder, all of them if none is named."""
    for path in sorted(path for path in folder.iterdir() if (path / "input").is_dir()):
        if names and path.name not in names:
            continue
        views = sorted(path.glob("view_*"), key=lambda view: float(view.name[5:]))
        pictures = {float(view.name[5:]): resize(_read(view), (SIZE, SIZE)) for view in views}
        yield Subject(path.name, _read(path / "input"), pictures)


def made_up_subjects(count: int) -> Iterator[Subject]:
    """Make subjects of one frame up, for tuning."""
    for index in range(count):
        sample, views = make_views(MADE_UP_SEED, index, AZIMUTHS_DEG)
        pictures = torch.from_numpy(np.concatenate([sample.picture[None].astype(np.float32) / 255, views]))
        straight = torch.cat([pictures[..., :3] / pictures[..., 3:].clamp(min=1e-3), pictures[..., 3:]], -1).clamp(0, 1)
        known = zip(AZIMUTHS_DEG, straight[1:, None], strict=True)
        yield Subject(f"{sample.family} {index}", straight[:1], dict(known))


def score_prior(subject: Subject, settings: PipelineSettings, frames: Sequence[int]) -> tuple[dict[str, float], Tensor]:
    """Compare the prior's own views of some frames with the true ones.

    Returns:
        Figures, and the views of the first of these frames side by side, over white.
    """
    cutouts = prepare_subject(subject.footage, True, settings.subject).frames
    shapes = subject_shapes(settings.prior, [cutouts[frame] for frame in frames], _turn(cutouts, settings))
    size = next(iter(subject.views.values())).shape[1]
    rows, strip = [], []
    for azimuth, truth in subject.views.items():
        camera = OrbitCamera(0, azimuth, width=size, height=size)
        color, alpha = shapes.clean([GuidanceView(camera, number) for number in range(len(frames))])
        rows.append(_figures(color, alpha, truth[list(frames)]))
        strip.append(color[0])
    return _mean(rows), torch.cat(strip, 1)


def score_fit(subject: Subject, settings: PipelineSettings, seed: int = 0) -> tuple[dict[str, float], Tensor]:
    """Fit Gaussians and their motion to the footage; compare views of all frames with the true ones.

    Returns:
        Figures, and the views of the first frame side by side, over white.
    """
    rasterize, generator = get_rasterizer("auto"), torch.Generator().manual_seed(seed)
    cutouts = prepare_subject(subject.footage, True, settings.subject).frames
    turn_deg, start_settings = _turn(cutouts, settings), settings.static.start
    assert not isinstance(start_settings, LgmStartSettings), "these fits start without LGM"
    start = initial_gaussians(start_settings, subject_shapes(settings.prior, [cutouts[0]], turn_deg), generator)
    prior = make_prior(settings.prior, [cutouts[0]], settings.static, None, Path(), turn_deg).prior
    rest = fit_gaussians(start, cutouts[0], prior, rasterize, settings.static, generator)
    prior = make_prior(settings.prior, list(cutouts), settings.motion, None, Path(), turn_deg).prior
    video = DrivingVideo(cutouts[..., :3].contiguous(), cutouts[..., 3:].contiguous(), 10)
    deformation = new_deformation(settings.deformation, rest, len(video), generator)
    fitted = fit_motion(rest, deformation, video, prior, rasterize, settings.motion, generator)
    rows, strip = [], []
    with torch.no_grad():
        moved = deformation.displace(fitted.means, torch.linspace(0, 1, len(video))).apply(fitted)
        for azimuth, truth in {0.0: resize(cutouts, (SIZE, SIZE)), **subject.views}.items():
            camera = OrbitCamera(0, azimuth, width=SIZE, height=SIZE)
            drawn = [rasterize(moved.at(frame), [camera], torch.ones(3)) for frame in range(len(video))]
            color = torch.cat([picture.color for picture in drawn]).clamp(0, 1)
            rows.append(_figures(color, torch.cat([picture.alpha for picture in drawn]), truth[: len(video)]))
            strip.append(color[0])
    return {**_mean(rows[1:]), "input": rows[0]["psnr"]}, torch.cat(strip[1:], 1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare priors on objects whose views are known."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.prior", description=main.__doc__)
    parser.add_argument("objects", type=Path, nargs="?", help="folder of objects")
    parser.add_argument("--only", nargs="+", default=(), help="names of objects")
    parser.add_argument("--made-up", type=int, default=0, metavar="N", help="made-up shapes instead of a folder")
    parser.add_argument("--kinds", nargs="+", default=KINDS, help="values of prior.kind")
    parser.add_argument("--frames", type=int, nargs="+", default=(0,), help="frames of which priors are compared")
    parser.add_argument("--video", action="store_true", help="fit Gaussians and motion with the profile preview")
    parser.add_argument("--weights", type=Path, help="network instead of the shipped one")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, for all kinds")
    parser.add_argument("--sheet", type=Path, help="picture: input, truth, and the views of every kind")
    parser.add_argument("--json", type=Path, help="file of all figures")
    given = parser.parse_args(arguments)
    if (given.objects is None) == (given.made_up == 0):
        parser.error("give a folder of objects or --made-up N")
    if given.weights:
        packaged.WEIGHTS = given.weights
        packaged.SHA256 = hashlib.sha256(given.weights.read_bytes()).hexdigest()
    changes = dict(pair.split("=", 1) for pair in given.set)
    values = {key: json.loads(value) for key, value in changes.items()}
    subjects = made_up_subjects(given.made_up) if given.made_up else read_subjects(given.objects, given.only)
    figures: dict[str, dict[str, dict[str, float]]] = {}
    strips = []
    for subject in subjects:
        shown = [over_white(resize(subject.footage[:1], (SIZE, SIZE)))[0]]
        shown += [over_white(resize(view[:1], (SIZE, SIZE)))[0] for view in subject.views.values()]
        figures[subject.name] = {}
        for kind in given.kinds:
            settings = revise(PREVIEW, {"prior.kind": kind, **values})
            judge = score_fit(subject, settings) if given.video else score_prior(subject, settings, given.frames)
            figures[subject.name][kind] = judge[0]
            shown.append(judge[1] if judge[1].shape[0] == SIZE else resize(judge[1][None], (SIZE, 4 * SIZE))[0])
        sys.stdout.write(_line(subject.name, figures[subject.name]))
        sys.stdout.flush()
        strips.append(torch.cat(shown, 1))
    sys.stdout.write(_line("mean", {kind: _mean([row[kind] for row in figures.values()]) for kind in given.kinds}))
    if given.json:
        given.json.write_text(json.dumps(figures, indent=1))
    if given.sheet:
        pixels = (torch.cat(strips).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        Image.fromarray(pixels).reduce(2).save(given.sheet)


def _turn(cutouts: Float[Tensor, "t h w 4"], settings: PipelineSettings) -> float:
    """Return the turn that the pipeline uses for this footage."""
    learned = isinstance(settings.prior, LearnedPriorSettings)
    found = 0.0 if learned else ground_turn(cutouts[..., 3:], settings.subject.ground_turn)
    return settings.subject.turn_deg or found


def _figures(
    color: Float[Tensor, "t s s 3"], alpha: Float[Tensor, "t s s 1"], cutouts: Float[Tensor, "t s s 4"]
) -> dict[str, float]:
    truth, mask = over_white(cutouts), cutouts[..., 3:]
    either = ((alpha > 0.5) | (mask > 0.5)).float()
    figures = {
        "psnr": psnr(color, truth).mean(),
        "psnr_obj": psnr(color, truth, either).mean(),
        "iou": iou(alpha, mask).mean(),
    }
    if len(color) > 1:
        figures |= {"terr": temporal_error(color, truth), "motion": motion_amount(color, truth)}
    return {name: float(value) for name, value in figures.items()}


def _mean(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def _line(name: str, kinds: dict[str, dict[str, float]]) -> str:
    cells = [" / ".join(f"{row[c]:.3f}" for c in COLUMNS if c in row) for row in kinds.values()]
    return f"| {name} | {' | '.join(cells)} |\n"


def _read(folder: Path) -> Float[Tensor, "t h w 4"]:
    frames = []
    for path in sorted(folder.glob("*.png")):
        with Image.open(path) as picture:
            frames.append(np.asarray(picture.convert("RGBA"), np.float32) / 255)
    return torch.from_numpy(np.stack(frames))


if __name__ == "__main__":
    main()
