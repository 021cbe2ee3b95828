"""Step that turns pictures of other sides, a turntable or known cameras into a bank of views beside the input."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import over_white
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.video.subject import PreparedSubject, Segmenter, prepare_subject
from dg4d_lib.visual_hull.adjusting import brightened, exposure_gains, match_scale, scaling_between
from dg4d_lib.visual_hull.agreement import Agreement, agreement, hull_alpha, smaller, turntable_score
from dg4d_lib.visual_hull.known import KnownView, angle_deg, known_view
from steps.artifacts.archives import unpack
from steps.artifacts.media import read_frames, read_png, write_png
from steps.runtime.job import Job, StepReport
from steps.sources.bank_writer import write_bank
from steps.sources.clips import sampled_frames
from steps.sources.masks import read_mask, scaled_box
from steps.sources.networks import LoadedNetwork, open_network
from steps.sources.placing import place_pictures
from steps.sources.reader import Source, read_source
from steps.sources.views import CLOSE_DEG, GivenView, GivenViews, read_views

TURNTABLE_FRAMES = 24  # largest number of used frames of a turntable
FEWEST_FRAMES = 8  # least number of frames of a turntable
LARGEST_CROP = 2048  # pixels of a side of the picture of a known camera, cropped to the subject
STILL = 0.004  # largest mean difference of a turntable's frames from its first, in [0, 1]: below, nothing turns
OPEN_SHARE = 3.0  # difference of last and first frame, in largest steps between frames: above, the turn is not whole
LEAST_FILLED = 0.78  # share of a silhouette that the hull of all fills: below, a view is not of this subject
RELIABLE = 0.9  # mean share from which colors of the hull's surface are compared
FEW = 4  # views; among more, thin parts seen edge-on fill little of single silhouettes
LEAST_MEAN = 0.6  # mean share of many silhouettes, likewise
GOOD = 0.95  # mean share from which pictures are taken to have the scale of the input
INPUT, TURNTABLE = "the input", "--turntable"  # names for messages
ViewsByFrame = list[list[KnownView]]  # views by frame


def run(job: Job) -> StepReport:
    """Write the bank of known views, and a picture of them beside their visual hull.

    Raises:
        BadInput: a view is not of the subject, or a file cannot be used.
    """
    settings: SubjectSettings = job.settings.subject
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        inputs = _input_frames(job, folder / "footage")
        unpack(job.inputs["views"], folder / "views", "the zip of views")
        given = read_views(folder / "views")
        job.progress(1, 3, {})
        network = open_network(settings.matting)
        known = _Reader(folder / "views", settings, inputs, job.inputs, network.segmenter)
        views_by_frame, notes = known.turntable(given) if given.turntable else known.views(given)
    job.progress(2, 3, {})
    first = [known_view(inputs[0], name=INPUT), *views_by_frame[0]]
    picture = picture_of(first)
    found = agreement(first)
    try:
        notes = (*notes, *judge(first, found))
    except BadInput:
        write_png(job.pictures / "views.png", picture)
        raise
    write_png(job.outputs["picture"], picture)
    if found.mean > RELIABLE:
        gains = exposure_gains(first)[1:]
        notes = (*notes, *exposure_notes(views_by_frame[0], gains))
        views_by_frame = [[brightened(*pair) for pair in zip(views, gains, strict=True)] for views in views_by_frame]
    write_bank(job.outputs["known_views"], views_by_frame, job.pictures)
    job.progress(3, 3, {})
    used = network if known.used_network else LoadedNetwork()
    return StepReport(weights=used.digests, licenses=used.licenses, notes=notes)


class _Reader:
    """Reader of the pictures beside an input.

    Args:
        folder: with the files of `views.json`.
        settings: of the input, which all pictures share but for the box.
        inputs: frames of the input, cut out.
        files: of the input: `source`, and `mask` if there is one.
        segmenter: network for opaque pictures.

    Attributes:
        used_network: True if a picture was cut out by the network.
    """

    def __init__(
        self,
        folder: Path,
        settings: SubjectSettings,
        inputs: Float[Tensor, "t s s 4"],
        files: Mapping[str, Path],
        segmenter: Segmenter,
    ) -> None:
        self.folder, self.inputs, self.files, self.segmenter = folder, inputs, files, segmenter
        self.settings, self.box = settings.model_copy(update={"box": ()}), settings.box
        self.used_network = False

    def views(self, given: GivenViews) -> tuple[ViewsByFrame, tuple[str, ...]]:
        """Return the views of pictures and of videos beside the input's."""
        sources = [self._read(view.file, view.name) for view in given.views]
        moving = [source.kind == "video" for source in sources]
        if any(moving) and not given.input_camera:
            name = given.views[moving.index(True)].name
            raise BadInput(f"{name} is a video; --view takes pictures: give videos of other sides with --cameras")
        if all(moving):
            return self._video_views(given, sources)
        if any(moving):
            raise BadInput("--cameras mixes pictures and videos; give only pictures or only videos")
        if given.input_camera is not None:
            placed = self._placed(given, sources, self._source(), self.inputs[:1])
            return [[frames[0] for frames in placed]], ()
        prepared = [self._cut(source, view.name) for source, view in zip(sources, given.views, strict=True)]
        return [self._scaled(given.views, [each.frames[0] for each in prepared])], tuple(
            dict.fromkeys(note for each in prepared for note in each.notes)
        )

    def turntable(self, given: GivenViews) -> tuple[ViewsByFrame, tuple[str, ...]]:
        """Return the views of a turntable in the direction that fits better, and those of pictures beside it."""
        source = self._read(given.turntable, TURNTABLE, TURNTABLE_FRAMES)
        check_turn(source)
        places = sampled_frames(source.count, TURNTABLE_FRAMES)
        prepared = self._cut(source, TURNTABLE)
        notes, angles = prepared.notes, [360 * place / source.count for place in places]
        views = self._turntable_sides(prepared.frames, angles)
        if given.views:
            (more,), other_notes = self.views(given)
            alone = [v for v in views if all(angle_deg(v.camera, own.camera) > CLOSE_DEG for own in more)]
            views, notes = [*alone, *more], (*notes, *other_notes)
        return [views], notes

    def _video_views(self, given: GivenViews, sources: Sequence[Source]) -> tuple[ViewsByFrame, tuple[str, ...]]:
        """Return the views of synchronized videos by frame."""
        own = self._source()
        for view, source in zip(given.views, sources, strict=True):
            if source.count != own.count:
                raise BadInput(
                    f"{view.name} has {source.count} frames and the input {own.count}; synchronized videos must have "
                    "equally many"
                )
        placed = self._placed(given, sources, own, self.inputs)
        return [[view[frame] for view in placed] for frame in range(len(self.inputs))], ()

    def _placed(
        self, given: GivenViews, sources: Sequence[Source], own: Source, inputs: Float[Tensor, "t s s 4"]
    ) -> list[list[KnownView]]:
        """Return the views of known cameras by frame, with the input cut out as it was framed: by its mask and box."""
        first, mask = replace(own, frames=own.frames[:1]), None
        if "mask" in self.files:
            mask = read_mask(self.files["mask"], own, self.folder, self._most, self.settings.max_decode_gb)[:1]
        settings = self.settings.model_copy(update={"box": scaled_box(self.box, own)})
        return place_pictures(given, sources, own, self._cut(first, INPUT, settings, mask), inputs, self._cut_close)

    @property
    def _most(self) -> int:
        """Largest number of frames that are read of a video."""
        return max(2, len(self.inputs))

    def _source(self) -> Source:
        """Return the decoded input."""
        return read_source(self.files["source"], self.folder, self._most, self.settings.max_decode_gb)

    def _read(self, file: str, name: str, frames: int = 0) -> Source:
        try:
            return read_source(self.folder / file, self.folder, frames or self._most, self.settings.max_decode_gb)
        except BadInput as error:
            raise BadInput(f"{name}: {error}") from error

    def _cut(
        self,
        source: Source,
        name: str,
        settings: SubjectSettings | None = None,
        mask: Float[Tensor, "t h w"] | None = None,
    ) -> PreparedSubject:
        """Cut out the subject of a file with a name for messages, by default framed as the input."""
        settings = settings or self.settings
        try:
            prepared = prepare_subject(source.frames, source.has_alpha, settings, mask, self.segmenter)
        except BadInput as error:
            raise BadInput(f"{name}: {error}") from error
        self.used_network |= prepared.estimate is not None and prepared.estimate.used_network
        return prepared

    def _cut_close(self, source: Source, name: str, size: int) -> PreparedSubject:
        """Cut out the subject, cropped to it in squares of at most so many pixels a side."""
        size = min(LARGEST_CROP, size)
        return self._cut(source, name, SubjectSettings(size=size, framing="center", matting=self.settings.matting))

    def _scaled(self, given: Sequence[GivenView], cutouts: Sequence[Float[Tensor, "s s 4"]]) -> list[KnownView]:
        """Return views in the scale of the input: as they are, or with its height, whichever agrees better."""
        heights = [match_scale(cut, self.inputs[0], view.azimuth) for view, cut in zip(given, cutouts, strict=True)]
        front = known_view(self.inputs[0], name=INPUT)
        as_given, matched = (
            [known_view(cut, v.azimuth, v.elevation, v.name) for v, cut in zip(given, cuts, strict=True)]
            for cuts in (cutouts, heights)
        )
        unchanged = agreement([front, *as_given]).mean
        if unchanged > GOOD or unchanged >= agreement([front, *matched]).mean:
            return as_given
        return matched

    def _turntable_sides(self, cutouts: Float[Tensor, "t s s 4"], angles: Sequence[float]) -> list[KnownView]:
        """Return the views of a turntable without its front, in the direction that fits better."""
        scaling = scaling_between(cutouts[0], self.inputs[0])
        views = []
        for angle, cutout in list(zip(angles, cutouts, strict=True))[1:]:
            picture = cutout if scaling.is_small else scaling.apply(cutout, angle, self.inputs.shape[1])
            views.append(known_view(picture, angle, name=f"turntable at {angle:.0f} degrees"))
        return orient_turntable(known_view(self.inputs[0], name=INPUT), views)


