"""Tile-based Gaussian rasterizer for CPUs, forward and backward: vectorized Numba kernels, float32.

Per view: project (`cpu_project`), sort by depth and bin into tiles (`cpu_bins`), blend the tiles (`cpu_tiles`); the
backward pass walks the tile lists from back to front. Threads take whole views, or tiles if there are fewer views than
threads; the order of every sum is fixed, so the result does not depend on the number of threads or their timing.
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
from dg4d_lib.kernels.workers import Scratch, empty_recycled, run_parallel, split_range, thread_count
from dg4d_lib.rasterizer.cpu_bins import TILE, bin_by_tile
from dg4d_lib.rasterizer.cpu_blend import PLANE
from dg4d_lib.rasterizer.cpu_project import CAMERA, RECORD, project, unproject
from dg4d_lib.rasterizer.cpu_tiles import add_duplicates, assign_rows, blend, blend_backward
from dg4d_lib.rasterizer.interface import FRUSTUM_MARGIN, Rendering, has_state_per_camera, require_finite, shared_size

Array = NDArray[Any]


def rasterize(
    gaussians: Gaussians,
    cameras: Sequence[OrbitCamera],
    background: Float[Tensor, " 3"],
    means2d_offsets: Float[Tensor, "b n 2"] | None = None,
) -> Rendering:
    """Render one image per camera; differentiable once, in the Gaussians and `means2d_offsets` (which must be zero).

    Computed in float32; images and gradients are returned in the precision of the Gaussians. Gaussians whose covariance
    overflows are not drawn. For the arguments see `Rasterizer`.

    Raises:
        BadInput: no cameras, cameras of different sizes, a number of states other than the number of cameras,
            non-finite Gaussians, or tensors on another device than the CPU.
    """
    height, width = shared_size(cameras)
    has_state_per_camera(gaussians, cameras)
    require_finite(gaussians)
    if gaussians.means.device.type != "cpu":
        raise BadInput(
            f"rasterizer 'cpu' needs tensors on the CPU; given {gaussians.means.device}; move them with .to('cpu')"
        )
    log_opacities = logsigmoid(gaussians.opacity_logits)
    inputs = (gaussians.means, gaussians.quats, gaussians.log_scales, log_opacities, gaussians.harmonics)
    color, alpha, depth, visible = _Rasterize.apply(
        *(value.float() for value in inputs),
        None if means2d_offsets is None else means2d_offsets.float(),
        np.stack([pack_camera(camera) for camera in cameras]),
        background.detach().float().contiguous().numpy(),
        (height, width),
    )
    color, alpha, depth = (image.to(gaussians.means.dtype) for image in (color, alpha, depth))
    return Rendering(color, alpha, depth, visible)


def pack_camera(camera: OrbitCamera) -> Float[Array, " c"]:
    """Return a camera as the array that the kernels read (layout: `cpu_project.CAMERA`)."""
    viewmat = camera.viewmat().numpy()
    tan_x, tan_y = camera.tan_half_fov
    intrinsics = (camera.focal, camera.width / 2, camera.height / 2, FRUSTUM_MARGIN * tan_x, FRUSTUM_MARGIN * tan_y)
    pack_camera = np.array([*viewmat[:3, :3].flat, *viewmat[:3, 3], *intrinsics], np.float32)
    assert len(pack_camera) == CAMERA
    return pack_camera


@dataclass
class _Clouds:
    """Gaussians as arrays; means, quats and scales have one state, or one per view."""

    means: Array
    quats: Array
    scales: Array
    log_opacities: Array
    harmonics: Array

    def __len__(self) -> int:
        return len(self.harmonics)

    def state(self, view: int) -> tuple[Array, Array, Array]:
        """Return means, quats and scales of a view."""
        if self.means.ndim == 2:
            return self.means, self.quats, self.scales
        return self.means[view], self.quats[view], self.scales[view]


@dataclass
class _ForwardState:
    """Buffers of the forward pass, kept for the backward pass."""

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
        # one array per view, because scratch memory is reused in pieces of bounded size
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
        """True if threads take whole views, false if they share the tiles of each view."""
        return len(self.cameras) >= thread_count()

    def draw(self, clouds: _Clouds) -> list[Tensor]:
        """Render color, alpha and depth, channels first.

        The images are not stored here: they would refer to the graph that owns this object.
        """
        images = [torch.empty(len(self.cameras), planes, *self.size) for planes in (3, 1, 1)]
        planes = [image.numpy() for image in images]
        if self.by_view:
            run_parallel([partial(self._draw_view, clouds, planes, view) for view in self.views])
        else:
            threads = thread_count()
            parts = split_range(len(clouds), threads)
            run_parallel([partial(self._project, clouds, view, *part) for view in self.views for part in parts])
            run_parallel([partial(self._bin, view) for view in self.views])
            parts = split_range(self.tiles, 4 * threads)
            run_parallel([partial(self._blend, planes, view, *part) for view in self.views for part in parts])
        return images

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
    """Gradients of the Gaussians and of the projected means."""

    clouds: _Clouds
    state: _ForwardState
    color: Array
    alpha: Array
    depth: Array

    def __post_init__(self) -> None:
        clouds = self.clouds
        self.means, self.quats, self.log_scales, self.log_opacities, self.harmonics = (
            empty_recycled(value.shape)
            for value in (clouds.means, clouds.quats, clouds.scales, clouds.log_opacities, clouds.harmonics)
        )
        self.means2d = empty_recycled((len(self.state.cameras), len(clouds), 2))

    def collect(self) -> None:
        """Compute the gradients in groups of views, which bounds the memory; views are summed in order."""
        state, threads = self.state, thread_count()
        for first in state.views[:: 2 * threads]:
            group, scratch = state.views[first : first + 2 * threads], Scratch()
            records = self._blend_group(group, scratch)
            parts = split_range(len(self.clouds), threads)
            run_parallel([partial(self._unproject, group, records, *part) for part in parts])

    def _blend_group(self, group: range, scratch: Scratch) -> list[Array]:
        """Return the gradients of the records, for each view.

        Every entry of the tile lists has its own row, so that tiles are processed in parallel; the rows of one Gaussian
        are then added in the order of the tiles.
        """
        state, count = self.state, len(self.clouds)
        grad_records, blends, sums = [], [], []
        for view in group:
            _, entries = state.bins[view]
            slots = scratch.empty(entries.shape, np.uint32)
            rows = scratch.empty((assign_rows(entries, count, slots), RECORD))
            parts = split_range(state.tiles, 1 if state.by_view else 4 * thread_count())
            blends += [partial(self._blend, view, slots, rows, *part) for part in parts]
            sums.append(partial(add_duplicates, entries, slots, count, rows))
            grad_records.append(rows)
        run_parallel(blends)
        run_parallel(sums)
        return grad_records

    def _blend(self, view: int, slots: Array, grad_records: Array, first: int, last: int) -> None:
        state = self.state
        kept = (state.transmittance[view], state.stops[view], state.stopped[view])
        incoming = (state.background, self.color[view], self.alpha[view, 0], self.depth[view, 0])
        blend_backward(state.records[view], *state.bins[view], *incoming, *kept, slots, grad_records, first, last)

    def _unproject(self, group: range, grad_records: list[Array], start: int, stop: int) -> None:
        clouds, state = self.clouds, self.state
        for view, grad_record in zip(group, grad_records, strict=True):
            per_view = clouds.means.ndim == 3
            fields = (self.means, self.quats, self.log_scales)
            gradients = [gradient[view] if per_view else gradient for gradient in fields]
            unwritten = [self.means2d[view], *(gradients if per_view or view == 0 else ())]
            unwritten += [self.log_opacities, self.harmonics] if view == 0 else []
            for gradient in unwritten:  # cleared by the thread that adds to them next, while they are in its cache
                gradient[start:stop] = 0
            shared = (self.log_opacities, self.harmonics[:, 0], self.means2d[view])
            inputs = (clouds.harmonics[:, 0], state.cameras[view], state.keys[view], grad_record)
            unproject(*clouds.state(view), *inputs, *gradients, *shared, start, stop)


class _Rasterize(torch.autograd.Function):
    """Autograd function of the rasterizer."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        *parameters, offsets, cameras, background, size = inputs
        means, quats, log_scales, log_opacities, harmonics = (
            parameter.detach().contiguous().numpy() for parameter in parameters
        )
        state = _ForwardState(cameras, background, size, len(harmonics))
        scales = state.scratch.empty(log_scales.shape)
        with np.errstate(over="ignore"):  # NumPy, because starting torch's threads costs more
            np.exp(log_scales, out=scales)
        clouds = _Clouds(means, quats, scales, log_opacities, harmonics)
        color, alpha, depth = (image.permute(0, 2, 3, 1) for image in state.draw(clouds))
        visible = torch.from_numpy(state.keys > 0)
        ctx.mark_non_differentiable(visible)
        ctx.clouds, ctx.state, ctx.offsets = clouds, state, offsets is not None
        return color, alpha, depth, visible

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *incoming: Tensor) -> tuple[Any, ...]:
        planes = [gradient.permute(0, 3, 1, 2).contiguous().numpy() for gradient in incoming[:3]]
        grad = _Gradients(ctx.clouds, ctx.state, *planes)
        grad.collect()
        arrays = (grad.means, grad.quats, grad.log_scales, grad.log_opacities, grad.harmonics, grad.means2d)
        *parameters, means2d = (torch.from_numpy(array) for array in arrays)
        return *parameters, means2d if ctx.offsets else None, None, None, None
