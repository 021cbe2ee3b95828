"""Step that compares an asset, or naive baselines without an asset, with ground truth."""

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from dg4d_lib.asset_settings import ScoreSettings
from dg4d_lib.assets.rendering.preview import write_mp4
from dg4d_lib.diffusion.components import default_device
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.images import over_background
from dg4d_lib.metrics.clip import ClipModel, cosine_similarity, load_clip
from dg4d_lib.metrics.fvd import MIN_FRAMES, fvd_consistent4d, load_i3d, logits
from dg4d_lib.metrics.image import iou, mean_of_shown, psnr, resize_square
from dg4d_lib.metrics.lpips import Lpips, load_lpips
from dg4d_lib.metrics.ssim import ssim
from dg4d_lib.metrics.video import flicker, motion_amount, temporal_error
from steps.artifacts.archives import unpack
from steps.artifacts.ground_truth import GroundTruth, find_ground_truth
from steps.artifacts.media import write_zip
from steps.artifacts.rendering import render_package
from steps.artifacts.surface_scores import actionbench_scores, chamfer_scores, read_true_meshes
from steps.profiles import ScoreAssetSettings
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import open_weights
from steps.sources.clips import sampled_frames
from steps.sources.decode_limit import DecodeLimit
from steps.sources.stills import MOST_PIXELS, StillPicture, read_still

FOREGROUND = 0.5  # alpha from which a pixel belongs to the subject
NEARLY_WHITE = 0.98  # in opaque pictures, the subject has a channel below this
VIDEO_SIZE, VIDEO_FPS = 256, 12.0  # largest side in pixels, and frame rate, of the videos
DIGITS = 6  # decimals of every number

Metrics = dict[str, float]
Scores = dict[str, Any]  # {"input": Metrics, "views": {name: Metrics}, "mean": Metrics, "geometry": Metrics}


@dataclass(frozen=True)
class ViewFrames:
    """Frames of one view.

    Attributes:
        color: colors over white, in [0, 1].
        alpha: alpha in [0, 1].
    """

    color: Float[Tensor, "t s s 3"]
    alpha: Float[Tensor, "t s s 1"]

    def __len__(self) -> int:
        return len(self.color)

    def pick(self, frames: Sequence[int]) -> "ViewFrames":
        """Return the frames of these indices."""
        selected = torch.tensor(frames)
        return ViewFrames(self.color[selected], self.alpha[selected])


class MetricNetworks:
    """Networks of the learned metrics, as far as their weights are installed.

    Attributes:
        missing: reason and remedy for every metric that cannot be computed.
        digests: digests of the loaded weights, by file.
    """

    def __init__(self, settings: ScoreSettings) -> None:
        self.size, self.device = settings.size, default_device()
        self.missing: dict[str, str] = {}
        self.digests: dict[str, str] = {}
        self.lpips: Lpips | None = self._load("lpips", load_lpips, settings.vgg_weights, settings.lpips_weights)
        self.clip: ClipModel | None = self._load("clip", load_clip, settings.clip_weights)
        self.i3d: Any = self._load("fvd_consistent4d", load_i3d, settings.i3d_weights)

    def _load(self, metric: str, make: Callable[..., Any], *names: str) -> Any:
        """Load a network from named weights; None if they are turned off or not installed."""
        if not all(names):
            self.missing[metric] = "its weights are turned off"
            return None
        found, troubles = [], []
        for name in names:
            try:
                found.append(open_weights(name))
            except BackendUnavailable as error:
                troubles.append(str(error))
        try:
            network = None if troubles else make(*(weights.folder for weights in found), self.device)
        except BackendUnavailable as error:
            troubles.append(str(error))
        if troubles:
            self.missing[metric] = "; ".join(troubles)
            return None
        self.digests.update({file: digest for weights in found for file, digest in weights.digests.items()})
        return network

    def i3d_logits(self, frames: ViewFrames) -> Tensor | None:
        """Return I3D's logits; None if it is not installed or the frames are too few."""
        if self.i3d is None or len(frames) < MIN_FRAMES:
            return None
        return logits(self.i3d, frames.color, self.device)


