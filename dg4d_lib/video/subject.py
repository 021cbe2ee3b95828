"""Subject preparation: matting, square cropping and resampling of input frames."""

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

OVERSAMPLING = 2  # maximum size of opaque frames before matting, relative to the size of the square
SMALLEST_SUBJECT = 16  # longest side, pixels; a smaller subject has too few pixels to reconstruct
NOTES = {
    "backdrop": "The background was removed by its plain color; a PNG with transparency gives a more exact outline.",
    "uneven backdrop": (
        "The background was removed by its color although it is uneven, so the outline is a guess; "
        "check subject.png, and give a PNG with transparency if it is wrong."
    ),
    "color models": (
        "The background was removed by color models, so the outline is a guess on photographs; "
        "check subject.png, and give a PNG with transparency if it is wrong."
    ),
}


def prepare_subject(
    frames: Float[Tensor, "t h w 4"], has_alpha: bool, settings: SubjectSettings
) -> tuple[Float[Tensor, "t s s 4"], tuple[str, ...]]:
    """Cut out, crop and resample the subject, the same way in all frames.

    Args:
        frames: straight sRGB and alpha in [0, 1].
        has_alpha: True if alpha marks the subject; else the subject is matted by its colors.
        settings: size of the square in pixels, framing and border.

    Returns:
        Straight cut-outs with colors extended into transparent pixels, and notes for the report.

    Raises:
        BadInput: nothing is visible in the first frame, no subject is found, or it is too small.
    """
    notes: tuple[str, ...] = ()
    if not has_alpha:
        found = matte(downscale(frames, OVERSAMPLING * settings.size)[..., :3])
        frames, notes = found.frames, (NOTES[found.method],)
    alpha = frames[..., 3]
    bounding_box(alpha)  # raises if no frame shows anything
    if not (alpha[0] > VISIBLE).any():
        raise BadInput("the first frame shows no subject; trim the video so that it starts with the subject in view")
    left, top, right, bottom = bounding_box(alpha[:1])
    if max(right - left, bottom - top) < SMALLEST_SUBJECT:
        raise BadInput(
            f"the subject is {right - left} x {bottom - top} pixels; its longest side must have at least "
            f"{SMALLEST_SUBJECT} pixels: give a larger or closer picture"
        )
    keep = settings.framing == "keep" or (settings.framing == "auto" and has_alpha and is_well_framed(alpha))
    crop = crop_whole_frame(*alpha.shape[1:]) if keep else crop_around_subject(alpha, settings.border)
    if not (alpha <= VISIBLE).any():
        notes = (*notes, "The subject fills the whole picture, so there is no outline to build a shape from.")
    return reframe(frames, crop, settings.size), notes
