"""Salient-object segmentation networks in ONNX format, run with onnxruntime on the CPU."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from torch import Tensor

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.images import resize_planes
from dg4d_lib.video.backdrop import border_ring

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

MODEL = "onnx/model.onnx"  # in a folder of weights, as the ONNX exports on the hub are laid out
PREPROCESSING = "preprocessor_config.json"  # beside it, in the format of transformers
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DEFAULT_SIDE = 1024  # pixels, for models of any input size whose configuration names none
LARGEST_SIDE = 4096  # pixels
MIN_AREA = 0.005  # minimum share of a frame that a subject covers
BORDER_MARGIN = 0.02  # share of the border by which one mask may touch more of it than another and still be preferred
ERRORS_ONLY = 3  # onnxruntime's log level


@dataclass(frozen=True)
class Preprocessing:
    """Input of a network: (255 * scale * color - mean) / std at a square size.

    Attributes:
        mean: per channel.
        std: per channel.
        scale: factor on colors in [0, 255].
        side: pixels; 0 if the model itself fixes it.
    """

    mean: tuple[float, ...] = IMAGENET_MEAN
    std: tuple[float, ...] = IMAGENET_STD
    scale: float = 1 / 255
    side: int = 0


@runtime_checkable
class Segmentation(Protocol):
    """Segmentation of the salient object of a picture."""

    def probability(self, picture: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
        """Return the probability of every pixel of an sRGB picture in [0, 1]."""
        ...


@dataclass(frozen=True)
class SegmentationNetwork:
    """Network that maps a picture to the probability that a pixel belongs to the salient object.

    Attributes:
        session: of onnxruntime.
        preprocessing: of its input.
        side: pixels of its square input.
    """

    session: "InferenceSession"
    preprocessing: Preprocessing
    side: int

    def probability(self, picture: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
        """Return the probability of every pixel of an sRGB picture in [0, 1]."""
        config = self.preprocessing
        small = resize_planes(picture.permute(2, 0, 1)[None].cpu(), (self.side, self.side)).clamp(0, 1)
        mean, std = (torch.tensor(values)[None, :, None, None] for values in (config.mean, config.std))
        planes = ((255 * config.scale * small - mean) / std).float().numpy()
        (answer,) = self.session.run([self.session.get_outputs()[0].name], {self.session.get_inputs()[0].name: planes})
        found = _probability(np.asarray(answer, np.float32))
        height, width = picture.shape[:2]
        return resize_planes(torch.from_numpy(found)[None, None], (height, width))[0, 0].clamp(0, 1)


def overlap(one: Bool[Tensor, "*s"], other: Bool[Tensor, "*s"]) -> float:
    """Return the intersection of two masks over their union; 1 if both are empty."""
    union = int((one | other).sum())
    return int((one & other).sum()) / union if union else 1.0


def border_contact(masks: Bool[Tensor, "t h w"]) -> float:
    """Return the share of the frames' border that masks cover."""
    return float(masks[:, torch.from_numpy(border_ring(*masks.shape[1:]))].float().mean())


def load_network(content: bytes, what: str, preprocessing: Preprocessing = Preprocessing()) -> SegmentationNetwork:
    """Load a network from the bytes of an ONNX file.

    Args:
        content: of the file.
        what: name of the network in messages.
        preprocessing: of its input.

    Raises:
        BackendUnavailable: onnxruntime is not installed.
        BadInput: the file is not an ONNX model, or does not map one picture to one map.
    """
    try:
        import onnxruntime  # noqa: PLC0415 - takes a fifth of a second, and plain backdrops need no network
    except ModuleNotFoundError as error:
        raise BackendUnavailable(f"{what} needs the package onnxruntime; run `make setup`") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.inter_op_num_threads = 1
    options.log_severity_level = ERRORS_ONLY
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises a class of its own for every status
        raise BadInput(
            f"{what} is not an ONNX model that can be read ({type(error).__name__}); pull it again"
        ) from error
    inputs, outputs = session.get_inputs(), session.get_outputs()
    shape: list[Any] = inputs[0].shape if len(inputs) == 1 else []
    if len(shape) != 4 or shape[1] not in (3, "channels", None) or not outputs or inputs[0].type != "tensor(float)":
        raise BadInput(
            f"{what} is not a segmentation network: expected one input of form [1, 3, height, width] in float32, found "
            f"{[(one.name, one.type, one.shape) for one in inputs]}"
        )
    side = shape[2] if isinstance(shape[2], int) else preprocessing.side or DEFAULT_SIDE
    if not 16 <= side <= LARGEST_SIDE:
        raise BadInput(f"{what} takes pictures of {side} pixels; 16 to {LARGEST_SIDE} are allowed")
    return SegmentationNetwork(session, preprocessing, side)


def load_folder(folder: Path) -> SegmentationNetwork:
    """Load a network from a folder with `onnx/model.onnx` and, optionally, `preprocessor_config.json`.

    Raises:
        BackendUnavailable: onnxruntime is not installed.
        BadInput: a file is missing or has another form.
    """
    model = folder if folder.is_file() else folder / MODEL
    if not model.is_file():
        raise BadInput(f"{folder} has no {MODEL}; give a folder with a segmentation network in ONNX format")
    config = model.parent.parent / PREPROCESSING if folder.is_dir() else None
    preprocessing = read_preprocessing(config) if config is not None and config.is_file() else Preprocessing()
    return load_network(model.read_bytes(), model.name, preprocessing)


def read_preprocessing(path: Path) -> Preprocessing:
    """Read the preprocessing from a configuration in the format of transformers.

    Raises:
        BadInput: it cannot be read, or holds numbers that cannot be used.
    """
    try:
        config: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        mean: tuple[float, ...] = (0.0,) * 3
        std: tuple[float, ...] = (1.0,) * 3
        if config.get("do_normalize", True):
            mean = tuple(float(value) for value in config.get("image_mean", IMAGENET_MEAN))
            std = tuple(float(value) for value in config.get("image_std", IMAGENET_STD))
        scale = float(config.get("rescale_factor", 1 / 255)) if config.get("do_rescale", True) else 1.0
        size = config.get("size", 0)
        side = int(size.get("height", 0) if isinstance(size, dict) else size)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise BadInput(f"{path.name} cannot be read as a preprocessing configuration: {error}") from error
    if len(mean) != 3 or len(std) != 3 or not np.isfinite([*mean, *std, scale]).all() or min(std) <= 0:
        raise BadInput(f"{path.name} has mean {mean}, std {std} and scale {scale}; expected three finite numbers each")
    return Preprocessing(mean, std, scale, side)


def _probability(answer: Float[ndarray, "..."]) -> Float[ndarray, "h w"]:
    """Return an output as probabilities; outputs beyond [0, 1] are logits."""
    found = answer.reshape(-1, *answer.shape[-2:])[0] if answer.ndim >= 2 else answer.reshape(1, -1)
    if not np.isfinite(found).all():
        raise BadInput("the segmentation network answered with numbers that are not finite; pull its weights again")
    if found.min() < -1e-3 or found.max() > 1 + 1e-3:
        found = 1 / (1 + np.exp(-found.clip(-60, 60)))
    return np.ascontiguousarray(found.clip(0, 1), np.float32)
