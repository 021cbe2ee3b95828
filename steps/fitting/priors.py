"""Guidance priors of the fits, from settings and files."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.cameras.viewpoints import spread_orbit
from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.components import default_device
from dg4d_lib.diffusion.depth import DepthEstimator
from dg4d_lib.diffusion.pipelines import is_flow_matching
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.static import RADIUS_JITTER
from dg4d_lib.geometry.mirror import mirror_normal
from dg4d_lib.guidance.analytic import AnalyticPrior
from dg4d_lib.guidance.carried import MOST_STRAIN, CarriedFields
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.geometric import InflatedSurfaces
from dg4d_lib.guidance.imagedream import ImageDream, ImageDreamPrior
from dg4d_lib.guidance.interface import GuidancePrior, SubjectShapes
from dg4d_lib.guidance.kept_views import KeptViews
from dg4d_lib.guidance.known import KnownShapes
from dg4d_lib.guidance.learned import LearnedShapes
from dg4d_lib.guidance.mixed import MixedShapes
from dg4d_lib.guidance.oracle import Bank, perturb
from dg4d_lib.guidance.zero123 import Zero123
from dg4d_lib.images import over_white
from dg4d_lib.inflation.hints import NO_HINT, DepthHint
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.kernels.workers import torch_on_one_thread
from dg4d_lib.settings import (
    FitSettings,
    GeometricPriorSettings,
    ImageDreamPriorSettings,
    LearnedPriorSettings,
    OraclePriorSettings,
    PriorSettings,
    StaticSettings,
    Zero123PriorSettings,
)
from dg4d_lib.shape_prior import packaged
from dg4d_lib.shape_prior.field import Fields, InflatedFields, ShapeField, ShapeFields
from dg4d_lib.visual_hull.frustum_field import known_field
from dg4d_lib.visual_hull.known import KnownView, known_view, shows_sides
from dg4d_lib.visual_hull.shape import known_volume
from dg4d_lib.visual_hull.surface import colored_surface
from dg4d_lib.weights.registry import KNOWN
from steps.artifacts.archives import unpack
from steps.artifacts.depth_fields import read_depth_field
from steps.artifacts.media import read_png
from steps.artifacts.pose import read_turn
from steps.profiles import flow_matching_refusal, variant_refusal
from steps.runtime.job import StepReport
from steps.runtime.weights import LocatedWeights, open_weights
from steps.sources.banks import BANK_JSON, BankIndex, check_sheet, read_index

GEOMETRIC_NOTE = (
    "prior: inflation of the silhouette, without a network; sides that the picture does not show are guesses"
)
LEARNED_NOTE = "prior: shape network trained on synthetic shapes; sides that the picture does not show are guesses"
DEPTH_NOTE = "prior: inflation of the silhouette, with the relief of an estimated depth: weights"
SMALLEST_NOTED = 0.05  # share of the inflation from which the report mentions it
GUESS_WEIGHT = 0.5  # of frames whose other sides are a guess, beside frames with known views
NETWORK_TRUST = 4 / 3  # factor on the yaw: the network's own estimate counteracts it
CARRIED_SHARE = 0.3  # of shapes that optical flow carries, beside a tracked hull of which no picture shows the sides
CARRIED_CONTRAST = 2.0  # of shapes that a known first frame has made sure already
STABLE_UNET = KNOWN["stable-zero123"].published["unet/diffusion_pytorch_model.safetensors"]  # sha256
ORACLE_NOTE = "prior: ground-truth views of a bank; for tests and benchmarks only"


Track = Callable[[InflatedSurface], SubjectShapes]  # surface of the first frame to the shapes of all frames


@dataclass(frozen=True)
class LoadedPrior:
    """A guidance prior with its provenance.

    Attributes:
        prior: guidance prior.
        note: sentence for the report.
        opened: weights; None for priors without a model.
        batches: micro-batches, which shrink when memory runs out.
        shapes: shapes behind the prior; None for models of pictures and for the oracle.
        network: shapes by the shape network, for all frames or those without known views; None: there are none.
    """

    prior: GuidancePrior
    note: str
    opened: LocatedWeights | None = None
    batches: MicroBatches | None = None
    shapes: SubjectShapes | None = None
    network: LearnedShapes | None = None

    def threads(self) -> AbstractContextManager[None]:
        """Return the context of a fit: without a model, all operators of torch are small."""
        return nullcontext() if self.opened else torch_on_one_thread()

    def report(self, backend: str) -> StepReport:
        """Return the report of a step that has used this prior."""
        run_notes = self.batches.notes() if self.batches else ()
        weights, licenses = (self.opened.digests, self.opened.licenses) if self.opened else ({}, {})
        notes: tuple[str, ...] = (self.note,)
        carves = isinstance(self.shapes, KnownShapes) and self.shapes.has_predictions  # the network, a visual hull
        if self.network is not None or carves:
            weights = packaged.digests()
        if self.network is not None:
            share = self.network.inflated_share
            notes = (self.note, inflated_note(share)) if share >= SMALLEST_NOTED else notes
        return StepReport(backend, weights, licenses, notes=notes, run_notes=run_notes)


def make_prior(
    settings: PriorSettings,
    cutouts: Sequence[Float[Tensor, "h w 4"]],
    stage: FitSettings,
    bank: Path | None,
    scratch: Path,
    hint: DepthHint = NO_HINT,
    sides: Bank | None = None,
    track: Track | None = None,
) -> LoadedPrior:
    """Make the guidance prior of a stage.

    Args:
        settings: kind of prior and its settings.
        cutouts: subject at every frame, one in the static stage.
        stage: settings of the fit, which give the timesteps.
        bank: zip of ground-truth views, for the oracle.
        scratch: folder for unpacking.
        hint: at the depth of the subject; see `subject_hint`.
        sides: views of other sides that the user gave; priors with shapes take them as their own.
        track: moves their surface through the video; see `subject_shapes`.

    Raises:
        BadInput: the oracle has no bank, or the weights are damaged or of another model.
        BackendUnavailable: weights or libraries are not installed.
    """
    noise = TimestepSchedule(
        stage.t_max_start, stage.t_max_end, stage.t_max_limit, uniform=stage.noise_draw == "uniform"
    )
    match settings:
        case GeometricPriorSettings() | LearnedPriorSettings():
            shapes = subject_shapes(settings, cutouts, hint, sides, track)
            note, weight, opened = GEOMETRIC_NOTE, 1.0, None
            clean, viewpoints = shapes.clean, None
            if stage.viewpoints:
                clean, viewpoints = KeptViews(shapes.clean).clean, kept_viewpoints(stage)
            guided = settings.weight if isinstance(settings, LearnedPriorSettings) else GUESS_WEIGHT
            if isinstance(shapes, KnownShapes):
                frames = None if 0 in shapes.frames else shapes.frames
                weights = dict.fromkeys(shapes.frames, 1.0)
                prior = AnalyticPrior(clean, noise, viewpoints, frames, 1.0 if track else guided, weights)
                network = _network(shapes.guess, settings)
                return LoadedPrior(prior, known_note(sides, shapes.has_predictions), shapes=shapes, network=network)
            if isinstance(settings, LearnedPriorSettings):
                note, weight = LEARNED_NOTE, guided
            elif settings.depth_weights and not hint.sigma:
                note, opened = f"{DEPTH_NOTE} {settings.depth_weights}", open_weights(settings.depth_weights)
            prior, network = AnalyticPrior(clean, noise, viewpoints, weight=weight), _network(shapes, settings)
            return LoadedPrior(prior, note, opened, shapes=shapes, network=network)
        case OraclePriorSettings():
            if bank is None:
                raise BadInput("prior.kind = oracle needs ground-truth views: give --bank FOLDER (with a bank.json)")
            return LoadedPrior(make_oracle_prior(read_bank(bank, scratch), settings, noise), ORACLE_NOTE)
        case Zero123PriorSettings():
            opened = open_zero123("prior", settings)
            known = Zero123.load(opened.folder, settings, default_device()).conditioned_on(_pictures(cutouts), noise)
            return LoadedPrior(known, f"prior: Zero-1-to-3, weights {settings.weights}", opened, known.batches)
        case ImageDreamPriorSettings():
            opened = _open_noise_predictor("prior", settings.weights)
            model = ImageDream.load(opened.folder, settings.precision, default_device())
            dream = ImageDreamPrior(model, model.conditioned_on(_pictures(cutouts)), noise, settings)
            return LoadedPrior(dream, f"prior: ImageDream, weights {settings.weights}", opened, dream.batches)


def subject_shapes(
    settings: PriorSettings,
    cutouts: Sequence[Float[Tensor, "h w 4"]],
    hint: DepthHint = NO_HINT,
    sides: Bank | None = None,
    track: Track | None = None,
) -> SubjectShapes:
    """Return the shapes behind a prior, by default inflated ones.

    Args:
        settings: of the prior; one that has no shapes of its own gets the inflation with its defaults.
        cutouts: the subject at every frame.
        hint: at its depth; see `subject_hint`. A depth picture goes before an estimate by `prior.depth_weights`.
        sides: views of other sides; their hull replaces the shapes of their frames.
        track: moves the surface of known views of the first frame; None: optical flow carries its shape along. If no
            view shows the sides, the mean of the tracked and the carried shapes is returned.
    """
    others = known_by_frame(sides, len(cutouts))
    known = {frame: [known_view(cutouts[frame]), *views] for frame, views in others.items()}
    predict = _predicted_logits if isinstance(settings, LearnedPriorSettings) else None
    shapes: SubjectShapes
    surfaces = {}
    if 0 in known and len(cutouts) > 1:
        volume = known_volume(known[0], predict)
        surfaces[0] = colored_surface(volume, known[0])
        tracked = track(surfaces[0]) if track else None
        if tracked and shows_sides([view.camera for view in known[0]]):
            shapes = tracked
        else:
            first = known_field(known[0], volume, surfaces[0])
            normal = mirror_normal(surfaces[0].vertices.double().numpy())
            shapes = _carried_shapes(settings, cutouts, hint, first, normal)
            if tracked:
                shapes = MixedShapes([tracked, shapes], [1 - CARRIED_SHARE, CARRIED_SHARE])
    elif isinstance(settings, LearnedPriorSettings):
        shapes = LearnedShapes(learned_fields(cutouts, hint), settings)
    else:
        own = settings if isinstance(settings, GeometricPriorSettings) else GeometricPriorSettings()
        depth = None
        if own.depth_weights and sides is None and not hint.sigma:
            depth = DepthEstimator.load(open_weights(own.depth_weights).folder, default_device())
        shapes = InflatedSurfaces(cutouts, own, hint, depth)
    return KnownShapes(shapes, known, predict, surfaces) if sides else shapes


def _predicted_logits(cutout: Float[Tensor, "h w 4"]) -> Float[Tensor, "128 128 64"]:
    """Return the log-odds of matter that the shape network predicts behind one picture."""
    return ShapeFields(packaged.packaged_network(), [cutout]).logits(0)


def _carried_shapes(
    settings: PriorSettings,
    cutouts: Sequence[Float[Tensor, "h w 4"]],
    hint: DepthHint,
    first: ShapeField,
    normal: Float[np.ndarray, " 3"] | None,
) -> LearnedShapes:
    """Return the shapes of later frames from that of the first one, the normal of its mirror plane and own guesses."""
    guess: Fields = InflatedFields(cutouts)
    if isinstance(settings, LearnedPriorSettings):
        guess = ShapeFields(packaged.packaged_network(), cutouts, hint)
    carried = CarriedFields(guess, first, cutouts, normal=normal)
    return LearnedShapes(carried, LearnedPriorSettings(contrast=CARRIED_CONTRAST))


def learned_fields(cutouts: Sequence[Float[Tensor, "h w 4"]], hint: DepthHint) -> Fields:
    """Return the shape network's field for every frame; the optical flow carries that of the first frame along."""
    fields = ShapeFields(packaged.packaged_network(), cutouts, hint)
    return CarriedFields(fields, None, cutouts, MOST_STRAIN) if len(cutouts) > 1 else fields


