"""LPIPS with VGG16 (Zhang et al. 2018, version 0.1): how differently a trained network sees two pictures.

The network is read from published files: the convolutions of VGG16 as torchvision names them, and the weights of its
five stages (`lin0.model.1.weight` ...) as the authors' package has them.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional as F

from dg4d_lib.errors import BadInput

STAGES = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))  # numbers of VGG16's convolutions
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of colors in [-1, 1] (the authors' code)
SMALLEST_NORM = 1e-10
PICTURES_AT_ONCE = 4  # of 512 pixels they take half a gigabyte
FORMATS = (".safetensors", ".pth", ".bin")  # wanted most first

Convolution = tuple[Tensor, Tensor]  # weight, bias


@dataclass(frozen=True)
class Lpips:
    """The distance; call it with pictures in [0, 1].

    Attributes:
        stages: the convolutions before every place where pictures are compared.
        heads: how much every channel counts there; a vector per stage.
    """

    stages: tuple[tuple[Convolution, ...], ...]
    heads: tuple[Tensor, ...]

    def __call__(self, images: Float[Tensor, "b h w 3"], truth: Float[Tensor, "b h w 3"]) -> Float[Tensor, " b"]:
        """The distance of every pair, 0 for equal ones; on the device of the network, without gradients."""
        parts = zip(images.split(PICTURES_AT_ONCE), truth.split(PICTURES_AT_ONCE), strict=True)
        with torch.no_grad():
            return torch.cat([self._distance(ours, theirs) for ours, theirs in parts])

    def _distance(self, images: Float[Tensor, "b h w 3"], truth: Float[Tensor, "b h w 3"]) -> Float[Tensor, " b"]:
        pictures = torch.cat([images, truth]).to(self.heads[0]).movedim(-1, 1)
        shift, scale = (pictures.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        features = (2 * pictures - 1 - shift) / scale
        total = features.new_zeros(len(images))
        for number, (stage, head) in enumerate(zip(self.stages, self.heads, strict=True)):
            features = F.max_pool2d(features, 2) if number else features
            for weight, bias in stage:
                features = F.conv2d(features, weight, bias, padding=1).relu()
            directions = features / (features.norm(dim=1, keepdim=True) + SMALLEST_NORM)
            ours, theirs = directions.chunk(2)
            total = total + ((ours - theirs).square() * head[:, None, None]).sum(1).mean((1, 2))
        return total


def load_lpips(vgg: Path, heads: Path, device: torch.device) -> Lpips:
    """The distance with published weights.

    Args:
        vgg: the tensors of VGG16, as torchvision's `vgg16-397923af.pth` has them; a file, or a folder with one.
        heads: the weights of its stages, as `vgg.pth` of the package lpips has them; a file, or a folder with one.
        device: where to compute.

    Raises:
        BadInput: a file cannot be read, or lacks tensors.
    """
    convolutions, weights = _tensors(vgg), _tensors(heads)
    try:
        return Lpips(
            stages=tuple(
                tuple(
                    (convolutions[f"features.{k}.weight"].to(device), convolutions[f"features.{k}.bias"].to(device))
                    for k in stage
                )
                for stage in STAGES
            ),
            heads=tuple(weights[f"lin{k}.model.1.weight"].flatten().to(device) for k in range(len(STAGES))),
        )
    except KeyError as error:
        raise BadInput(f"{vgg} and {heads} are not VGG16 and its LPIPS weights: there is no tensor {error}") from error


def _tensors(place: Path) -> dict[str, Tensor]:
    file = place
    if place.is_dir():
        found = [path for suffix in FORMATS for path in sorted(place.glob(f"*{suffix}"))]
        if not found:
            raise BadInput(f"{place} has no tensors ({', '.join(FORMATS)})")
        file = found[0]
    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        return dict(torch.load(file, map_location="cpu", weights_only=True))
    except Exception as error:  # whatever a damaged file makes a reader raise
        raise BadInput(f"{file} cannot be read: {type(error).__name__}: {error}".splitlines()[0]) from error
