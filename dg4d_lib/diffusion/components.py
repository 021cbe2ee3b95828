"""Loading of pipeline components from a model folder in diffusers' layout, frozen.

    model/
      vae/           config.json, diffusion_pytorch_model.safetensors (or .fp16.safetensors, .bin, .fp16.bin), or
                     shards of it with an index, diffusion_pytorch_model.safetensors.index.json (or .index.fp16.json)
      unet/          the same
      image_encoder/ config.json, model.safetensors (or .fp16.safetensors), pytorch_model.bin (or .fp16.bin)
      scheduler/     scheduler_config.json

No code of a folder is executed: classes come from diffusers and transformers, tensors from the files.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from dg4d_lib.diffusion.flop_counter import attach_flop_counter
from dg4d_lib.errors import BackendUnavailable, BadInput, quoted
from dg4d_lib.settings import Precision

DTYPES: dict[Precision, torch.dtype] = {"fp16": torch.float16, "bf16": torch.bfloat16, "fp32": torch.float32}

DIFFUSERS_FILE, TRANSFORMERS_FILES = "diffusion_pytorch_model", ("model", "pytorch_model")
HALF = "fp16"  # variant of files in half precision
UNREADABLE = (OSError, EOFError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError, UnpicklingError)


@dataclass(frozen=True)
class Placement:
    """Device, precision and memory format of a component.

    Attributes:
        device: of every tensor.
        dtype: of every floating-point tensor.
        channels_last: memory format of convolutions; faster on GPUs in half precision.
    """

    device: torch.device
    dtype: torch.dtype
    channels_last: bool = False


def compute_dtype(device: torch.device, precision: Precision) -> torch.dtype:
    """Return the dtype of networks: that of the settings, and float32 on CPUs, which are slow in half precision."""
    return torch.float32 if device.type == "cpu" else DTYPES[precision]


def default_device() -> torch.device:
    """Return the first CUDA device, or the CPU if there is none."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def load_vae(model: Path, placement: Placement) -> Any:
    """Load the AutoencoderKL of `model`/vae.

    Raises:
        BadInput: a file is missing, damaged, or does not match its config.json.
        BackendUnavailable: diffusers is not installed.
    """
    return load_component(_diffusers().AutoencoderKL, model / "vae", placement)


def load_unet(model: Path, placement: Placement) -> Any:
    """Load the UNet2DConditionModel of `model`/unet; raises as `load_vae`."""
    return load_component(_diffusers().UNet2DConditionModel, model / "unet", placement)


def load_temporal_vae(model: Path, placement: Placement) -> Any:
    """Load the AutoencoderKLTemporalDecoder of `model`/vae, for videos; raises as `load_vae`."""
    return load_component(_diffusers().AutoencoderKLTemporalDecoder, model / "vae", placement)


def load_temporal_unet(model: Path, placement: Placement) -> Any:
    """Load the UNetSpatioTemporalConditionModel of `model`/unet, for videos; raises as `load_vae`."""
    return load_component(_diffusers().UNetSpatioTemporalConditionModel, model / "unet", placement)


def load_image_encoder(model: Path, placement: Placement) -> Any:
    """Load the CLIPVisionModelWithProjection of `model`/image_encoder; raises as `load_vae`."""
    try:
        from transformers import CLIPVisionModelWithProjection  # noqa: PLC0415 - takes seconds
        from transformers.utils.logging import disable_progress_bar  # noqa: PLC0415
    except ImportError as error:
        raise missing_packages(error) from error
    disable_progress_bar()
    return load_component(CLIPVisionModelWithProjection, model / "image_encoder", placement, TRANSFORMERS_FILES)


def load_component(cls: Any, folder: Path, placement: Placement, names: tuple[str, ...] = (DIFFUSERS_FILE,)) -> Any:
    """Load a model of a class of diffusers or transformers, in evaluation mode and without weight gradients.

    Args:
        cls: the class.
        folder: with config.json and tensors.
        placement: device, precision and memory format; the half-precision variant is read if half precision is
            requested or if there is no other.
        names: possible names of the file, without variant and suffix.

    Raises:
        BadInput: a file is missing, damaged, or does not match its config.json.
    """
    if not (folder / "config.json").is_file():
        raise BadInput(f"{folder} has no config.json; give weights in the layout of diffusers")
    file = weights_file(folder, names, half=placement.dtype == torch.float16)
    try:
        component, info = cls.from_pretrained(
            folder,
            variant=HALF if f".{HALF}" in file.suffixes else None,
            use_safetensors=".safetensors" in file.suffixes,
            local_files_only=True,
            output_loading_info=True,
            dtype=placement.dtype,
        )
    except UNREADABLE as error:
        raise BadInput(f"{file} cannot be read: {_first_line(error)}") from error
    require_all_tensors(file, info)
    return attach_flop_counter(frozen(component, placement))


