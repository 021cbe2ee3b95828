"""Downscaling of images that are decoded in bands of rows, so that memory never holds the full resolution."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from dg4d_lib.images import resize_planes
from dg4d_lib.video.framing import downscaled_size, unpremultiply

BAND_BYTES = 8 * 2**20  # memory of one band of rows as float32


def downscale_in_bands(
    picture: Float[Tensor, "h w 4"] | UInt8[Tensor, "h w 4"], longest: int
) -> Float[Tensor, "h2 w2 4"]:
    """Downscale an image in memory without copies of its full size; uint8 becomes float in [0, 1]."""
    height, width = picture.shape[:2]
    downscaler, rows = BandDownscaler(height, width, longest), max(1, BAND_BYTES // (16 * width))
    for top in range(0, height, rows):
        band = picture[top : top + rows]
        downscaler.add(top, band.float() / 255 if band.dtype == torch.uint8 else band)
    return downscaler.picture()


class BandDownscaler:
    """Incremental equivalent of `framing.downscale`, up to float32 rounding.

    The triangle filter is separable: every band is filtered along its rows, and its rows are added with their weights
    to the rows of the result. An image that is small enough keeps its values.
    """

    def __init__(self, height: int, width: int, longest: int) -> None:
        self._height, self._size = height, downscaled_size(height, width, longest)
        self._keeps_size = self._size == (height, width)
        if self._keeps_size:
            self._picture = torch.empty(height, width, 4)
        else:
            self._sum = torch.zeros(4, *self._size)
            self._weight = torch.zeros(self._size[0])

    def add(self, top: int, band: Float[Tensor, "rows w 4"]) -> None:
        """Add a band of rows that starts at row `top`, straight alpha; every row must be added exactly once."""
        rows = len(band)
        if self._keeps_size:
            self._picture[top : top + rows] = band
            return
        weighted = band.permute(2, 0, 1).contiguous()
        weighted[:3] *= weighted[3]
        narrow = resize_planes(weighted[None], (rows, self._size[1]))[0]
        first, weights = self._weights(top, rows)
        reached = slice(first, first + len(weights))
        self._sum[:, reached] += weights @ narrow
        self._weight[reached] += weights.sum(1)

    def picture(self) -> Float[Tensor, "h w 4"]:
        """Return the result, after all rows were added."""
        if self._keeps_size:
            return self._picture
        picture = torch.empty(*self._size, 4)
        for row, weight in enumerate(self._weight):
            picture[row] = unpremultiply(self._sum[None, :, row : row + 1] / weight)[0, 0]
        return picture

    def _weights(self, top: int, rows: int) -> tuple[int, Float[Tensor, "o rows"]]:
        """Return the first row of the result that a band contributes to, and the weights of its rows in each."""
        scale = self._height / self._size[0]
        centers = (torch.arange(self._size[0], dtype=torch.float64) + 0.5) * scale
        reached = ((centers > top - scale) & (centers < top + rows + scale)).nonzero().flatten()
        distance = torch.arange(top, top + rows, dtype=torch.float64) + 0.5 - centers[reached, None]
        return int(reached[0]), (1 - distance.abs() / scale).clamp(min=0).float()