def _network(shapes: SubjectShapes, settings: PriorSettings) -> LearnedShapes | None:
    """Return the shapes if the shape network predicts them."""
    shapes = shapes.guesses[-1] if isinstance(shapes, MixedShapes) else shapes
    return shapes if isinstance(settings, LearnedPriorSettings) and isinstance(shapes, LearnedShapes) else None


def kept_viewpoints(stage: FitSettings) -> tuple[OrbitCamera, ...]:
    """Return the cameras that random views of a stage are drawn from, over the ranges of all its random views."""
    jitter = RADIUS_JITTER if isinstance(stage, StaticSettings) else 0.0
    return spread_orbit(
        stage.viewpoints,
        elevation_deg=(-stage.elevation_deg, stage.elevation_deg),
        radius=(RADIUS - jitter, RADIUS + jitter),
    )


def known_views(bank: Bank, frame: int = 0) -> list[KnownView]:
    """Return the views of a frame in a bank."""
    column = bank.frames.index(frame)
    pictures = bank.pictures[:, column].float() / 255
    weights = bank.weights or (1.0,) * len(bank.cameras)
    known = zip(bank.cameras, pictures, weights, strict=True)
    return [KnownView(camera, picture, weight=weight) for camera, picture, weight in known]


def known_by_frame(bank: Bank | None, frames: int) -> dict[int, list[KnownView]]:
    """Return the views in a bank, if any, by frame of a video of some frames."""
    return {frame: known_views(bank, frame) for frame in bank.frames if frame < frames} if bank is not None else {}


