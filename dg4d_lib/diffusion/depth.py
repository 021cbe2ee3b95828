"""Monocular depth by a network in transformers' layout (Depth Anything V2, Yang et al. 2024)."""

import json
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.components import TRANSFORMERS_FILES, Placement, load_component, missing_packages
from dg4d_lib.errors import BadInput
from dg4d_lib.images import over_white, resize_planes

SIDE = 518  # pixels of the network's input (published preprocessor)
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
PREPROCESSOR = "preprocessor_config.json"


class DepthEstimator:
    """Depth network; its output grows towards the camera, up to an unknown scale and offset."""

    def __init__(self, network: torch.nn.Module, side: int, device: torch.device) -> None:
        """Store a loaded network and the side of its input, pixels."""
        self._network, self._side, self._device = network, side, device

    @classmethod
    def load(cls, model: Path, device: torch.device) -> "DepthEstimator":
        """Load the network of a folder.

        Raises:
            BadInput: a file is missing, damaged, or of another model.
            BackendUnavailable: transformers is not installed.
        """
        try:
            from transformers import AutoModelForDepthEstimation  # noqa: PLC0415 - takes seconds
        except ImportError as error:
            raise missing_packages(error) from error
        placement = Placement(device, torch.float32)
        network = load_component(AutoModelForDepthEstimation, model, placement, TRANSFORMERS_FILES)
        return cls(network, _side(model, network), device)

    @torch.no_grad()
    def disparity(self, cutout: Float[Tensor, "s s 4"]) -> Float[Tensor, "s s"]:
        """Return the relative inverse depth of a cut-out over white, larger where nearer."""
        size = cutout.shape[0]
        planes = over_white(cutout).permute(2, 0, 1)[None].float()
        small = resize_planes(planes, (self._side, self._side)).clamp(0, 1)
        mean, std = (torch.tensor(values)[None, :, None, None] for values in (MEAN, STD))
        found = self._network(((small - mean) / std).to(self._device)).predicted_depth
        return resize_planes(found[:, None].float().cpu(), (size, size))[0, 0]


def _side(model: Path, network: torch.nn.Module) -> int:
    """Return the side of the input that the preprocessor gives, a multiple of the network's patches."""
    side = SIDE
    path = model / PREPROCESSOR
    if path.is_file():
        try:
            side = int(json.loads(path.read_text(encoding="utf-8"))["size"]["height"])
        except (ValueError, KeyError, TypeError) as error:
            raise BadInput(f"{path} gives no size ({type(error).__name__}); download the model again") from error
    patch = int(getattr(network.config, "patch_size", 0) or 14)
    return max(patch, side // patch * patch)