def run(job: Job) -> StepReport:
    """Write the scores of the package, or of naive baselines if there is none, and a video of every view.

    Raises:
        BadInput: the package or the ground truth cannot be used.
    """
    settings: ScoreAssetSettings = job.settings
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        ground_truth = find_ground_truth(_unpacked(job.inputs["truth"], scratch / "truth"))
        networks = MetricNetworks(settings.score)
        if "package" in job.inputs:
            report, videos = _score_package(job, ground_truth, networks, scratch)
        else:
            report, videos = _score_baselines(job, ground_truth, networks)
        if networks.i3d is not None and report["frames"] < MIN_FRAMES:
            shortage = f"I3D needs videos of {MIN_FRAMES} frames or more; these have {report['frames']}"
            networks.missing["fvd_consistent4d"] = shortage
        _write_videos(job.outputs["films"], videos, scratch)
    text = json.dumps({**report, "missing": networks.missing}, allow_nan=False)
    rounded = json.loads(text, parse_float=lambda digits: round(float(digits), DIGITS))
    job.outputs["scores"].write_text(json.dumps(rounded))
    return StepReport(backend=f"{settings.rasterizer} rasterizer", weights=networks.digests)


def compare(ours: ViewFrames, theirs: ViewFrames, networks: MetricNetworks) -> Metrics:
    """Compute every metric of one view as means over frames; those over time need two frames."""
    foreground = ((ours.alpha > FOREGROUND) | (theirs.alpha > FOREGROUND)).float()
    metrics = {
        "psnr": float(psnr(ours.color, theirs.color).mean()),
        "psnr_obj": float(mean_of_shown(psnr(ours.color, theirs.color, foreground), foreground)),
        "ssim": float(ssim(ours.color, theirs.color).mean()),
        "iou": float(iou(ours.alpha, theirs.alpha, FOREGROUND).mean()),
    }
    if len(theirs) > 1:
        metrics["flicker"] = float(flicker(ours.color, theirs.color, foreground))
        metrics["terr"] = float(temporal_error(ours.color, theirs.color))
        metrics["motion"] = float(motion_amount(ours.color, theirs.color))
    pair = [resize_square(frames.color, networks.size) for frames in (ours, theirs)]
    if networks.lpips is not None:
        metrics["lpips"] = float(networks.lpips(*pair).mean())
    if networks.clip is not None:
        metrics["clip"] = float(cosine_similarity(*map(networks.clip.embed, pair)).mean())
    outputs = [networks.i3d_logits(frames) for frames in (ours, theirs)]
    if outputs[0] is not None and outputs[1] is not None:
        metrics["fvd_consistent4d"] = float(fvd_consistent4d(outputs[0], outputs[1]))
    return metrics


def _score_package(
    job: Job, ground_truth: GroundTruth, networks: MetricNetworks, scratch: Path
) -> tuple[dict[str, Any], dict[str, ViewFrames]]:
    settings: ScoreAssetSettings = job.settings
    package = _unpacked(job.inputs["package"], scratch / "package")
    given = _read(ground_truth.inputs)
    size, total = given.color.shape[1], len(ground_truth.views) + 2
    end = 1.0  # share of the input's time at which the last frame of the fit is reached
    if settings.max_frames and len(given) > 1:
        end = sampled_frames(len(given), settings.max_frames)[-1] / (len(given) - 1)

    def render(azimuth_deg: float, frames: int | None) -> ViewFrames:
        (view,), _ = render_package(
            package,
            (azimuth_deg,),
            0.0,
            size,
            frames,
            settings.mesh,
            scratch / "ours",
            rasterizer=settings.rasterizer,
            end=end,
        )
        rendered = _read(sorted(view.iterdir()))
        shutil.rmtree(view)
        return rendered

    ours = render(0.0, len(given) if len(given) > 1 else None)
    videos, clips, views = {"input": ours}, {}, {}
    of_input = compare(ours.pick(range(len(given))), given, networks)
    if networks.clip is not None:
        embedded = networks.clip.embed(resize_square(ours.color, networks.size))
        wanted = networks.clip.embed(resize_square(given.color[:1], networks.size))
        of_input["clip_i"] = float(cosine_similarity(embedded, wanted.expand_as(embedded)).mean())
    job.progress(1, total, {})
    for done, view in enumerate(ground_truth.views, 2):
        theirs = _read(view.frames, size)
        videos[f"view_{view.name}"] = rendered = render(view.azimuth_deg, len(theirs))
        views[view.name] = compare(rendered, theirs, networks)
        clips[view.name] = networks.i3d_logits(rendered)
        job.progress(done, total, {})
    scores: Scores = {"input": of_input, "views": views, "mean": _mean(views)}
    if ground_truth.mesh is not None:
        scores["geometry"] = _geometry(package, ground_truth.mesh, settings, job.seed, networks, end)
    job.progress(total, total, {})
    return _report(ground_truth, size, {"asset": scores}, clips), videos


