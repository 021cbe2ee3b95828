"""The parts of a pretrained pipeline, read from the folder of a model in diffusers' layout, frozen.

    model/
      vae/           config.json, diffusion_pytorch_model.safetensors (or .fp16.safetensors, .bin, .fp16.bin)
      unet/          the same
      image_encoder/ config.json, model.safetensors (or .fp16.safetensors), pytorch_model.bin (or .fp16.bin)
      scheduler/     scheduler_config.json

Nothing of a folder is executed: classes come from diffusers and transformers, tensors from the files.
"""

from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from dg4d_lib.diffusion.flop_counter import attach_flop_counter
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.settings import Precision

DTYPES: dict[Precision, torch.dtype] = {"fp16": torch.float16, "bf16": torch.bfloat16, "fp32": torch.float32}

DIFFUSERS_FILE, TRANSFORMERS_FILES = "diffusion_pytorch_model", ("model", "pytorch_model")
HALF = "fp16"  # the variant of a file whose tensors are stored in half precision
UNREADABLE = (OSError, EOFError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError, UnpicklingError)


@dataclass(frozen=True)
class Placement:
    """Where and how the weights of a part lie.

    Attributes:
        device: of every tensor.
        dtype: of every floating tensor.
        channels_last: convolutions get their tensors with the channels innermost, as GPUs like it in half precision.
    """

    device: torch.device
    dtype: torch.dtype
    channels_last: bool = False


def compute_dtype(device: torch.device, precision: Precision) -> torch.dtype:
    """The numbers that networks compute with: what the settings say, and fp32 on a processor, which is slow in half."""
    return torch.float32 if device.type == "cpu" else DTYPES[precision]


def default_device() -> torch.device:
    """Where networks run: the first CUDA device, or the processor."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def load_vae(model: Path, placement: Placement) -> Any:
    """The AutoencoderKL of `model`/vae.

    Raises:
        BadInput: a file is missing, damaged, or holds other tensors than its config says.
        BackendUnavailable: diffusers is not installed.
    """
    return load_component(_diffusers().AutoencoderKL, model / "vae", placement)


def load_unet(model: Path, placement: Placement) -> Any:
    """The UNet2DConditionModel of `model`/unet; raises as `load_vae`."""
    return load_component(_diffusers().UNet2DConditionModel, model / "unet", placement)


def load_temporal_vae(model: Path, placement: Placement) -> Any:
    """The AutoencoderKLTemporalDecoder of `model`/vae, for videos; raises as `load_vae`."""
    return load_component(_diffusers().AutoencoderKLTemporalDecoder, model / "vae", placement)


def load_temporal_unet(model: Path, placement: Placement) -> Any:
    """The UNetSpatioTemporalConditionModel of `model`/unet, for videos; raises as `load_vae`."""
    return load_component(_diffusers().UNetSpatioTemporalConditionModel, model / "unet", placement)


def load_image_encoder(model: Path, placement: Placement) -> Any:
    """The CLIPVisionModelWithProjection of `model`/image_encoder; raises as `load_vae`."""
    try:
        from transformers import CLIPVisionModelWithProjection  # noqa: PLC0415 - takes seconds
        from transformers.utils.logging import disable_progress_bar  # noqa: PLC0415
    except ImportError as error:
        raise missing_packages(error) from error
    disable_progress_bar()
    return load_component(CLIPVisionModelWithProjection, model / "image_encoder", placement, TRANSFORMERS_FILES)


def load_component(kind: Any, folder: Path, placement: Placement, names: tuple[str, ...] = (DIFFUSERS_FILE,)) -> Any:
    """A model of a class of diffusers or transformers, in evaluation mode and without weight gradients.

    Args:
        kind: the class.
        folder: its config.json and its tensors.
        placement: where and how it lies; the half-precision variant of a file is read where half precision is asked
            for or there is no other.
        names: what the file may be called, without variant and suffix.

    Raises:
        BadInput: a file is missing, damaged, or holds other tensors than its config says.
    """
    if not (folder / "config.json").is_file():
        raise BadInput(f"{folder} has no config.json; weights are expected in the layout of diffusers")
    file = weights_file(folder, names, half=placement.dtype == torch.float16)
    try:
        part, about = kind.from_pretrained(
            folder,
            variant=HALF if file.stem.endswith(f".{HALF}") else None,
            use_safetensors=file.suffix == ".safetensors",
            local_files_only=True,
            output_loading_info=True,
            dtype=placement.dtype,
        )
    except UNREADABLE as error:
        raise BadInput(f"{file} cannot be read: {_first_line(error)}") from error
    lacking = sorted(map(str, about["missing_keys"])) + sorted(map(str, about["mismatched_keys"]))
    if lacking:
        raise BadInput(
            f"{file} does not fit its config.json: {len(lacking)} tensors are missing or of another shape, "
            f"the first is {lacking[0]}"
        )
    return attach_flop_counter(frozen(part, placement))


def weights_file(folder: Path, names: tuple[str, ...] = (DIFFUSERS_FILE,), half: bool = False) -> Path:
    """The file of tensors to read: safetensors before pickles, and of the precision that is wanted if there is one.

    Args:
        folder: of the part.
        names: what the file may be called, without variant and suffix.
        half: whether the half-precision variant is preferred.

    Raises:
        BadInput: there is none.
    """
    variants = (f".{HALF}", "") if half else ("", f".{HALF}")
    candidates = [
        folder / f"{name}{variant}{suffix}"
        for suffix in (".safetensors", ".bin")
        for variant in variants
        for name in names
    ]
    for file in candidates:
        if file.is_file():
            return file
    raise BadInput(f"{folder} has no tensors; expected one of: {', '.join(file.name for file in candidates)}")


def read_tensors(file: Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file, or of a pickle that holds nothing else.

    Raises:
        BadInput: the file cannot be read.
    """
    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        return dict(torch.load(file, map_location="cpu", weights_only=True))
    except UNREADABLE as error:
        raise BadInput(f"{file} cannot be read: {_first_line(error)}") from error


def read_linear(folder: Path, name: str, placement: Placement) -> nn.Linear:
    """A linear layer of any size out of NAME.weight and NAME.bias.

    Raises:
        BadInput: no file, or one that holds something else.
    """
    file = weights_file(folder)
    tensors = read_tensors(file)
    weight, bias = tensors.get(f"{name}.weight"), tensors.get(f"{name}.bias")
    if weight is None or bias is None or weight.ndim != 2 or bias.shape != weight.shape[:1]:
        shapes = {key: tuple(value.shape) for key, value in tensors.items()}
        raise BadInput(f"{file} is no linear layer {name}.weight, {name}.bias; it has {shapes}")
    layer = nn.Linear(weight.shape[1], weight.shape[0], device="meta")
    layer.load_state_dict({"weight": weight.to(placement.dtype), "bias": bias.to(placement.dtype)}, assign=True)
    return frozen(layer, placement)


def missing_packages(error: ImportError) -> BackendUnavailable:
    """What to raise where diffusers or transformers cannot be imported."""
    return BackendUnavailable(
        f"diffusion models need packages that are not installed ({error}); run `make setup CUDA=1`"
    )


def frozen(part: Any, placement: Placement) -> Any:
    """The part in evaluation mode, without weight gradients, at its place."""
    part = part.eval().requires_grad_(False).to(placement.device)
    return part.to(memory_format=torch.channels_last) if placement.channels_last else part


def _diffusers() -> Any:
    try:
        import diffusers  # noqa: PLC0415 - takes seconds
    except ImportError as error:
        raise missing_packages(error) from error
    return diffusers


def _first_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]
