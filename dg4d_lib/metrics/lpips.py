"""LPIPS with VGG16: perceptual distance of images (Zhang et al. 2018, version 0.1).

Weights are read from the published files: the convolutions of VGG16 under torchvision's names, and the linear heads of
its five stages (`lin0.model.1.weight` ...) as in the authors' package.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional as F

from dg4d_lib.errors import BadInput

STAGES = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))  # indices of VGG16's convolutions
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of colors in [-1, 1] (authors' code)
NORM_EPS = 1e-10  # authors' code
BATCH = 4  # images; 0.5 GB at 512 pixels
FORMATS = (".safetensors", ".pth", ".bin")  # preferred first

Convolution = tuple[Tensor, Tensor]  # weight, bias


@dataclass(frozen=True)
class Lpips:
    """LPIPS distance, callable on images in [0, 1].

    Attributes:
        stages: convolutions of every stage of VGG16.
        heads: weights of the channels, a vector per stage.
    """

    stages: tuple[tuple[Convolution, ...], ...]
    heads: tuple[Tensor, ...]

    def __call__(self, images: Float[Tensor, "b h w 3"], ground_truth: Float[Tensor, "b h w 3"]) -> Float[Tensor, " b"]:
        """Return the distance of every pair, 0 for equal images; on the device of the network, without gradients."""
        parts = zip(images.split(BATCH), ground_truth.split(BATCH), strict=True)
        with torch.no_grad():
            return torch.cat([self._distance(ours, theirs) for ours, theirs in parts])

    def _distance(
        self, images: Float[Tensor, "b h w 3"], ground_truth: Float[Tensor, "b h w 3"]
    ) -> Float[Tensor, " b"]:
        planes = torch.cat([images, ground_truth]).to(self.heads[0]).movedim(-1, 1)
        shift, scale = (planes.new_tensor(values)[:, None, None] for values in (SHIFT, SCALE))
        features = (2 * planes - 1 - shift) / scale
        total = features.new_zeros(len(images))
        for number, (stage, head) in enumerate(zip(self.stages, self.heads, strict=True)):
            features = F.max_pool2d(features, 2) if number else features
            for weight, bias in stage:
                features = F.conv2d(features, weight, bias, padding=1).relu()
            directions = features / (features.norm(dim=1, keepdim=True) + NORM_EPS)
            ours, theirs = directions.chunk(2)
            total = total + ((ours - theirs).square() * head[:, None, None]).sum(1).mean((1, 2))
        return total


def load_lpips(vgg: Path, heads: Path, device: torch.device) -> Lpips:
    """Load LPIPS with published weights.

    Args:
        vgg: VGG16 with the tensor names of torchvision's `vgg16-397923af.pth`; a file, or a folder with one.
        heads: linear heads with the names of `vgg.pth` of the package lpips; a file, or a folder with one.
        device: of the networks.

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
        raise BadInput(f"{vgg} and {heads} are not VGG16 and its LPIPS heads: tensor {error} is missing") from error


def _tensors(path: Path) -> dict[str, Tensor]:
    file = path
    if path.is_dir():
        files = [file for suffix in FORMATS for file in sorted(path.glob(f"*{suffix}"))]
        if not files:
            raise BadInput(f"{path} has no tensors ({', '.join(FORMATS)})")
        file = files[0]
    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        return dict(torch.load(file, map_location="cpu", weights_only=True))
    except Exception as error:  # readers raise many types for damaged files
        raise BadInput(f"{file} cannot be read: {type(error).__name__}: {error}".splitlines()[0]) from error
