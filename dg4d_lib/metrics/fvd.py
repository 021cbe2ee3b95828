"""Frechet video distance (FVD) on the logits of I3D, an action classifier (Carreira and Zisserman 2017).

Two metrics are called FVD. That of Unterthiner et al. 2018 compares two sets of videos and needs more videos than the
network has outputs. That published with Consistent4D compares two single videos.
"""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.metrics.image import resize_square

SIZE = 224  # pixels of I3D's input
MIN_FRAMES = 10  # shorter videos have no frames left after I3D's temporal pooling


def load_i3d(path: Path, device: torch.device) -> Any:
    """Load I3D with 400 classes from a TorchScript file, as shared by FVD implementations, or a folder with one.

    Raises:
        BadInput: the file is missing or cannot be read.
    """
    file = path
    if path.is_dir():
        files = sorted(path.glob("*.pt"))
        if not files:
            raise BadInput(f"{path} has no TorchScript file (.pt)")
        file = files[0]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore", DeprecationWarning
            )  # TorchScript is deprecated, but I3D is published in no other format
            return torch.jit.load(str(file), map_location=device).eval()
    except (RuntimeError, ValueError, OSError) as error:
        raise BadInput(f"{file} is not a TorchScript file: {error}".splitlines()[0]) from error


def logits(i3d: Any, video: Float[Tensor, "t h w 3"], device: torch.device) -> Float[Tensor, " d"]:
    """Return I3D's logits of one square video in [0, 1].

    Raises:
        BadInput: the video is too short.
    """
    if len(video) < MIN_FRAMES:
        raise BadInput(f"I3D needs videos of {MIN_FRAMES} frames or more; given {len(video)}")
    frames = resize_square(video.to(device), SIZE)
    with torch.no_grad():
        outputs: Tensor = i3d(
            2 * frames.permute(3, 0, 1, 2)[None] - 1, rescale=False, resize=False, return_features=True
        )
    return outputs.reshape(-1)


def fvd_consistent4d(a: Float[Tensor, " d"], b: Float[Tensor, " d"]) -> Float[Tensor, ""]:
    """Return the "FVD" of two single videos as reported by Consistent4D and papers that compare with it.

    |a - b|^2 + (std a - std b)^2: the Frechet formula with the variance of one video's logits in place of a covariance
    over videos (the published code calls numpy.cov with one row, which NumPy before 2.2 treated as 400 observations).
    """
    return (a - b).square().sum() + (a.std() - b.std()).square()


def frechet_distance(a: Float[Tensor, "n d"], b: Float[Tensor, "m d"]) -> Float[Tensor, ""]:
    """Return the Frechet distance of two sets of feature vectors; for I3D's logits it is FVD.

    |mean a - mean b|^2 + tr(A + B - 2 (A B)^(1/2)). The trace of the root is the nuclear norm of the product of the
    centered sets, so no matrix root is computed. Double precision.

    Raises:
        BadInput: not more vectors than dimensions, so that the covariances would be singular.
    """
    size = a.shape[1]
    if min(len(a), len(b)) <= size:
        raise BadInput(
            f"FVD needs more videos than I3D has outputs: more than {size} on each side; given {len(a)} and {len(b)}"
        )
    a, b = a.double(), b.double()
    centered_a, centered_b = ((rows - rows.mean(0)) / (len(rows) - 1) ** 0.5 for rows in (a, b))
    root = torch.linalg.matrix_norm(centered_a @ centered_b.mT, "nuc")
    return (a.mean(0) - b.mean(0)).square().sum() + centered_a.square().sum() + centered_b.square().sum() - 2 * root


def fvd(videos: Sequence[Sequence[float]], ground_truth: Sequence[Sequence[float]]) -> float:
    """Return the Frechet distance of the logits of two sets of videos; raises as `frechet_distance`."""
    ours, theirs = (torch.tensor(rows, dtype=torch.float64) for rows in (videos, ground_truth))
    return float(frechet_distance(ours, theirs))