def still_views(bank: Bank | None, frames: int) -> dict[int, list[KnownView]]:
    """Return the views in a bank, by frame, if they show a single frame of a video of several.

    Videos of other sides would draw the motion fit away from the input: one picture per iteration is a noisy sample.
    """
    return known_by_frame(bank, frames) if bank is not None and len(bank.frames) == 1 else {}


def known_note(bank: Bank | None, has_predictions: bool) -> str:
    """Return the sentence about known views, and about the shape network if its predictions count."""
    count = len(bank.cameras) if bank is not None else 0
    network = ", minus cells that the shape network finds improbable" if has_predictions else ""
    return f"prior: visual hull of {count + 1} views{network}; surfaces that no view shows are guesses"


def subject_hint(settings: PriorSettings, pose: Path | None, field: Path | None, turn_deg: float) -> DepthHint:
    """Return what is known about the depth of the subject, for a prior.

    Args:
        settings: of the prior.
        pose: turn that the footage shows; views of other sides make it needless.
        field: depth by the user.
        turn_deg: turn by the user, which goes before that of the footage; 0: not known.
    """
    return DepthHint(turn_deg or usable_turn(settings, read_turn(pose)), read_depth_field(field) if field else None)


def usable_turn(settings: PriorSettings, shown_deg: float | None) -> float | None:
    """Return the yaw that a prior should use, degrees; None if the video shows none.

    The inflation takes it as it is. For the shape network it is evidence beside what the network sees itself.
    """
    if shown_deg is None or not isinstance(settings, LearnedPriorSettings):
        return shown_deg
    return shown_deg * NETWORK_TRUST


