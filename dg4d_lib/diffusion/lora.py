"""LoRA adapters, merged into the weights of a network: W + scale * (alpha / rank) * up @ down (Hu et al. 2021)."""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from pydantic import BaseModel, ConfigDict, FiniteFloat
from safetensors import safe_open
from torch import Tensor, nn

from dg4d_lib.diffusion.components import read_tensors
from dg4d_lib.errors import BadInput, quoted
from dg4d_lib.weights.locate import TENSOR_SUFFIXES

PREFIXES = ("transformer.", "diffusion_model.", "model.diffusion_model.", "base_model.model.")
DOWN, UP = ("lora_A", "lora_down", "lora.down"), ("lora_B", "lora_up", "lora.up")
FACTOR = re.compile(
    rf"^(?P<layer>.+?)[._](?P<factor>{'|'.join(re.escape(name) for name in (*DOWN, *UP))})(?:\.default)?\.weight$"
)


class _Factors(NamedTuple):
    """Low-rank factors of one layer, and the scale of their product: alpha / rank."""

    down: Tensor
    up: Tensor
    scaling: float


class _Adapter(BaseModel):
    """Settings of PEFT in the metadata of a file, as `save_lora_weights` of diffusers writes them.

    Attributes:
        lora_alpha: of all layers; None: equal to their rank.
        alpha_pattern: alpha of single layers, by a pattern of the end of their names.
        use_rslora: divide alpha by the square root of the rank.
        use_dora: the factors have magnitudes beside them (Liu et al. 2024), which are not supported.
    """

    model_config = ConfigDict(frozen=True)
    lora_alpha: FiniteFloat | None = None
    alpha_pattern: dict[re.Pattern[str], FiniteFloat] = {}
    use_rslora: bool = False
    use_dora: bool = False


def merge_lora(network: nn.Module, path: Path, scale: float) -> int:
    """Add a LoRA to the weights of a network's linear layers, in place; return the number of layers.

    Args:
        network: with the layers that the file names.
        path: of the file, or a folder with one; names of PEFT, diffusers or kohya's dotted form.
        scale: strength.

    Raises:
        BadInput: the file is not a LoRA, holds more than a LoRA's factors and alphas, or belongs to another network; or
            a number in it is not finite.
    """
    file = lora_file(path)
    factors = _read_factors(file)
    layers = dict(network.named_modules())
    for name, one in factors.items():
        layer = layers.get(name)
        if not isinstance(layer, nn.Linear):
            raise BadInput(f"{file} belongs to another network: {type(network).__name__} has no linear layer {name}")
        expected = layer.out_features, layer.in_features
        if (one.up.shape[0], one.down.shape[1]) != expected or one.up.shape[1] != one.down.shape[0]:
            raise BadInput(f"{file} belongs to another network: {name} has {expected[0]} x {expected[1]} weights")
        with torch.no_grad():
            added = scale * one.scaling * (one.up.float() @ one.down.float())
            layer.weight.copy_((layer.weight.float() + added.to(layer.weight.device)).to(layer.weight.dtype))
    return len(factors)


def lora_file(path: Path) -> Path:
    """Return the file of a LoRA.

    Raises:
        BadInput: a folder has no such file, or several.
    """
    if path.is_file():
        return path
    found = sorted(one for one in path.iterdir() if one.suffix in TENSOR_SUFFIXES) if path.is_dir() else []
    if len(found) != 1:
        raise BadInput(f"{path} has {len(found)} files of tensors; a LoRA is one file: give its path")
    return found[0]


def _read_factors(file: Path) -> dict[str, _Factors]:
    tensors = read_tensors(file)
    down: dict[str, Tensor] = {}
    up: dict[str, Tensor] = {}
    others: list[str] = []
    for key, tensor in tensors.items():
        if (found := FACTOR.match(key)) is not None:
            (down if found["factor"] in DOWN else up)[found["layer"]] = tensor
        elif not key.endswith(".alpha") or tensor.numel() != 1:
            others.append(key)
    if not down or set(down) != set(up) or any(one.ndim != 2 for one in (*down.values(), *up.values())):
        raise BadInput(f"{file} is not a LoRA of linear layers; give one that was made for this network")
    adapter = _read_adapter(file)
    if others or adapter.use_dora:
        rest = f"{quoted(min(others))} ({len(others)} such tensors)" if others else "use_dora in its metadata"
        raise BadInput(
            f"{file} is more than a LoRA: {rest} cannot be merged; give a LoRA of factors and alphas alone, without "
            "DoRA, biases, LoKr or full differences"
        )
    # torch has no isfinite for float8
    if broken := sorted(key for key, tensor in tensors.items() if not tensor.float().isfinite().all()):
        raise BadInput(f"{file} is damaged: {broken[0]} has values that are not finite; download or train it again")
    factor_count = sum(FACTOR.match(key) is not None for key in tensors)
    if factor_count != 2 * len({_layer_name(name) for name in down}):
        raise BadInput(f"{file} holds several factors of one layer, in several spellings; save one LoRA per file")
    return {
        _layer_name(name): _Factors(down[name], up[name], _scaling(tensors, adapter, name, down[name].shape[0]))
        for name in down
    }


def _layer_name(name: str) -> str:
    """Return the name of a layer in the network of diffusers."""
    for prefix in PREFIXES:
        name = name.removeprefix(prefix)
    return name


def _read_adapter(file: Path) -> _Adapter:
    if file.suffix != ".safetensors":
        return _Adapter()
    with safe_open(file, "pt") as opened:
        stored = (opened.metadata() or {}).get("lora_adapter_metadata", "{}")
    try:
        return _Adapter.model_validate({_layer_name(key): value for key, value in json.loads(stored).items()})
    except (ValueError, AttributeError) as error:
        raise BadInput(
            f"lora_adapter_metadata in {file} cannot be read; save the LoRA again with save_lora_weights of diffusers"
        ) from error


def _scaling(tensors: Mapping[str, Tensor], adapter: _Adapter, name: str, rank: int) -> float:
    """Return alpha / rank of a layer: from its tensor of alpha, else from the settings of PEFT, else 1."""
    if (alpha := tensors.get(f"{name}.alpha")) is not None:
        return float(alpha) / rank
    layer = _layer_name(name)
    own = (given for end, given in adapter.alpha_pattern.items() if re.fullmatch(rf"(.*\.)?({end.pattern})", layer))
    given = next(own, adapter.lora_alpha)
    return 1.0 if given is None else given / (math.sqrt(rank) if adapter.use_rslora else rank)
