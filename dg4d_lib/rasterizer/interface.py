"""Interface of the rasterizer backends and their shared constants, with the semantics of gsplat ("classic" mode).

Pixel centers are at +0.5. BLUR is added to the diagonal of the 2D covariance, also in the gradients. alpha =
min(MAX_ALPHA, o e^-sigma); contributions below MIN_ALPHA are skipped. A pixel stops before the Gaussian that would
reduce its transmittance to MIN_TRANSMITTANCE or less. Color is composited over transmittance * background; depth is the
weighted sum of camera z.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.backends import CUDA, backend_name, require_backend

BLUR = 0.3  # pixels squared: gsplat's eps2d, the low-pass filter of 3DGS
MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
MAX_SIGMA = 3.33  # standard deviations: screen radius of a Gaussian, or sqrt(2 ln(255 o)) if less (gsplat)
NEAR = 0.2  # near plane, world units of camera z
FRUSTUM_MARGIN = 1.3  # the Jacobian's x/z and y/z are clamped to this multiple of tan(fov/2) (3DGS)


@dataclass(frozen=True)
class Rendering:
    """Rendered images of one cloud, composited over the background.

    Attributes:
        color: in [0, 1] for colors in [0, 1].
        alpha: 1 - transmittance.
        depth: sum of weight times camera z, world units (not normalized).
        visible: true if a Gaussian may contribute to an image (gsplat: radii > 0).
    """

    color: Float[Tensor, "b h w 3"]
    alpha: Float[Tensor, "b h w 1"]
    depth: Float[Tensor, "b h w 1"]
    visible: Bool[Tensor, "b n"]


@runtime_checkable
class Rasterizer(Protocol):
    """Rasterizer backend."""

    def __call__(
        self,
        gaussians: Gaussians,
        cameras: Sequence[OrbitCamera],
        background: Float[Tensor, " 3"],
        means2d_offsets: Float[Tensor, "b n 2"] | None = None,
    ) -> Rendering:
        """Render one image per camera, differentiable in the Gaussians.

        Args:
            gaussians: one cloud for all cameras (fields "n 3"), or one state per camera (fields "b n 3").
            cameras: b cameras of one width and height.
            background: background color.
            means2d_offsets: zeros, added to the projected means (means2d) in pixels; density control uses their
                gradient. Backends may assume that they are zero.

        Raises:
            BadInput: no cameras, cameras of different sizes, a number of states other than the number of cameras, or
                non-finite Gaussians.
        """
        ...


_BACKENDS = {
    "reference": "dg4d_lib.rasterizer.reference",
    "cpu": "dg4d_lib.rasterizer.cpu",
    "cuda_gsplat": "dg4d_lib.rasterizer.cuda_gsplat",
}


def get_rasterizer(name: str) -> Rasterizer:
    """Return the backend of this name; `auto` is resolved for this machine.

    Raises:
        BadInput: the name is unknown.
        BackendUnavailable: the backend cannot run on this machine.
    """
    name = backend_name(name)
    if name not in _BACKENDS:
        raise BadInput(f"unknown rasterizer {name!r}; choose one of auto, {', '.join(_BACKENDS)}")
    require_backend(name)
    if name == CUDA and not torch.cuda.is_available():
        raise BackendUnavailable(
            f"rasterizer {name!r} cannot run here: torch {torch.__version__} cannot use the GPU (often because "
            "of an old driver; `python -c 'import torch; torch.cuda.init()'` shows the error); or choose rasterizer=cpu"
        )
    try:
        backend: Rasterizer = import_module(_BACKENDS[name]).rasterize
    except ImportError as error:
        raise BackendUnavailable(f"rasterizer {name!r} cannot run here: {error}") from error
    return backend


def preferred_device(name: str) -> torch.device:
    """Return the device this backend prefers its inputs on; others cost a copy per call, or are refused."""
    return torch.device("cuda" if backend_name(name) == CUDA else "cpu")


def shared_size(cameras: Sequence[OrbitCamera]) -> tuple[int, int]:
    """Return the common height and width of all cameras, pixels.

    Raises:
        BadInput: no cameras, or cameras of different sizes.
    """
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise BadInput(f"all cameras of a rendering must have the same size; given {sorted(sizes) or 'no camera'}")
    return sizes.pop()


def has_state_per_camera(gaussians: Gaussians, cameras: Sequence[OrbitCamera]) -> bool:
    """Return true if the cloud has one state per camera, false if it has one for all.

    Raises:
        BadInput: the number of states differs from the number of cameras.
    """
    shape = gaussians.means.shape
    if shape[:-2] not in ((), (len(cameras),)):
        raise BadInput(
            f"{len(cameras)} cameras need Gaussians of one state (n 3) or of {len(cameras)} states; "
            f"given means of shape {tuple(shape)}"
        )
    return len(shape) == 3


def require_finite(gaussians: Gaussians) -> None:
    """Refuse a cloud with non-finite numbers.

    Tests one sum per field instead of every number: the sum is finite unless a number is not, or they overflow. On the
    CPU, NumPy computes it, because starting torch's threads takes ten times as long.

    Raises:
        BadInput: names the fields and the number of non-finite entries.
    """
    fields = {name: value.detach() for name, value in vars(gaussians).items()}
    if gaussians.means.device.type == "cpu":
        with np.errstate(all="ignore"):
            finite = all(np.isfinite(value.numpy().sum()) for value in fields.values())
    else:
        finite = bool(torch.stack([value.sum() for value in fields.values()]).isfinite().all())
    if finite:
        return
    bad = {name: int((~value.isfinite()).sum()) for name, value in fields.items()}
    counts = ", ".join(f"{count} in {name}" for name, count in bad.items() if count)
    if counts:
        raise BadInput(
            f"{len(gaussians)} Gaussians have non-finite numbers ({counts}) and cannot be rendered; remove those, or "
            "lower the learning rates of the fit that made them"
        )
