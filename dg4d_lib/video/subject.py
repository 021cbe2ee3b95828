"""From any frames to cut-outs of the subject in one square frame."""

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.settings import SubjectSettings
from dg4d_lib.video.framing import (
    VISIBLE,
    bounding_box,
    crop_around_subject,
    crop_whole_frame,
    downscale,
    is_well_framed,
    reframe,
)
from dg4d_lib.video.matting import matte

OVERSAMPLING = 2  # times the size of the square: larger opaque frames are shrunk before they are cut out
SMALLEST_SUBJECT = 16  # pixels of its longest side; below there is nothing to reconstruct
NOTES = {
    "backdrop": "The background was removed by its plain color; a PNG with transparency is cut more exactly.",
    "uneven backdrop": (
        "The background was removed by its color though it is uneven, which is a guess; "
        "check subject.png, and give a PNG with transparency if the outline is wrong."
    ),
    "color models": (
        "The background was removed by its colors, which is a guess on photographs; "
        "check subject.png, and give a PNG with transparency if the outline is wrong."
    ),
}


def prepare_subject(
    frames: Float[Tensor, "t h w 4"], has_alpha: bool, settings: SubjectSettings
) -> tuple[Float[Tensor, "t s s 4"], tuple[str, ...]]:
    """Cut out, frame and resample the subject, the same way in all frames.

    Args:
        frames: straight sRGB and alpha in [0, 1].
        has_alpha: whether alpha tells the subject; else it is found by its colors.
        settings: size of the square in pixels, framing and border.

    Returns:
        Straight cut-outs, colors extended under what is transparent; and sentences for the report.

    Raises:
        BadInput: nothing is visible in the first frame, no subject can be told apart, or it is too small.
    """
    notes: tuple[str, ...] = ()
    given = has_alpha
    if not has_alpha:
        found = matte(downscale(frames, OVERSAMPLING * settings.size)[..., :3])
        frames, notes = found.frames, (NOTES[found.method],)
    alpha = frames[..., 3]
    bounding_box(alpha)  # refuses what shows nothing at all
    if not (alpha[0] > VISIBLE).any():
        raise BadInput("the first frame shows no subject; cut the video so that it begins when the subject is there")
    left, top, right, bottom = bounding_box(alpha[:1])
    if max(right - left, bottom - top) < SMALLEST_SUBJECT:
        raise BadInput(
            f"the subject is {right - left} x {bottom - top} pixels; its longest side must have at least "
            f"{SMALLEST_SUBJECT}: give a larger or closer picture"
        )
    keep = settings.framing == "keep" or (settings.framing == "auto" and given and is_well_framed(alpha))
    crop = crop_whole_frame(*alpha.shape[1:]) if keep else crop_around_subject(alpha, settings.border)
    if not (alpha <= VISIBLE).any():
        notes = (*notes, "The picture is filled completely: there is no outline to build a shape from.")
    return reframe(frames, crop, settings.size), notes