def inflated_note(share: float) -> str:
    """Return the sentence about a shape network that is unsure."""
    return f"the shape network is unsure of this subject: {share:.0%} of its shape is the inflated silhouette"


def make_oracle_prior(bank: Bank, settings: OraclePriorSettings, noise: TimestepSchedule) -> AnalyticPrior:
    """Make a prior from a view bank, which the settings may perturb; the perturbation has a fixed seed."""
    known = perturb(bank, settings, torch.Generator().manual_seed(0))
    return AnalyticPrior(known.clean, noise, known.cameras, known.frames)


def _pictures(cutouts: Sequence[Float[Tensor, "h w 4"]]) -> Float[Tensor, "t h w 3"]:
    return over_white(torch.stack(list(cutouts)))


def open_zero123(owner: str, settings: Zero123PriorSettings) -> LocatedWeights:
    """Return installed weights of Zero-1-to-3; a copy of Stable-Zero123 is known by the digest of its UNet.

    Args:
        owner: section of the settings, for messages.
        settings: name and variant of the weights.

    Raises:
        BadInput: a model of flow matching, Stable-Zero123 as another variant, or an unknown name.
        BackendUnavailable: the weights are not installed.
    """
    opened = _open_noise_predictor(owner, settings.weights)
    if f"sha256:{STABLE_UNET}" in opened.digests.values() and settings.variant != "stable":
        raise BadInput(variant_refusal(owner, settings, "stable"))
    return opened