def require_all_tensors(source: Path, info: Mapping[str, Any]) -> None:
    """Refuse weights that are incomplete.

    Args:
        source: file or folder, for the message.
        info: of `from_pretrained` of diffusers or transformers with `output_loading_info`.

    Raises:
        BadInput: tensors are missing or of another shape.
    """
    missing = sorted(map(str, info["missing_keys"])) + sorted(map(str, info["mismatched_keys"]))
    if missing:
        raise BadInput(
            f"{source} does not match its config.json: {len(missing)} tensors are missing or of another shape, "
            f"the first is {missing[0]}"
        )


def weights_file(folder: Path, names: tuple[str, ...] = (DIFFUSERS_FILE,), half: bool = False) -> Path:
    """Return the file of tensors to read, or the index of its shards.

    Safetensors are preferred to pickles, then the requested precision to the other, then a file to shards.

    Args:
        folder: of the component.
        names: possible names of the file, without variant and suffix.
        half: prefer the half-precision variant.

    Raises:
        BadInput: there is no such file.
    """
    variants = (f".{HALF}", "") if half else ("", f".{HALF}")
    candidates = [
        (f"{name}{variant}{suffix}", f"{name}{suffix}.index{variant}.json")
        for suffix in (".safetensors", ".bin")
        for variant in variants
        for name in names
    ]
    for file in (folder / name for pair in candidates for name in pair):
        if file.is_file():
            return file
    raise BadInput(
        f"{folder} has no tensors; expected one of: {', '.join(name for name, _ in candidates)}; or shards with an "
        f"index such as {candidates[0][1]}"
    )


def read_tensors(file: Path) -> dict[str, Tensor]:
    """Read the tensors of a safetensors file, of a pickle that holds only tensors, or of the shards of an index.

    Raises:
        BadInput: the file cannot be read.
    """
    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        if file.suffix == ".json":
            shards = sorted(set(dict(json.loads(file.read_text(encoding="utf-8"))["weight_map"]).values()))
            return {key: tensor for shard in shards for key, tensor in read_tensors(_shard(file, shard)).items()}
        tensors: dict[str, Tensor] = dict(torch.load(file, map_location="cpu", weights_only=True))
    except UNREADABLE as error:
        raise BadInput(f"{file} cannot be read: {_first_line(error)}") from error
    if other := [key for key, value in tensors.items() if not (isinstance(key, str) and isinstance(value, Tensor))]:
        raise BadInput(
            f"{file} is not a file of named tensors: {quoted(other[0])} is not a tensor; give the weights alone"
        )
    return tensors


def read_linear(folder: Path, name: str, placement: Placement) -> nn.Linear:
    """Read a linear layer from the tensors NAME.weight and NAME.bias.

    Raises:
        BadInput: the file is missing, or holds no such layer.
    """
    file = weights_file(folder)
    tensors = read_tensors(file)
    weight, bias = tensors.get(f"{name}.weight"), tensors.get(f"{name}.bias")
    if weight is None or bias is None or weight.ndim != 2 or bias.shape != weight.shape[:1]:
        shapes = {key: tuple(value.shape) for key, value in tensors.items()}
        raise BadInput(f"{file} is not a linear layer {name}.weight, {name}.bias; it has {shapes}")
    layer = nn.Linear(weight.shape[1], weight.shape[0], device="meta")
    layer.load_state_dict({"weight": weight.to(placement.dtype), "bias": bias.to(placement.dtype)}, assign=True)
    return frozen(layer, placement)


def missing_packages(error: ImportError) -> BackendUnavailable:
    """Return the error for a failed import of diffusers or transformers."""
    return BackendUnavailable(
        f"diffusion models need packages that are not installed ({error}); run `make setup CUDA=1`"
    )


def frozen(component: Any, placement: Placement) -> Any:
    """Return the component in evaluation mode, without weight gradients, on its device."""
    component = component.eval().requires_grad_(False).to(placement.device)
    return component.to(memory_format=torch.channels_last) if placement.channels_last else component


def _shard(index: Path, name: str) -> Path:
    """Return a shard beside its index."""
    if Path(name).name != name:
        raise BadInput(f"{index} names a shard outside of its folder, {quoted(name)}; download the weights again")
    return index.with_name(name)


def _diffusers() -> Any:
    try:
        import diffusers  # noqa: PLC0415 - takes seconds
    except ImportError as error:
        raise missing_packages(error) from error
    return diffusers


def _first_line(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]
