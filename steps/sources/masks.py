"""Masks of the user: pictures or frames that mark the subject of a source."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize_planes
from dg4d_lib.video.framing import VISIBLE
from dg4d_lib.video.subject import check_box
from steps.sources.reader import Source, read_source

MOST_TINT = 0.1  # mean difference of the color channels where a mask is painted: JPEG and off-white leave less


def read_mask(
    path: Path, source: Source, scratch: Path, max_frames: int, max_decode_gb: float
) -> Float[Tensor, "t h w"]:
    """Decode a mask and return it at the size of the decoded source, in [0, 1].

    The alpha channel is the mask if there is one, else brightness: white is the subject.

    Args:
        path: picture for a picture, or as many frames as the video has.
        source: decoded source.
        scratch: existing folder for links and unpacked pictures.
        max_frames: as for the source.
        max_decode_gb: memory limit in GiB.

    Raises:
        BadInput: the mask cannot be read, is colored, almost black or almost transparent, or its size or number of
            frames differs from the source's.
    """
    try:
        mask = read_source(path, scratch, max_frames, max_decode_gb)
    except BadInput as error:
        raise BadInput(f"--mask: {error}") from error
    if mask.size != source.size:
        raise BadInput(
            f"--mask is {_format_size(mask.size)} pixels, the {source.kind} {_format_size(source.size)}; draw the mask "
            f"at the size of the {source.kind}"
        )
    if mask.count != source.count:
        given = f"--mask has {mask.count} frame{'s' * (mask.count != 1)}"
        if source.kind == "picture":
            raise BadInput(f"{given}, and the input is one picture; give one picture as the mask")
        raise BadInput(f"{given}, the video {source.count}; give a folder with one mask for every frame")
    values = mask.frames[..., 3] if mask.has_alpha else _brightness(mask.frames[..., :3])
    if 0 < (largest := float(values.max())) <= VISIBLE:
        where, needed = ("transparent", "opaque") if mask.has_alpha else ("black", "white")
        raise BadInput(
            f"--mask is almost {where}: its largest value is {255 * largest:.2g} of 255, and the subject must be "
            f"{needed}; multiply a mask of labels 0 and 1 by 255 (16 bits: by 65535)"
        )
    return resize_planes(values[None], source.frames.shape[1:3])[0].clamp(0, 1)


def _brightness(colors: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t h w"]:
    """Return the brightness of gray frames.

    Raises:
        BadInput: they are colored.
    """
    largest = colors.amax(-1)
    painted = largest > VISIBLE
    if painted.any() and float((largest - colors.amin(-1))[painted].mean()) > MOST_TINT:
        raise BadInput(
            "--mask is colored, so its brightness is not the opacity of the subject; paint the subject white and the "
            "background black, or give a picture whose alpha channel is the mask"
        )
    return colors.mean(-1)


def scaled_box(box: tuple[int, ...], source: Source) -> tuple[int, ...]:
    """Return a box of the file in pixels of its decoded frames, rounded outwards.

    Raises:
        BadInput: the box reaches out of the file's picture.
    """
    if not box:
        return ()
    width, height = source.size
    x, y, w, h = box
    check_box(box, width, height)
    rows, columns = source.frames.shape[1:3]
    left, right = x * columns // width, -(-(x + w) * columns // width)
    top, bottom = y * rows // height, -(-(y + h) * rows // height)
    return left, top, right - left, bottom - top


def _format_size(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