def check_turn(source: Source) -> None:
    """Refuse a turntable that is a picture, too short, still, or not closed.

    Raises:
        BadInput: names the defect.
    """
    if source.kind != "video" or source.count < FEWEST_FRAMES:
        raise BadInput(
            f"{TURNTABLE} has {source.count} frame{'s' * (source.count != 1)}; give a video, or a folder of frames, of "
            f"one whole turn with {FEWEST_FRAMES} or more"
        )
    color = over_white(source.frames)
    from_first = (color - color[:1]).abs().mean((1, 2, 3))
    steps = color.diff(dim=0).abs().mean((1, 2, 3))
    if float(from_first.max()) < STILL:
        raise BadInput(f"{TURNTABLE} shows no turn: its frames are alike; record the still subject, turned once")
    before, last = sampled_frames(source.count, TURNTABLE_FRAMES)[-2:]
    if float(from_first[-1]) > OPEN_SHARE * max(float(steps.max()), float(steps[-1]) / (last - before)):
        raise BadInput(
            f"{TURNTABLE} is not a whole turn: its last frame is unlike its first; record one turn, and cut right "
            "before the first picture repeats"
        )


def orient_turntable(front: KnownView, views: Sequence[KnownView]) -> list[KnownView]:
    """Return the views of a turntable, turning in the direction that fits the input better."""
    reverse = [view.at(view.camera.elevation_deg, -view.camera.azimuth_deg % 360) for view in views]
    return max(([*views], reverse), key=lambda ring: turntable_score([front, *ring]))


