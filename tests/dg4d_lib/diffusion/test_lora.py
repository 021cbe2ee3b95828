import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from dg4d_lib.diffusion.lora import merge_lora
from dg4d_lib.errors import BadInput

DOWN = torch.tensor([[1.0, 0.0, 2.0]])
UP = torch.tensor([[1.0], [3.0]])


def network(dtype: torch.dtype = torch.float32) -> nn.Module:
    made = nn.ModuleDict({"block": nn.ModuleDict({"to_q": nn.Linear(3, 2), "to_k": nn.Linear(3, 2)})}).to(dtype)
    nn.init.zeros_(made["block"]["to_q"].weight)
    return made


@pytest.mark.parametrize(
    "names",
    [
        ("transformer.block.to_q.lora_A.weight", "transformer.block.to_q.lora_B.weight"),
        ("diffusion_model.block.to_q.lora_down.weight", "diffusion_model.block.to_q.lora_up.weight"),
        ("block.to_q.lora_A.default.weight", "block.to_q.lora_B.default.weight"),
        ("transformer.block.to_q.lora.down.weight", "transformer.block.to_q.lora.up.weight"),
    ],
)
def test_the_product_of_the_factors_is_added_under_every_naming(names: tuple[str, str], tmp_path: Path) -> None:
    save_file(dict(zip(names, (DOWN, UP), strict=True)), tmp_path / "lora.safetensors")
    made = network()
    before = made["block"]["to_k"].weight.clone()
    assert merge_lora(made, tmp_path, 0.5) == 1
    assert torch.equal(made["block"]["to_q"].weight, 0.5 * UP @ DOWN)
    assert torch.equal(made["block"]["to_k"].weight, before)


def test_alpha_over_rank_scales_and_the_precision_of_the_network_stays(tmp_path: Path) -> None:
    name = "transformer.block.to_q"
    tensors = {f"{name}.lora_A.weight": DOWN, f"{name}.lora_B.weight": UP, f"{name}.alpha": torch.tensor(4.0)}
    save_file(tensors, tmp_path / "lora.safetensors")
    made = network(torch.bfloat16)
    merge_lora(made, tmp_path / "lora.safetensors", 1.0)
    assert made["block"]["to_q"].weight.dtype == torch.bfloat16
    assert torch.equal(made["block"]["to_q"].weight.float(), 4 * UP @ DOWN)


def save_with_metadata(folder: Path, stored: str, rank: int = 4) -> Path:
    """A file as `save_lora_weights` of diffusers writes it; its factors have the product UP @ DOWN."""
    down = torch.cat([DOWN, torch.zeros(rank - 1, 3)])
    up = torch.cat([UP, torch.zeros(2, rank - 1)], dim=1)
    tensors = {"transformer.block.to_q.lora_A.weight": down, "transformer.block.to_q.lora_B.weight": up}
    save_file(tensors, folder / "lora.safetensors", metadata={"lora_adapter_metadata": stored, "format": "pt"})
    return folder / "lora.safetensors"


@pytest.mark.parametrize(
    ("settings", "scaling"),
    [
        ({"lora_alpha": 8, "r": 4}, 2.0),
        ({"lora_alpha": 8, "use_rslora": True}, 8 / math.sqrt(4)),
        ({"lora_alpha": 8, "alpha_pattern": {"to_k": 1, "block.to_q": 2}}, 0.5),
        ({"lora_alpha": 8, "alpha_pattern": {"to_(q|v)": 16}}, 4.0),
        ({"target_modules": ["to_q"]}, 1.0),
    ],
)
def test_alpha_in_the_metadata_scales_a_lora(settings: dict[str, Any], scaling: float, tmp_path: Path) -> None:
    stored = json.dumps({f"transformer.{key}": value for key, value in settings.items()})
    made = network()
    merge_lora(made, save_with_metadata(tmp_path, stored), 1.0)
    assert torch.equal(made["block"]["to_q"].weight, scaling * UP @ DOWN)


@pytest.mark.parametrize("stored", ["{", "[]", '{"lora_alpha": "much"}', '{"alpha_pattern": {"(": 1}}'])
def test_metadata_that_cannot_be_read_is_refused(stored: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"lora_adapter_metadata in .* cannot be read"):
        merge_lora(network(), save_with_metadata(tmp_path, stored), 1.0)


