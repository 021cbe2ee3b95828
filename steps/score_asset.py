"""An asset against the truth: every metric for every view; or, without an asset, what naive guesses would score."""

import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from dg4d_lib.asset_settings import ScoreSettings
from dg4d_lib.assets.animated import between
from dg4d_lib.assets.formats.glb import read_glb, read_mesh_glb
from dg4d_lib.assets.rendering.preview import write_film
from dg4d_lib.diffusion.components import default_device
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.images import over_background
from dg4d_lib.metrics.clip import ClipModel, cosine_similarity, load_clip
from dg4d_lib.metrics.fvd import MIN_FRAMES, fvd_consistent4d, load_i3d, logits
from dg4d_lib.metrics.image import iou, psnr, resize_square
from dg4d_lib.metrics.lpips import Lpips, load_lpips
from dg4d_lib.metrics.ssim import ssim
from dg4d_lib.metrics.surface import align_bounding_boxes, chamfer_distance, sample_surface
from dg4d_lib.metrics.video import flicker, motion_amount, temporal_error
from steps.artifacts.archives import unpack
from steps.artifacts.ground_truth import Truth, find_truth
from steps.artifacts.media import read_png, write_zip
from steps.artifacts.packages import ASSET, MESHES, read_manifest
from steps.artifacts.rendering import render_package
from steps.profiles import ScoreAssetSettings
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import open_weights

COVERED = 0.5  # coverage from which a pixel belongs to the subject
NEARLY_WHITE = 0.98  # opaque pictures: the subject has a channel below this
FILM_SIZE, FILM_FPS = 256, 12.0  # pixels at most, and frames per second, of the films for people
DIGITS = 6  # of every number

Figures = dict[str, float]
Judgment = dict[str, Any]  # {"input": Figures, "views": {name: Figures}, "mean": Figures, "geometry": Figures}


@dataclass(frozen=True)
class Film:
    """What is seen from one side.

    Attributes:
        color: over white, in [0, 1].
        coverage: alpha in [0, 1].
    """

    color: Float[Tensor, "t s s 3"]
    coverage: Float[Tensor, "t s s 1"]

    def __len__(self) -> int:
        return len(self.color)

    def pick(self, frames: Sequence[int]) -> "Film":
        """These frames of it."""
        chosen = torch.tensor(frames)
        return Film(self.color[chosen], self.coverage[chosen])


@dataclass
class Judges:
    """The networks that are here.

    Attributes:
        missing: for every metric that cannot be computed, why, and what mends it.
        digests: of the weights that were loaded, by file.
    """

    size: int
    device: torch.device
    lpips: Lpips | None = None
    clip: ClipModel | None = None
    i3d: Any = None
    missing: dict[str, str] = field(default_factory=dict)
    digests: dict[str, str] = field(default_factory=dict)


def run(job: Job) -> StepReport:
    """Write the scores of the package, or of the naive guesses where there is none, and a film of every view.

    Raises:
        BadInput: the package or the truth cannot be used.
    """
    settings: ScoreAssetSettings = job.settings
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        truth = find_truth(_unpacked(job.inputs["truth"], scratch / "truth"))
        judges = open_judges(settings.score)
        done: list[int] = []

        def step_on(total: int) -> None:
            done.append(1)
            job.progress(len(done), total, {})

        if "package" in job.inputs:
            package = _unpacked(job.inputs["package"], scratch / "package")
            report, films = _of_package(package, truth, settings, judges, scratch, job.seed, step_on)
        else:
            report, films = _of_guesses(truth, judges, step_on)
        if judges.i3d is not None and report["frames"] < MIN_FRAMES:
            shortage = f"I3D needs films of {MIN_FRAMES} frames or more; these have {report['frames']}"
            judges.missing["fvd_consistent4d"] = shortage
        _write_films(job.outputs["films"], films, scratch)
    job.outputs["scores"].write_text(json.dumps(_rounded({**report, "missing": judges.missing}), allow_nan=False))
    return StepReport(backend=f"{settings.rasterizer} rasterizer", weights=judges.digests)


def open_judges(settings: ScoreSettings) -> Judges:
    """The networks whose weights are here; the others' metrics are named as missing."""
    judges = Judges(settings.size, default_device())

    def load(metric: str, names: Sequence[str], make: Callable[..., Any]) -> Any:
        if not all(names):
            judges.missing[metric] = "its weights are turned off"
            return None
        found, troubles = [], []
        for name in names:
            try:
                found.append(open_weights(name))
            except BackendUnavailable as error:
                troubles.append(str(error))
        if not troubles:
            try:
                network = make(*(weights.folder for weights in found), judges.device)
            except BackendUnavailable as error:
                troubles.append(str(error))
        if troubles:
            judges.missing[metric] = "; ".join(troubles)
            return None
        judges.digests.update({file: digest for weights in found for file, digest in weights.digests.items()})
        return network

    judges.lpips = load("lpips", (settings.vgg_weights, settings.lpips_weights), load_lpips)
    judges.clip = load("clip", (settings.clip_weights,), load_clip)
    judges.i3d = load("fvd_consistent4d", (settings.i3d_weights,), load_i3d)
    return judges


