"""From any frames to cut-outs of the subject in one square frame."""

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.settings import SubjectSettings
from dg4d_lib.video.framing import VISIBLE, around_subject, extent, lies_well, reframe, shrink, whole_frame
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


def prepare(
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
        found = matte(shrink(frames, OVERSAMPLING * settings.size)[..., :3])
        frames, notes = found.frames, (NOTES[found.method],)
    alpha = frames[..., 3]
    extent(alpha)  # refuses what shows nothing at all
    if not (alpha[0] > VISIBLE).any():
        raise BadInput("the first frame shows no subject; cut the video so that it begins when the subject is there")
    left, top, right, bottom = extent(alpha[:1])
    if max(right - left, bottom - top) < SMALLEST_SUBJECT:
        raise BadInput(
            f"the subject is {right - left} x {bottom - top} pixels; its longest side must have at least "
            f"{SMALLEST_SUBJECT}: give a larger or closer picture"
        )
    keep = settings.framing == "keep" or (settings.framing == "auto" and given and lies_well(alpha))
    crop = whole_frame(*alpha.shape[1:]) if keep else around_subject(alpha, settings.border)
    if not (alpha <= VISIBLE).any():
        notes = (*notes, "The picture is filled completely: there is no outline to build a shape from.")
    return reframe(frames, crop, settings.size), notes