@pytest.mark.parametrize(
    ("tensors", "message"),
    [
        ({"block.other.lora_A.weight": DOWN, "block.other.lora_B.weight": UP}, "no linear layer block.other"),
        ({"block.to_q.lora_A.weight": DOWN[:, :2], "block.to_q.lora_B.weight": UP}, "block.to_q has 2 x 3 weights"),
        ({"block.to_q.lora_A.weight": DOWN}, "is not a LoRA of linear layers"),
        ({"block.to_q.weight": DOWN}, "is not a LoRA of linear layers"),
    ],
)
def test_a_file_for_another_network_is_refused(tensors: dict[str, torch.Tensor], message: str, tmp_path: Path) -> None:
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, tmp_path / "lora.safetensors")
    with pytest.raises(BadInput, match=message):
        merge_lora(network(), tmp_path, 1.0)


@pytest.mark.parametrize(
    "key",
    [
        "transformer.block.to_q.lora_magnitude_vector",  # DoRA of PEFT
        "diffusion_model.block.to_q.dora_scale",  # DoRA of kohya
        "transformer.block.to_q.lora_B.bias",
        "block.to_q.diff",
        "block.to_q.diff_b",
        "block.to_k.lokr_w1",
        "block.norm.weight",
    ],
)
def test_tensors_that_a_merge_would_drop_are_refused(key: str, tmp_path: Path) -> None:
    tensors = {"block.to_q.lora_A.weight": DOWN, "block.to_q.lora_B.weight": UP, key: torch.ones(2)}
    save_file(tensors, tmp_path / "lora.safetensors")
    made = network()
    with pytest.raises(BadInput, match=rf"is more than a LoRA: '{re.escape(key)}' \(1 such tensors\) cannot be merged"):
        merge_lora(made, tmp_path, 1.0)
    assert not made["block"]["to_q"].weight.any()


@pytest.mark.parametrize("dtype", [torch.float8_e4m3fn, torch.float8_e5m2, torch.float16, torch.int32])
def test_factors_of_any_precision_are_merged(dtype: torch.dtype, tmp_path: Path) -> None:
    tensors = {"block.to_q.lora_A.weight": DOWN, "block.to_q.lora_B.weight": UP}
    save_file({name: tensor.to(dtype) for name, tensor in tensors.items()}, tmp_path / "lora.safetensors")
    made = network()
    merge_lora(made, tmp_path, 1.0)
    assert torch.equal(made["block"]["to_q"].weight, UP @ DOWN)


@pytest.mark.parametrize("shape", [(2,), (0,)])
def test_an_alpha_that_is_not_one_number_is_refused(shape: tuple[int], tmp_path: Path) -> None:
    tensors = {"q.lora_down.weight": DOWN, "q.lora_up.weight": UP, "q.alpha": torch.ones(shape)}
    save_file(tensors, tmp_path / "lora.safetensors")
    with pytest.raises(BadInput, match=r"is more than a LoRA: 'q\.alpha' \(1 such tensors\) cannot be merged"):
        merge_lora(network(), tmp_path, 1.0)


def test_dora_in_the_metadata_is_refused(tmp_path: Path) -> None:
    stored = json.dumps({"transformer.lora_alpha": 4, "transformer.use_dora": True})
    with pytest.raises(BadInput, match="use_dora in its metadata cannot be merged"):
        merge_lora(network(), save_with_metadata(tmp_path, stored), 1.0)


@pytest.mark.parametrize("broken", ["lora_A.weight", "lora_B.weight", "alpha"])
def test_numbers_that_are_not_finite_are_refused(broken: str, tmp_path: Path) -> None:
    tensors = {"lora_A.weight": DOWN.clone(), "lora_B.weight": UP.clone(), "alpha": torch.ones(1)}
    tensors[broken].view(-1)[0] = math.nan
    save_file({f"block.to_q.{name}": tensor for name, tensor in tensors.items()}, tmp_path / "lora.safetensors")
    made = network()
    with pytest.raises(BadInput, match=rf"block\.to_q\.{re.escape(broken)} has values that are not finite"):
        merge_lora(made, tmp_path, 1.0)
    assert not made["block"]["to_q"].weight.any()


def test_a_folder_without_one_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="has 0 files of tensors"):
        merge_lora(network(), tmp_path, 1.0)


@pytest.mark.parametrize("other", ["block.to_q.lora_{}.weight", "transformer.block.to_q.lora_{}.default.weight"])
def test_a_layer_that_is_named_twice_is_refused(other: str, tmp_path: Path) -> None:
    spellings = ("transformer.block.to_q.lora_{}.weight", other)
    tensors = {name.format(end): factor.clone() for name in spellings for end, factor in (("A", DOWN), ("B", UP))}
    save_file(tensors, tmp_path / "lora.safetensors")
    with pytest.raises(BadInput, match="several factors of one layer"):
        merge_lora(network(), tmp_path, 1.0)