def _open_noise_predictor(owner: str, name: str) -> LocatedWeights:
    """Open installed weights; refuse flow-matching models, which do not predict noise."""
    opened = open_weights(name)
    if is_flow_matching(opened.folder):
        raise BadInput(flow_matching_refusal(owner, name))
    return opened


def read_known_views(path: Path | None, scratch: Path) -> Bank | None:
    """Read the views of other sides that the user gave; None without; `scratch` is for unpacking."""
    if path is None:
        return None
    folder = scratch / "known_views"
    folder.mkdir()
    return read_bank(path, folder)


def read_bank(path: Path, scratch: Path) -> Bank:
    """Read the view bank in a zip; see `read_bank_folder`.

    Raises:
        BadInput: the zip has no bank.json, or is unsafe to unpack.
    """
    if BANK_JSON not in unpack(path, scratch, "the bank"):
        raise BadInput(f"the bank has no {BANK_JSON}")
    return read_bank_folder(scratch)


def read_bank_folder(folder: Path) -> Bank:
    """Read the view bank in a folder: `bank.json` (`steps.sources.banks.BankIndex`) and one sheet of tiles per view.

    Raises:
        BadInput: `bank.json` or a sheet is missing, broken or of another form.
    """
    index = read_index(folder / BANK_JSON)
    size, count = index.tile_size, len(index.frames)
    cameras = tuple(
        OrbitCamera(view.elevation, view.azimuth, view.radius, width=size, height=size) for view in index.views
    )
    tiles = torch.empty(len(cameras), count, size, size, 4, dtype=torch.uint8)
    for row, view in enumerate(index.views):
        tiles[row] = _tiles(folder / view.file, index)[:count]
    return Bank(cameras, index.frames, tiles, tuple(view.weight for view in index.views))


def _tiles(path: Path, index: BankIndex) -> UInt8[Tensor, "n s s 4"]:
    """Decode a sheet and split it into its tiles, row by row."""
    if not path.is_file():
        raise BadInput(f"{BANK_JSON} names {path.name}, which is not in the bank")
    check_sheet(path, index)
    sheet = read_png(path)
    if sheet.shape[-1] != 4:
        raise BadInput(
            f"the sheet {path.name} of the bank has {sheet.shape[-1]} channels; export it as PNG with color and alpha"
        )
    (rows, columns), size = index.tile, index.tile_size
    pixels = sheet.mul_(255).round_().to(torch.uint8)
    return pixels.reshape(rows, size, columns, size, 4).transpose(1, 2).reshape(rows * columns, size, size, 4)
