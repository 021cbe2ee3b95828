"""Distances of films by what I3D, a network that names actions, says of them (Carreira and Zisserman 2017).

Two numbers go by the name FVD. The one of Unterthiner et al. 2018 is between two crowds of films and needs more of them
than the network has outputs. The one that was published with Consistent4D is between two single films.
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

SIZE = 224  # pixels of the frames that I3D sees
SHORTEST = 10  # frames; shorter films vanish on their way through the network


def load_i3d(place: Path, device: torch.device) -> Any:
    """I3D with 400 actions as a TorchScript file, the form in which FVD codes share it; a file, or a folder with one.

    Raises:
        BadInput: it cannot be read.
    """
    file = place
    if place.is_dir():
        found = sorted(place.glob("*.pt"))
        if not found:
            raise BadInput(f"{place} has no TorchScript file (.pt)")
        file = found[0]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # the file exists in this form only
            return torch.jit.load(str(file), map_location=device).eval()
    except (RuntimeError, ValueError, OSError) as error:
        raise BadInput(f"{file} is no TorchScript file: {error}".splitlines()[0]) from error


def logits(i3d: Any, film: Float[Tensor, "t h w 3"], device: torch.device) -> Float[Tensor, " d"]:
    """What the network says of one square film in [0, 1], before the softmax.

    Raises:
        BadInput: the film is too short.
    """
    if len(film) < SHORTEST:
        raise BadInput(f"I3D needs films of {SHORTEST} frames or more; this one has {len(film)}")
    frames = resize_square(film.to(device), SIZE)
    with torch.no_grad():
        found: Tensor = i3d(2 * frames.permute(3, 0, 1, 2)[None] - 1, rescale=False, resize=False, return_features=True)
    return found.reshape(-1)


def fvd_consistent4d(a: Float[Tensor, " d"], b: Float[Tensor, " d"]) -> Float[Tensor, ""]:
    """The "FVD" of two single films that Consistent4D, and papers that compare themselves with it, report.

    |a - b|^2 + (std a - std b)^2: the Frechet formula, with the spread of one film's outputs in place of a covariance
    over films (the published code calls numpy.cov with one row, which NumPy before 2.2 took for 400 observations).
    """
    return (a - b).square().sum() + (a.std() - b.std()).square()


def frechet_distance(a: Float[Tensor, "n d"], b: Float[Tensor, "m d"]) -> Float[Tensor, ""]:
    """The distance of two normal distributions with the means and covariances of two crowds: FVD, for I3D's outputs.

    |mean a - mean b|^2 + tr(A + B - 2 (A B)^(1/2)). The trace of the root is the sum of the singular values of the
    product of the centered crowds, so no root of a matrix is taken. In double precision.

    Raises:
        BadInput: as few films as numbers per film, or fewer: covariances would say more of the samples than of films.
    """
    size = a.shape[1]
    if min(len(a), len(b)) <= size:
        raise BadInput(
            f"FVD needs more films than I3D has outputs: more than {size} on either side; given {len(a)} and {len(b)}"
        )
    a, b = a.double(), b.double()
    spread_a, spread_b = ((crowd - crowd.mean(0)) / (len(crowd) - 1) ** 0.5 for crowd in (a, b))
    root = torch.linalg.matrix_norm(spread_a @ spread_b.mT, "nuc")
    return (a.mean(0) - b.mean(0)).square().sum() + spread_a.square().sum() + spread_b.square().sum() - 2 * root


def fvd(films: Sequence[Sequence[float]], truth: Sequence[Sequence[float]]) -> float:
    """The Frechet distance of the outputs of many films, as they stand in score files; raises as that does."""
    return float(frechet_distance(torch.tensor(films, dtype=torch.float64), torch.tensor(truth, dtype=torch.float64)))