def compare(ours: Film, theirs: Film, judges: Judges) -> Figures:
    """Every metric of one view, means over the frames; those over time where there are two frames or more."""
    seen = ((ours.coverage > COVERED) | (theirs.coverage > COVERED)).float()
    figures = {
        "psnr": float(psnr(ours.color, theirs.color).mean()),
        "psnr_obj": float(psnr(ours.color, theirs.color, seen).mean()),
        "ssim": float(ssim(ours.color, theirs.color).mean()),
        "iou": float(iou(ours.coverage, theirs.coverage, COVERED).mean()),
    }
    if len(theirs) > 1:
        figures["flicker"] = float(flicker(ours.color, theirs.color, seen))
        figures["terr"] = float(temporal_error(ours.color, theirs.color))
        figures["motion"] = float(motion_amount(ours.color, theirs.color))
    if judges.lpips is not None:
        pairs = (resize_square(film.color, judges.size) for film in (ours, theirs))
        figures["lpips"] = float(judges.lpips(*pairs).mean())
    if judges.clip is not None:
        embedded = [judges.clip.embed(resize_square(film.color, judges.size)) for film in (ours, theirs)]
        figures["clip"] = float(cosine_similarity(*embedded).mean())
    if judges.i3d is not None and len(theirs) >= MIN_FRAMES:
        outputs = [logits(judges.i3d, film.color, judges.device) for film in (ours, theirs)]
        figures["fvd_consistent4d"] = float(fvd_consistent4d(*outputs))
    return figures


def _of_package(
    package: Path,
    truth: Truth,
    settings: ScoreAssetSettings,
    judges: Judges,
    scratch: Path,
    seed: int,
    step_on: Callable[[int], None],
) -> tuple[dict[str, Any], dict[str, Film]]:
    given = _read(truth.inputs)
    size, total = given.color.shape[1], len(truth.views) + 2

    def drawn(azimuth_deg: float, frames: int | None) -> Film:
        (view,) = render_package(
            package, (azimuth_deg,), 0.0, size, frames, settings.mesh, scratch / "ours", rasterizer=settings.rasterizer
        )
        film = _read(sorted(view.iterdir()))
        for path in view.iterdir():
            path.unlink()
        return film

    ours = drawn(0.0, len(given) if len(given) > 1 else None)
    films, clips, views = {"input": ours}, {}, {}
    of_input = compare(ours.pick(range(len(given))), given, judges)
    if judges.clip is not None:
        embedded = judges.clip.embed(resize_square(ours.color, judges.size))
        wanted = judges.clip.embed(resize_square(given.color[:1], judges.size))
        of_input["clip_i"] = float(cosine_similarity(embedded, wanted.expand_as(embedded)).mean())
    step_on(total)
    for view in truth.views:
        theirs = _read(view.frames, size)
        films[f"view_{view.name}"] = film = drawn(view.azimuth_deg, len(theirs))
        views[view.name] = compare(film, theirs, judges)
        if judges.i3d is not None and len(film) >= MIN_FRAMES:
            clips[view.name] = logits(judges.i3d, film.color, judges.device).tolist()
        step_on(total)
    judgment: Judgment = {"input": of_input, "views": views, "mean": _mean(views)}
    if truth.mesh is not None:
        judgment["geometry"] = _geometry(package, truth.mesh, settings.score.samples, seed)
    step_on(total)
    return _report(truth, size, {"asset": judgment}, clips), films


def _of_guesses(truth: Truth, judges: Judges, step_on: Callable[[int], None]) -> tuple[dict[str, Any], dict[str, Film]]:
    """What the input itself scores at every view: as a film, and its first frame; and the view's own first frame."""
    given = _read(truth.inputs)
    size = given.color.shape[1]
    films, clips = {"input": given}, {}
    guesses: dict[str, dict[str, Figures]] = {}
    for view in truth.views:
        theirs = _read(view.frames, size)
        films[f"view_{view.name}"] = theirs
        still = [0] * len(theirs)
        tried = {"input_repeated": given} if len(given) == len(theirs) else {}
        tried |= {"input_frozen": given.pick(still), "truth_frozen": theirs.pick(still)}
        for name, film in tried.items():
            guesses.setdefault(name, {})[view.name] = compare(film, theirs, judges)
        if judges.i3d is not None and len(theirs) >= MIN_FRAMES:
            clips[view.name] = logits(judges.i3d, theirs.color, judges.device).tolist()
        step_on(len(truth.views))
    rows = {name: {"views": views, "mean": _mean(views)} for name, views in guesses.items()}
    return _report(truth, size, rows, clips), films


