"""Depth pictures and layers of the user, as a field in the frame of the prepared subject."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize
from dg4d_lib.inflation.hints import DepthField, DepthKind, depth_field, is_known, known_share, layer_field
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.video.framing import reframe
from dg4d_lib.video.subject import PreparedSubject
from steps.sources.decode_limit import DecodeLimit
from steps.sources.decoder_errors import damage_is_bad_input
from steps.sources.media_types import SNIFFED_BYTES, container_of, is_animated_png, is_zip, still_suffix
from steps.sources.reader import Source
from steps.sources.stills import StillValues, read_values

LARGEST_SIDE = 256  # pixels: outlines and depths need no more
MOST_TINT = 0.02  # mean difference of the color channels of a gray picture: JPEG leaves less
SPARSE = 0.95  # share of the subject with values, below which the report has a note
ONE_PICTURE = "give one gray picture of the first frame (PNG, TIFF, EXR)"


def read_depth(
    path: Path, source: Source, prepared: PreparedSubject, settings: SubjectSettings, scratch: Path
) -> tuple[DepthField, str]:
    """Read a depth picture of the first frame; return its field and a sentence about it.

    Integers are relative inverse depth, as networks draw it: bright is near. Floating-point numbers are distances.
    `depth_kind` of the settings says otherwise. Distances of 0 or less are unknown.

    Args:
        path: of the picture.
        source: that it belongs to.
        prepared: subject, cut out of the source.
        settings: of the subject.
        scratch: existing folder for links.

    Raises:
        BadInput: it cannot be read, is colored, has another size than the source, or says nothing.
    """
    found = _read(path, "the depth picture", source, prepared, settings, scratch)
    kind: DepthKind = "distance" if found.is_float else "inverse"
    if settings.depth_kind != "auto":
        kind = settings.depth_kind
    values, known = found.values, found.known
    if kind == "distance":  # resampled as inverse distance: backgrounds are far away, or at infinity
        known = known & (values > 0)
        values = np.where(known, 1 / np.where(known, values, 1), 0).astype(np.float32)
    planes, coverage = _framed(values, known, prepared)
    values_there = 1 / planes.clamp(min=1e-12) if kind == "distance" else planes
    alpha = _alpha(prepared, len(planes))
    height, width = prepared.frame
    field = depth_field(values_there, coverage, alpha, kind, max(height, width) / prepared.crop.side)
    said = "distances" if kind == "distance" else "relative inverse depth, bright is near"
    share = known_share(coverage, alpha)
    if share < SPARSE:
        said += f", known for {share:.0%} of the subject"
    return (
        field,
        f"depth: the guessed depth was corrected by the picture of --depth (read as {said}; change with "
        "subject.depth_kind)",
    )


def read_layers(
    path: Path, source: Source, prepared: PreparedSubject, settings: SubjectSettings, scratch: Path
) -> tuple[DepthField, str]:
    """Read layers of the first frame; return their field and a sentence about them.

    Raises:
        BadInput: they cannot be read, are colored, have another size than the source, or say nothing.
    """
    found = _read(path, "the picture of layers", source, prepared, settings, scratch)
    levels, coverage = _framed(found.values, found.known, prepared)
    field = layer_field(levels, is_known(coverage), _alpha(prepared, len(levels)))
    return field, "depth: the guessed depth was corrected by --layers: light parts are nearer, dark parts farther"


def _read(
    path: Path, what: str, source: Source, prepared: PreparedSubject, settings: SubjectSettings, scratch: Path
) -> StillValues:
    """Decode a gray picture on the pixels of the frames that the subject was cut out of."""
    with path.open("rb") as file:
        head = file.read(SNIFFED_BYTES)
    if is_zip(head) or is_animated_png(head) or container_of(head):
        raise BadInput(f"{what} is a {'zip' if is_zip(head) else 'video or an animation'}; {ONE_PICTURE}")
    link = scratch / f"depth{still_suffix(head)}"  # OpenImageIO selects the decoder by the suffix
    link.unlink(missing_ok=True)
    link.symlink_to(path.resolve())
    limit = DecodeLimit(settings.max_decode_gb)
    with limit.enforced(what), damage_is_bad_input(what):
        found = read_values(link, what, limit, *prepared.frame)
    if found.size != source.size:
        given, wanted = (f"{width} x {height}" for width, height in (found.size, source.size))
        raise BadInput(
            f"{what} is {given} pixels, the {source.kind} {wanted}; give it at the size of the {source.kind}"
        )
    if found.tint > MOST_TINT:
        raise BadInput(f"{what} is colored, so its brightness is not depth; save it in gray: {ONE_PICTURE}")
    return found


def _framed(
    values: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], prepared: PreparedSubject
) -> tuple[Float[Tensor, "s s"], Float[Tensor, "s s"]]:
    """Return averages of the known values in the square of the subject, and the share of every pixel that is known."""
    size = min(LARGEST_SIDE, prepared.frames.shape[1])
    if not known.any():
        return torch.zeros(size, size), torch.zeros(size, size)
    low, high = float(values[known].min()), float(values[known].max())
    unit = torch.from_numpy((values - low) / max(high - low, 1e-30)).clamp(0, 1)
    picture = torch.cat([unit[..., None].expand(-1, -1, 3), torch.from_numpy(known)[..., None].float()], -1)
    framed = reframe(picture[None], prepared.crop, size)[0]
    return framed[..., 0] * (high - low) + low, framed[..., 3]


def _alpha(prepared: PreparedSubject, size: int) -> Float[Tensor, "s s"]:
    """Return the alpha of the first frame at another size."""
    return resize(prepared.frames[:1], (size, size))[0, ..., 3].clamp(0, 1)
