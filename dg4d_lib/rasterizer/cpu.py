"""The rasterizer for processors: Numba kernels with explicit vectors, hand-written gradients, float32.

Per view: project (`cpu_project`), sort by depth and list per tile (`cpu_bins`), blend the tiles (`cpu_tiles`); backward
runs through the lists from the back. Threads take whole views, or tiles when there are fewer views than threads; every
sum has one fixed order, so the bytes of the result depend on neither the threads' number nor their timing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import logsigmoid

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.kernels.workers import Scratch, ranges, recycled, run
from dg4d_lib.rasterizer.cpu_bins import TILE, bin_by_tile
from dg4d_lib.rasterizer.cpu_blend import PLANE
from dg4d_lib.rasterizer.cpu_project import CAMERA, RECORD, project, unproject
from dg4d_lib.rasterizer.cpu_tiles import blend, blend_backward, gather, own_rows
from dg4d_lib.rasterizer.interface import FRUSTUM_MARGIN, Rendering, has_state_per_camera, require_finite, shared_size

Array = NDArray[Any]


def rasterize(
    gaussians: Gaussians,
    cameras: Sequence[OrbitCamera],
    background: Float[Tensor, " 3"],
    means2d_offsets: Float[Tensor, "b n 2"] | None = None,
) -> Rendering:
    """Render every camera's picture; differentiable once, in the Gaussians and `means2d_offsets` (taken to be zero).

    Computed in float32; pictures and gradients come back in the precision of the Gaussians. Gaussians whose size
    overflows are not drawn. For the arguments see `Rasterizer`.

    Raises:
        BadInput: no cameras, cameras of different sizes, a number of states other than the number of cameras, Gaussians
            with numbers that are not finite, or tensors that are not in the processor's memory.
    """
    height, width = shared_size(cameras)
    has_state_per_camera(gaussians, cameras)
    require_finite(gaussians)
    if gaussians.means.device.type != "cpu":
        raise BadInput(f"rasterizer 'cpu' needs tensors on the cpu; given {gaussians.means.device}; move them there")
    log_opacities = logsigmoid(gaussians.opacity_logits)
    inputs = (gaussians.means, gaussians.quats, gaussians.log_scales, log_opacities, gaussians.harmonics)
    color, alpha, depth, visible = _Rasterize.apply(
        *(value.float() for value in inputs),
        None if means2d_offsets is None else means2d_offsets.float(),
        np.stack([packed(camera) for camera in cameras]),
        background.detach().float().contiguous().numpy(),
        (height, width),
    )
    color, alpha, depth = (picture.to(gaussians.means.dtype) for picture in (color, alpha, depth))
    return Rendering(color, alpha, depth, visible)


def packed(camera: OrbitCamera) -> Float[Array, " c"]:
    """A camera as the kernels read it."""
    pose = camera.world_to_camera().numpy()
    tan_x, tan_y = camera.tan_half_fov
    lens = (camera.focal, camera.width / 2, camera.height / 2, FRUSTUM_MARGIN * tan_x, FRUSTUM_MARGIN * tan_y)
    packed = np.array([*pose[:3, :3].flat, *pose[:3, 3], *lens], np.float32)
    assert len(packed) == CAMERA
    return packed


@dataclass
class _Clouds:
    """The inputs as arrays; means, quats and scales have one state, or one per view."""

    means: Array
    quats: Array
    scales: Array
    log_opacities: Array
    harmonics: Array

    def __len__(self) -> int:
        return len(self.harmonics)

    def state(self, view: int) -> tuple[Array, Array, Array]:
        """Means, quats and scales of a view."""
        if self.means.ndim == 2:
            return self.means, self.quats, self.scales
        return self.means[view], self.quats[view], self.scales[view]


@dataclass
class _Pictures:
    """What forward draws with, kept for backward."""

    cameras: Array
    background: Array
    size: tuple[int, int]
    count: int  # Gaussians
    scratch: Scratch = field(default_factory=Scratch)

    def __post_init__(self) -> None:
        (height, width), views = self.size, len(self.cameras)
        self.across, self.down = -(-width // TILE), -(-height // TILE)
        tiles = self.across * self.down
        empty = self.scratch.empty
        self.keys = empty((views, self.count))
        self.stopped = empty((views, tiles), np.bool_)
        # view by view, for memory is kept in pieces up to a limit
        self.records = [empty((self.count, RECORD)) for _ in self.views]
        self.transmittance = [empty((height, width)) for _ in self.views]
        self.stops = [empty((tiles, PLANE)) for _ in self.views]
        self.bins: list[tuple[Array, Array]] = [(np.zeros(1, np.int64), np.zeros(0, np.uint32))] * views

    @property
    def views(self) -> range:
        """Indices of the views."""
        return range(len(self.cameras))

    @property
    def tiles(self) -> int:
        """Number of tiles of a view."""
        return self.across * self.down

    @property
    def by_view(self) -> bool:
        """Whether threads take whole views; else they share the tiles of each."""
        return len(self.cameras) >= torch.get_num_threads()

    def draw(self, clouds: _Clouds) -> list[Tensor]:
        """Color, alpha and depth by planes; they are not kept here, for they will hold the graph that holds this."""
        pictures = [torch.empty(len(self.cameras), planes, *self.size) for planes in (3, 1, 1)]
        planes = [picture.numpy() for picture in pictures]
        if self.by_view:
            run([partial(self._draw_view, clouds, planes, view) for view in self.views])
        else:
            threads = torch.get_num_threads()
            parts = ranges(len(clouds), threads)
            run([partial(self._project, clouds, view, *part) for view in self.views for part in parts])
            run([partial(self._bin, view) for view in self.views])
            parts = ranges(self.tiles, 4 * threads)
            run([partial(self._blend, planes, view, *part) for view in self.views for part in parts])
        return pictures

    def _draw_view(self, clouds: _Clouds, planes: list[Array], view: int) -> None:
        self._project(clouds, view, 0, len(clouds))
        self._bin(view)
        self._blend(planes, view, 0, self.tiles)

    def _project(self, clouds: _Clouds, view: int, start: int, stop: int) -> None:
        means, quats, scales = clouds.state(view)
        records, keys = self.records[view], self.keys[view]
        shared = (clouds.log_opacities, clouds.harmonics[:, 0], self.cameras[view])
        project(means, quats, scales, *shared, *self.size, records, keys, start, stop)

    def _bin(self, view: int) -> None:
        self.bins[view] = bin_by_tile(self.records[view], self.keys[view], self.across, self.down, self.scratch)

    def _blend(self, planes: list[Array], view: int, first: int, last: int) -> None:
        color, alpha, depth = (plane[view] for plane in planes)
        kept = (self.transmittance[view], self.stops[view], self.stopped[view])
        blend(self.records[view], *self.bins[view], self.background, color, alpha[0], depth[0], *kept, first, last)


@dataclass
class _Gradients:
    """What backward makes."""

    clouds: _Clouds
    pictures: _Pictures
    color: Array
    alpha: Array
    depth: Array

    def __post_init__(self) -> None:
        clouds = self.clouds
        self.means, self.quats, self.log_scales, self.log_opacities, self.harmonics = (
            recycled(value.shape)
            for value in (clouds.means, clouds.quats, clouds.scales, clouds.log_opacities, clouds.harmonics)
        )
        self.centers = recycled((len(self.pictures.cameras), len(clouds), 2))

    def collect(self) -> None:
        """Fill the gradients, some views at a time to bound the memory; the views are summed in their order."""
        pictures, threads = self.pictures, torch.get_num_threads()
        for first in pictures.views[:: 2 * threads]:
            group, scratch = pictures.views[first : first + 2 * threads], Scratch()
            moments = self._blend_group(group, scratch)
            parts = ranges(len(self.clouds), threads)
            run([partial(self._unproject, group, moments, *part) for part in parts])

    def _blend_group(self, group: range, scratch: Scratch) -> list[Array]:
        """Moments of the Gaussians, for each view.

        Every entry of the tiles' lists has a row, so that tiles can be blended at once; those of one Gaussian are added
        in the order of the tiles.
        """
        pictures, count = self.pictures, len(self.clouds)
        moments, blends, sums = [], [], []
        for view in group:
            _, entries = pictures.bins[view]
            slots = scratch.empty(entries.shape, np.uint32)
            rows = scratch.empty((own_rows(entries, count, slots), RECORD))
            parts = ranges(pictures.tiles, 1 if pictures.by_view else 4 * torch.get_num_threads())
            blends += [partial(self._blend, view, slots, rows, *part) for part in parts]
            sums.append(partial(gather, entries, slots, count, rows))
            moments.append(rows)
        run(blends)
        run(sums)
        return moments

    def _blend(self, view: int, slots: Array, moments: Array, first: int, last: int) -> None:
        pictures = self.pictures
        kept = (pictures.transmittance[view], pictures.stops[view], pictures.stopped[view])
        incoming = (pictures.background, self.color[view], self.alpha[view, 0], self.depth[view, 0])
        blend_backward(pictures.records[view], *pictures.bins[view], *incoming, *kept, slots, moments, first, last)

    def _unproject(self, group: range, moments: list[Array], start: int, stop: int) -> None:
        clouds, pictures = self.clouds, self.pictures
        for view, sums in zip(group, moments, strict=True):
            own = clouds.means.ndim == 3
            state = [gradient[view] if own else gradient for gradient in (self.means, self.quats, self.log_scales)]
            unwritten = [self.centers[view], *(state if own or view == 0 else ())]
            unwritten += [self.log_opacities, self.harmonics] if view == 0 else []
            for gradient in unwritten:  # cleared here, where they are about to be added to, not all at once
                gradient[start:stop] = 0
            shared = (self.log_opacities, self.harmonics[:, 0], self.centers[view])
            seen = (clouds.harmonics[:, 0], pictures.cameras[view], pictures.keys[view], sums)
            unproject(*clouds.state(view), *seen, *state, *shared, start, stop)


class _Rasterize(torch.autograd.Function):
    """The bridge to autograd."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        *parameters, offsets, cameras, background, size = inputs
        means, quats, log_scales, log_opacities, harmonics = (
            parameter.detach().contiguous().numpy() for parameter in parameters
        )
        pictures = _Pictures(cameras, background, size, len(harmonics))
        scales = pictures.scratch.empty(log_scales.shape)
        with np.errstate(over="ignore"):  # by NumPy, for torch would wake its threads for so few numbers
            np.exp(log_scales, out=scales)
        clouds = _Clouds(means, quats, scales, log_opacities, harmonics)
        color, alpha, depth = (picture.permute(0, 2, 3, 1) for picture in pictures.draw(clouds))
        visible = torch.from_numpy(pictures.keys > 0)
        ctx.mark_non_differentiable(visible)
        ctx.clouds, ctx.pictures, ctx.offsets = clouds, pictures, offsets is not None
        return color, alpha, depth, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *incoming: Tensor) -> tuple[Any, ...]:
        planes = [gradient.permute(0, 3, 1, 2).contiguous().numpy() for gradient in incoming[:3]]
        found = _Gradients(ctx.clouds, ctx.pictures, *planes)
        found.collect()
        arrays = (found.means, found.quats, found.log_scales, found.log_opacities, found.harmonics, found.centers)
        *parameters, centers = (torch.from_numpy(array) for array in arrays)
        return *parameters, centers if ctx.offsets else None, None, None, None