def _report(truth: Truth, size: int, rows: Mapping[str, Judgment], clips: dict[str, list[float]]) -> dict[str, Any]:
    frames = len(truth.views[0].frames) if truth.views else len(truth.inputs)
    opaque = [
        path.parent.name for path in (truth.inputs[0], *(view.frames[0] for view in truth.views)) if _opaque(path)
    ]
    notes = [f"masks of the truth are guessed, its pictures are opaque: {', '.join(opaque)}"] if opaque else []
    return {"frames": frames, "size": size, "rows": dict(rows), "clips": clips, "notes": notes}


def _mean(views: Mapping[str, Figures]) -> Figures:
    names = next(iter(views.values()), {})
    return {name: fmean(figures[name] for figures in views.values()) for name in names}


def _geometry(package: Path, mesh: Path, samples: int, seed: int) -> Figures:
    """The distance of the asset's mesh from the true one, means over frames: as it is, and after one alignment."""
    try:
        with np.load(mesh) as archive:
            vertices = torch.from_numpy(archive["vertices"].astype(np.float32))
            faces = torch.from_numpy(archive["faces"].astype(np.int64))
            weights = torch.from_numpy(archive["face_weight"].astype(np.float32)) if "face_weight" in archive else None
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise BadInput(f"{mesh.name} holds no meshes (vertices [t v 3], faces [f 3]): {error!r}") from error
    generator = torch.Generator().manual_seed(seed)
    theirs = torch.stack([sample_surface(moment, faces, samples, generator, weights) for moment in vertices])
    ours = torch.stack([sample_surface(*moment, samples, generator) for moment in _meshes(package, len(vertices))])
    return {
        name: fmean(chamfer_distance(a, b) for a, b in zip(points, theirs, strict=True))
        for name, points in (("chamfer", ours), ("chamfer_aligned", align_bounding_boxes(ours, theirs)))
    }


def _meshes(package: Path, count: int) -> list[tuple[Tensor, Tensor]]:
    """Vertices and faces at as many moments, from the first to the last frame, as a player shows them."""
    manifest = read_manifest(package)
    positions = torch.arange(count, dtype=torch.float64) * (manifest.frames - 1) / max(1, count - 1)
    if manifest.mode == "per_frame":
        frames = [f"{MESHES}/{frame:03d}.glb" for frame in positions.floor().long().tolist()]
        read = [read_mesh_glb(_content(package, name)) for name in frames]
        return [(mesh.vertices, mesh.faces) for mesh in read]
    asset = read_glb(_content(package, ASSET))
    return [(asset.mesh.vertices + offsets, asset.mesh.faces) for offsets in between(asset.offsets, positions)]


def _content(package: Path, name: str) -> bytes:
    try:
        return (package / name).read_bytes()
    except OSError as error:
        raise BadInput(
            f"the package is not complete: {name} cannot be read ({error.strerror}); make it again"
        ) from error


def _read(frames: Sequence[Path], size: int | None = None) -> Film:
    """Frames over white, all of one square size."""
    pictures = [read_png(path) for path in frames]
    shapes = {(picture.shape[0], picture.shape[1]) for picture in pictures}
    if len(shapes) > 1 or any(height != width or height != (size or height) for height, width in shapes):
        found = ", ".join(f"{width} x {height}" for height, width in sorted(shapes))
        raise BadInput(
            f"the frames of {frames[0].parent.name} must be square and as large as the input's; found {found}"
        )
    cutouts = torch.stack([_cutout(picture) for picture in pictures])
    coverage = cutouts[..., 3:]
    return Film(over_background(cutouts[..., :3], coverage, 1.0), coverage)


def _cutout(picture: Float[Tensor, "h w c"]) -> Float[Tensor, "h w 4"]:
    """With alpha; of an opaque picture the subject is what is not white."""
    if picture.shape[-1] == 4:
        return picture
    color = picture[..., :3].expand(-1, -1, 3)  # of one channel: gray
    return torch.cat([color, (color.amin(-1, keepdim=True) < NEARLY_WHITE).to(color)], -1)


def _opaque(path: Path) -> bool:
    return read_png(path).shape[-1] != 4


def _write_films(path: Path, films: Mapping[str, Film], scratch: Path) -> None:
    entries = []
    for name, film in films.items():
        size = min(FILM_SIZE, film.color.shape[1]) // 2 * 2
        small = F.interpolate(film.color.movedim(-1, 1), (size, size), mode="area").movedim(1, -1)
        write_film(scratch / "film.mp4", small.contiguous(), FILM_FPS)
        entries.append((f"{name}.mp4", (scratch / "film.mp4").read_bytes()))
    write_zip(path, entries)


def _unpacked(archive: Path, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    unpack(archive, folder, "the zip")
    return folder


def _rounded(value: Any) -> Any:
    match value:
        case float():
            return round(value, DIGITS)
        case dict():
            return {name: _rounded(one) for name, one in value.items()}
        case list():
            return [_rounded(one) for one in value]
    return value