def judge(views: Sequence[KnownView], found: Agreement) -> tuple[str, ...]:
    """Return notes about a view that contradicts the others.

    Raises:
        BadInput: a view shows something else.
    """
    lowest = min(found.filled)
    many = len(views) > FEW and found.odd is None
    share, least = (found.mean, LEAST_MEAN) if many else (lowest, LEAST_FILLED)
    if share < least:
        named = (
            f"{_describe_view(views[found.odd])} contradicts the others" if found.odd else "they contradict each other"
        )
        filled = "of the silhouettes" if many else "of one silhouette"
        raise BadInput(
            f"the views do not show one subject from the given azimuths: {named}; their common visual hull fills only "
            f"{share:.0%} {filled}, at least {least:.0%} is needed. Check the pictures and the azimuths: 90 is the "
            "side that the input shows on the right, 180 the back"
        )
    if found.odd is None:
        return ()
    return (
        f"{_describe_view(views[found.odd])} contradicts the other views: the common visual hull fills only "
        f"{lowest:.0%} of one silhouette; see the picture of the step prepare_views",
    )


def exposure_notes(views: Sequence[KnownView], gains: Sequence[Float[Tensor, " 3"] | None]) -> tuple[str, ...]:
    """Return a note that names the views that get brighter or darker."""
    changed = [_describe_view(view) for view, gain in zip(views, gains, strict=True) if gain is not None]
    return (f"exposure adjusted to the input: {', '.join(changed)}",) if changed else ()


def picture_of(views: Sequence[KnownView]) -> Float[Tensor, "h w 3"]:
    """Compose the pictures in a row, and under each the outline of their common visual hull."""
    small = [smaller(view) for view in views]
    shown = torch.cat([over_white(view.cutout) for view in small], 1)
    try:
        alpha = torch.cat([*hull_alpha(small)], 1)
    except BadInput:
        alpha = torch.zeros_like(shown[..., :1])
    mask = torch.cat([view.cutout[..., 3:] for view in small], 1)
    missing = ((mask > 0.5) & (alpha < 0.5)).float()  # red: in the picture, and excluded by the others
    under = (1 - 0.6 * alpha).expand_as(shown) * (1 - missing) + missing * torch.tensor([0.9, 0.1, 0.1])
    return torch.cat([shown, under])


def _describe_view(view: KnownView) -> str:
    azimuth, elevation = (round(angle, 1) + 0.0 for angle in (view.camera.azimuth_deg, view.camera.elevation_deg))
    return f"{view.name or 'a view'} (azimuth {azimuth:g}, elevation {elevation:g})"  # + 0.0: no -0


def _input_frames(job: Job, scratch: Path) -> Float[Tensor, "t s s 4"]:
    """Return the frames of the input; a picture is one."""
    if "footage" in job.inputs:
        video = read_frames(job.inputs["footage"], scratch)
        return torch.cat([video.frames, video.alpha], -1)
    return read_png(job.inputs["subject"])[None]
