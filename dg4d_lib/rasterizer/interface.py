"""What every splatting backend promises: the call, the picture it gives, and the constants they share (gsplat classic).

Pixel centers at +0.5; 2D covariance + BLUR on the diagonal, also for the gradients; alpha = min(MAX_ALPHA, o e^-s); a
pair counts iff alpha >= MIN_ALPHA; a pixel stops before the Gaussian that would take its transmittance to
MIN_TRANSMITTANCE or below; color + transmittance * background; depth is the weighted sum of camera z.
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

BLUR = 0.3  # pixels squared, the low-pass filter
MAX_ALPHA = 0.999
MIN_ALPHA = 1 / 255
MIN_TRANSMITTANCE = 1e-4
MAX_SIGMA = 3.33  # standard deviations, bound of a Gaussian on screen; also sqrt(2 ln(255 o)), whichever is less
NEAR = 0.2  # world units of camera z; nearer Gaussians are not drawn
FRUSTUM_MARGIN = 1.3  # the Jacobian's x/z and y/z are clamped to this times tan(fov/2)


@dataclass(frozen=True)
class Rendering:
    """Pictures of one cloud, composited over the background it was given.

    Attributes:
        color: in [0, 1] for colors in [0, 1].
        alpha: 1 - transmittance.
        depth: sum of weight times camera z, world units (not normalized).
        visible: which Gaussians may touch which picture.
    """

    color: Float[Tensor, "b h w 3"]
    alpha: Float[Tensor, "b h w 1"]
    depth: Float[Tensor, "b h w 1"]
    visible: Bool[Tensor, "b n"]


@runtime_checkable
class Rasterizer(Protocol):
    """A splatting backend."""

    def __call__(
        self,
        gaussians: Gaussians,
        cameras: Sequence[OrbitCamera],
        background: Float[Tensor, " 3"],
        means2d_offsets: Float[Tensor, "b n 2"] | None = None,
    ) -> Rendering:
        """Render every camera's picture, differentiable in the Gaussians.

        Args:
            gaussians: one cloud for all cameras (fields "n 3"), or one state per camera (fields "b n 3").
            cameras: b cameras of one width and height.
            background: color behind everything.
            means2d_offsets: zeros that are added to the projected centers, in pixels; their gradient is what density
                control reads. Backends may assume that they are zero.

        Raises:
            BadInput: no cameras, cameras of different sizes, another number of states than of cameras, or Gaussians
                with numbers that are not finite.
        """
        ...


_BACKENDS = {
    "reference": "dg4d_lib.rasterizer.reference",
    "cpu": "dg4d_lib.rasterizer.cpu",
    "cuda_gsplat": "dg4d_lib.rasterizer.cuda_gsplat",
}


def get_rasterizer(name: str) -> Rasterizer:
    """The backend of this name, or the one that `auto` stands for here.

    Raises:
        BadInput: the name is not known.
        BackendUnavailable: it is known but cannot run here.
    """
    name = backend_name(name)
    if name not in _BACKENDS:
        raise BadInput(f"rasterizer {name!r} is not known; choose one of auto, {', '.join(_BACKENDS)}")
    require_backend(name)
    if name == CUDA and not torch.cuda.is_available():
        raise BackendUnavailable(
            f"rasterizer {name!r} cannot run here: torch {torch.__version__} cannot use the GPU (often the driver is "
            "too old; python -c 'import torch; torch.cuda.init()' says what is wrong); or choose rasterizer=cpu"
        )
    try:
        backend: Rasterizer = import_module(_BACKENDS[name]).rasterize
    except ImportError as error:
        raise BackendUnavailable(f"rasterizer {name!r} cannot run here: {error}") from error
    return backend


def preferred_device(name: str) -> torch.device:
    """Where Gaussians should lie that this backend draws often; elsewhere they are moved for every call, or refused."""
    return torch.device("cuda" if backend_name(name) == CUDA else "cpu")


def shared_size(cameras: Sequence[OrbitCamera]) -> tuple[int, int]:
    """Height and width that all cameras have in common, pixels.

    Raises:
        BadInput: no cameras, or cameras of different sizes.
    """
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise BadInput(f"cameras of one rendering must have one size; given {sorted(sizes) or 'no camera'}")
    return sizes.pop()


def has_state_per_camera(gaussians: Gaussians, cameras: Sequence[OrbitCamera]) -> bool:
    """Whether the cloud has a state of its own for every camera, rather than one for all.

    Raises:
        BadInput: it has several states, but not as many as there are cameras.
    """
    shape = gaussians.means.shape
    if shape[:-2] not in ((), (len(cameras),)):
        raise BadInput(
            f"{len(cameras)} cameras need Gaussians of one state (n 3) or of {len(cameras)} states; "
            f"given means of shape {tuple(shape)}"
        )
    return len(shape) == 3


def require_finite(gaussians: Gaussians) -> None:
    """Refuse a cloud with numbers that are none.

    One sum per field instead of a test per number: a sum is finite unless a number is not, or all are beyond use. On
    the processor NumPy adds them up: torch wakes its threads for it, which takes ten times as long.

    Raises:
        BadInput: says which fields hold how many.
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
            f"{len(gaussians)} Gaussians with numbers that are not finite ({counts}) cannot be drawn; remove the "
            "broken ones, or look for what made them"
        )
