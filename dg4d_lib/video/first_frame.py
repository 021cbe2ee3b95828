"""Dense correspondence of the frames of a video with its first one, by optical flow.

Every frame is compared with the first one, warped as the frame before was found to show it. So errors do not add up,
and motions between distant frames need no large flow.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from dg4d_lib.images import luminance
from dg4d_lib.video.optical_flow import optical_flow

BACKDROP = 1.5  # luminance outside of the subject: brighter than any, so that outlines guide the flow
DIFFERENCE = 0.2  # summed difference of color (mean) and alpha at which the trust falls to 1/e
WINDOW = 5  # pixels of a side over which differences are averaged
SMOOTH = 3.0  # pixels: standard deviation of the window in which the strain of the flow is taken
THINNEST = 0.1  # square pixels, added to the variances in that window: thin parts have no strain across


@dataclass(frozen=True)
class Correspondence:
    """Places of a frame's pixels in the first frame.

    Attributes:
        places: row and column in the first frame, counted in pixels from the middle of its first one.
        trust: agreement of the frame with the warped first one around each pixel, in [0, 1].
    """

    places: Float[Tensor, "h w 2"]
    trust: Float[Tensor, "h w"]

    def warp(self, planes: Float[Tensor, "c h w"]) -> Float[Tensor, "c h w"]:
        """Return planes of the first frame as this frame shows them."""
        height, width = planes.shape[1:]
        size = torch.tensor([height, width])
        at = (2 * self.places + 1) / size - 1
        return grid_sample(planes[None], at.flip(-1)[None], align_corners=False, padding_mode="border")[0]


def strain(match: Correspondence, mask: Bool[Tensor, "h w"]) -> Float[Tensor, "h w"]:
    """Return how much the picture is stretched or compressed around each pixel since the first frame.

    It is 0 where parts shift and turn in the picture plane. Parts that turn in depth are foreshortened.

    Args:
        match: of the frame.
        mask: pixels of the subject; the flow of others does not count.

    Returns:
        Largest absolute logarithm of the singular values of the flow's Jacobian.
    """
    inside = mask.numpy().astype(np.float64)
    grid = np.stack(np.meshgrid(*map(np.arange, inside.shape), indexing="ij"), -1) - np.array(inside.shape) / 2
    flow = match.places.double().numpy() - np.array(inside.shape) / 2 - grid

    def mean(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return ndimage.gaussian_filter(values * inside, SMOOTH) / share

    def covariances(one: Float[np.ndarray, "h w 2"], other: Float[np.ndarray, "h w 2"]) -> Float[np.ndarray, "h w 2 2"]:
        rows = [
            [mean(one[..., i] * other[..., j]) - mean(one[..., i]) * mean(other[..., j]) for j in (0, 1)]
            for i in (0, 1)
        ]
        return np.moveaxis(np.array(rows), (0, 1), (2, 3))

    share = ndimage.gaussian_filter(inside, SMOOTH) + 1e-9
    extent = covariances(grid, grid) + THINNEST * np.eye(2)
    jacobian = np.eye(2) + covariances(flow, grid) @ np.linalg.inv(extent)  # of the affine map that fits best
    stretch = np.linalg.svd(jacobian, compute_uv=False).clip(1e-3)
    return torch.from_numpy(np.abs(np.log(stretch)).max(-1)).float()


def match_first_frame(pictures: Sequence[Float[Tensor, "4 h w"]]) -> Iterator[Correspondence]:
    """Yield the correspondence of every frame, the first one included, each computed when it is asked for.

    Args:
        pictures: premultiplied color and alpha of the frames, in [0, 1].
    """
    first = pictures[0]
    rows, columns = (torch.arange(size, dtype=torch.float32) for size in first.shape[1:])
    pixels = torch.stack(torch.meshgrid(rows, columns, indexing="ij"), -1)
    match = Correspondence(pixels, torch.ones(first.shape[1:]))
    yield match
    for picture in pictures[1:]:
        expected = match.warp(first)
        flow = torch.from_numpy(optical_flow(_gray(picture), _gray(expected)))
        step = Correspondence(pixels + flow.permute(1, 2, 0), match.trust)
        places = step.warp(match.places.permute(2, 0, 1)).permute(1, 2, 0)
        moved = Correspondence(places, match.trust)
        match = Correspondence(places, _agreement(picture, moved.warp(first)))
        yield match


def _gray(picture: Float[Tensor, "4 h w"]) -> Float[np.ndarray, "h w"]:
    """Return the luminance before the bright backdrop."""
    return (luminance(picture[:3].movedim(0, -1)) + (1 - picture[3]) * BACKDROP).double().numpy()


def _agreement(one: Float[Tensor, "4 h w"], other: Float[Tensor, "4 h w"]) -> Float[Tensor, "h w"]:
    difference = (one - other).abs()
    mean = avg_pool2d((difference[:3].mean(0) + difference[3])[None], WINDOW, 1, WINDOW // 2)[0]
    return torch.exp(-(mean / DIFFERENCE).square())