def _score_baselines(
    job: Job, ground_truth: GroundTruth, networks: MetricNetworks
) -> tuple[dict[str, Any], dict[str, ViewFrames]]:
    """Score three baselines per view: the input's frames, its first frame, and the first frame of the true view."""
    given = _read(ground_truth.inputs)
    size = given.color.shape[1]
    videos, clips = {"input": given}, {}
    baselines: dict[str, dict[str, Metrics]] = {}
    for done, view in enumerate(ground_truth.views, 1):
        theirs = _read(view.frames, size)
        videos[f"view_{view.name}"] = theirs
        still = [0] * len(theirs)
        tried = {"input_repeated": given} if len(given) == len(theirs) else {}
        tried |= {"input_frozen": given.pick(still), "truth_frozen": theirs.pick(still)}
        for name, frames in tried.items():
            baselines.setdefault(name, {})[view.name] = compare(frames, theirs, networks)
        clips[view.name] = networks.i3d_logits(theirs)
        job.progress(done, len(ground_truth.views), {})
    rows = {name: {"views": views, "mean": _mean(views)} for name, views in baselines.items()}
    return _report(ground_truth, size, rows, clips), videos


def _report(
    ground_truth: GroundTruth, size: int, rows: Mapping[str, Scores], clips: Mapping[str, Tensor | None]
) -> dict[str, Any]:
    """Return the `scores` artifact; `clips` are I3D's logits by view."""
    frames = len(ground_truth.views[0].frames) if ground_truth.views else len(ground_truth.inputs)
    first = (ground_truth.inputs[0], *(view.frames[0] for view in ground_truth.views))
    opaque = [path.parent.name for path in first if not _decode(path).has_alpha]
    notes = (
        [f"ground-truth masks are estimated, because these pictures are opaque: {', '.join(opaque)}"] if opaque else []
    )
    features = {name: clip.tolist() for name, clip in clips.items() if clip is not None}
    return {"frames": frames, "size": size, "rows": dict(rows), "clips": features, "notes": notes}


def _mean(views: Mapping[str, Metrics]) -> Metrics:
    names = next(iter(views.values()), {})
    return {name: fmean(metrics[name] for metrics in views.values()) for name in names}


def _geometry(
    package: Path, mesh: Path, settings: ScoreAssetSettings, seed: int, networks: MetricNetworks, end: float
) -> Metrics:
    """Return chamfer distances to the true mesh, and ActionBench's if they are wanted."""
    meshes, score = read_true_meshes(mesh), settings.score
    metrics = chamfer_scores(package, meshes, score.samples, seed, end)
    if settings.actionbench:
        found, reason = actionbench_scores(package, meshes, score.actionbench_points, score.icp_points, seed, end)
        metrics |= found
        if reason:
            networks.missing["cd_m"] = reason
    return metrics


def _read(frames: Sequence[Path], size: int | None = None) -> ViewFrames:
    """Read frames over white, all of one square size: the first one's if `size` is None."""
    cutouts = [_cutout(_decode(path)) for path in frames]
    shapes = {(cutout.shape[0], cutout.shape[1]) for cutout in cutouts}
    if len(shapes) > 1 or any(height != width or height != (size or height) for height, width in shapes):
        wanted = "square and of one size" if size is None else f"{size} x {size}, as those of the input"
        found = ", ".join(f"{width} x {height}" for height, width in sorted(shapes))
        raise BadInput(f"the frames of {frames[0].parent.name} must be {wanted}; found {found}")
    pictures = torch.stack(cutouts)
    alpha = pictures[..., 3:]
    return ViewFrames(over_background(pictures[..., :3], alpha, 1.0), alpha)


def _decode(path: Path) -> StillPicture:
    """Decode a frame like an input picture, upright, but at full size."""
    return read_still(path, f"{path.parent.name}/{path.name}", DecodeLimit(math.inf), MOST_PIXELS)


def _cutout(picture: StillPicture) -> Float[Tensor, "h w 4"]:
    """Return a picture with alpha; in an opaque one, everything but white is the subject."""
    if picture.has_alpha:
        return picture.pixels
    color = picture.pixels[..., :3]
    return torch.cat([color, (color.amin(-1, keepdim=True) < NEARLY_WHITE).to(color)], -1)


def _write_videos(path: Path, videos: Mapping[str, ViewFrames], scratch: Path) -> None:
    entries = []
    for name, video in videos.items():
        size = min(VIDEO_SIZE, video.color.shape[1]) // 2 * 2
        small = F.interpolate(video.color.movedim(-1, 1), (size, size), mode="area").movedim(1, -1)
        write_mp4(scratch / "video.mp4", small.contiguous(), VIDEO_FPS)
        entries.append((f"{name}.mp4", (scratch / "video.mp4").read_bytes()))
    write_zip(path, entries)


def _unpacked(archive: Path, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    unpack(archive, folder, "the zip")
    return folder
