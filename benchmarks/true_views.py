"""Objects whose unseen views are known, and scores of fits to their footage."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import benchmarks.measure  # noqa: F401 (before torch: how its threads wait)

import torch  # isort: skip
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from dg4d_lib.asset_settings import ScoreSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.motion import fit_motion
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.images import over_white, resize
from dg4d_lib.inflation.ground import ground_turn
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import LgmStartSettings
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.subject import prepare_subject
from steps.artifacts.ground_truth import GroundTruth, find_ground_truths
from steps.artifacts.media import read_png
from steps.artifacts.motions import new_deformation
from steps.fit_gaussians import initial_gaussians
from steps.fitting.priors import known_views, make_prior, still_views, subject_shapes, usable_turn
from steps.fitting.tracking import SurfaceTracker, tracks_surface
from steps.profiles import PipelineSettings
from steps.score_asset import MetricNetworks, ViewFrames, compare

SIZE = 256  # pixels of the compared pictures
COLUMNS = ("psnr", "psnr_obj", "iou", "terr", "motion", "flicker", "input")
SHOWN = 4  # frames of a contact sheet, evenly spaced
WITHOUT_NETWORKS = ScoreSettings(vgg_weights="", lpips_weights="", clip_weights="", i3d_weights="")

Figures = dict[str, float]


@dataclass(frozen=True)
class Subject:
    """Footage of one object and its true views.

    Attributes:
        name: of the object.
        footage: cut-outs, straight alpha.
        views: azimuth to cut-outs.
        truth: files of the object; None for synthetic ones.
        depth: distance of the first frame's surface from the camera's plane, 0 where there is none; None: unknown.
    """

    name: str
    footage: Float[Tensor, "t h w 4"]
    views: Mapping[float, Float[Tensor, "t s s 4"]] = field(default_factory=dict)
    truth: GroundTruth | None = None
    depth: Float[Tensor, "s s"] | None = None


def read_subjects(folder: Path, names: Sequence[str] = ()) -> Iterator[Subject]:
    """Read the objects of a data set, all of them if none is named."""
    for truth in find_ground_truths(folder):
        if names and truth.name not in names:
            continue
        views = {view.azimuth_deg: resize(_read(view.frames), (SIZE, SIZE)) for view in truth.views}
        yield Subject(truth.name, _read(truth.inputs), views, truth)


def prepared(subject: Subject, settings: PipelineSettings) -> Float[Tensor, "t s s 4"]:
    """Return the footage as the pipeline cuts it out."""
    return prepare_subject(subject.footage, True, settings.subject).frames


def hint_of(cutouts: Float[Tensor, "t h w 4"], settings: PipelineSettings) -> DepthHint:
    """Return the turn that the pipeline uses for this footage."""
    found = ground_turn(cutouts[..., 3:], settings.subject.ground_turn)
    return DepthHint(settings.subject.turn_deg or usable_turn(settings.prior, found))


def fit(subject: Subject, settings: PipelineSettings, sides: Bank | None = None) -> Gaussians:
    """Fit Gaussians and their motion to the footage; return their states at all frames.

    Args:
        subject: footage and true views.
        settings: of the pipeline.
        sides: known views beside the input.
    """
    rasterize, generator = get_rasterizer("auto"), torch.Generator().manual_seed(0)
    cutouts = prepared(subject, settings)
    hint = DepthHint(settings.subject.turn_deg or None) if sides else hint_of(cutouts, settings)
    start_settings = settings.static.start
    assert not isinstance(start_settings, LgmStartSettings), "these fits start without LGM"
    shapes = subject_shapes(settings.prior, [cutouts[0]], hint, sides)
    start = initial_gaussians(start_settings, shapes, generator)
    prior = make_prior(settings.prior, [cutouts[0]], settings.static, None, Path(), hint, sides).prior
    known = known_views(sides) if sides is not None else []
    rest = fit_gaussians(start, cutouts[0], prior, rasterize, settings.static, generator, known=known)
    video, kind = DrivingVideo(cutouts[..., :3].contiguous(), cutouts[..., 3:].contiguous(), 10), settings.prior
    track = None
    if sides and tracks_surface(settings.motion, kind, sides, len(video)):
        track = SurfaceTracker(rest, video, sides, rasterize, generator, settings.motion.trackings)
    prior = make_prior(kind, list(cutouts), settings.motion, None, Path(), hint, sides, track).prior
    field = new_deformation(settings.deformation, rest, len(video), generator)
    deformation = track.hinged.carrying(field, rest) if track and track.hinged else field
    others = still_views(sides, len(video))
    fitted = fit_motion(rest, deformation, video, prior, rasterize, settings.motion, generator, known=others)
    with torch.no_grad():
        return deformation.displace(fitted.means, torch.linspace(0, 1, len(video))).apply(fitted)


def score_fit(subject: Subject, settings: PipelineSettings, sides: Bank | None = None) -> tuple[Figures, Tensor]:
    """Fit as `fit` does; compare views of all frames with the true ones.

    Returns:
        Figures, and unseen views side by side over white: the fit's above the true ones.
    """
    rasterize, moved = get_rasterizer("auto"), fit(subject, settings, sides)
    cutouts, rows, strips = prepared(subject, settings), [], []
    picked = torch.linspace(0, len(cutouts) - 1, SHOWN).round().long()
    with torch.no_grad():
        for azimuth, truth in {0.0: resize(cutouts, (SIZE, SIZE)), **subject.views}.items():
            camera = OrbitCamera(0, azimuth, width=SIZE, height=SIZE)
            renderings = [rasterize(moved.at(frame), [camera], torch.ones(3)) for frame in range(len(cutouts))]
            color = torch.cat([one.color for one in renderings]).clamp(0, 1)
            rows.append(figures(color, torch.cat([one.alpha for one in renderings]), truth[: len(cutouts)]))
            pair = [color[picked], over_white(truth[picked])]
            strips.append(torch.cat([torch.cat([*pictures], 1) for pictures in pair]))
    return {**mean(rows[1:]), "input": rows[0]["psnr"]}, torch.cat(strips[1:], 1)


def figures(
    color: Float[Tensor, "t s s 3"], alpha: Float[Tensor, "t s s 1"], cutouts: Float[Tensor, "t s s 4"]
) -> Figures:
    """Return the metrics of a view without networks, means over frames."""
    truth = ViewFrames(over_white(cutouts), cutouts[..., 3:])
    return compare(ViewFrames(color, alpha), truth, MetricNetworks(WITHOUT_NETWORKS))


def mean(rows: Sequence[Figures]) -> Figures:
    """Return the mean of every figure."""
    return {name: sum(row[name] for row in rows) / len(rows) for name in rows[0]}


def line(name: str, kinds: Mapping[str, Figures]) -> str:
    """Return a row of a Markdown table: a cell per kind."""
    cells = [" / ".join(f"{row[c]:.3f}" for c in COLUMNS if c in row) for row in kinds.values()]
    return f"| {name} | {' | '.join(cells)} |\n"


def write_sheet(path: Path, strips: Sequence[Float[Tensor, "h w 3"]]) -> None:
    """Write strips below each other, at half size."""
    width = max(strip.shape[1] for strip in strips)
    padded = [torch.cat([s, torch.ones(s.shape[0], width - s.shape[1], 3)], 1) for s in strips]
    pixels = (torch.cat(padded).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).reduce(2).save(path)


def _read(frames: Sequence[Path]) -> Float[Tensor, "t h w 4"]:
    return torch.stack([read_png(path) for path in frames])
