"""Loading, offloading by memory budgets (networks of the published sizes, on the meta device), arguments of calls."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from tiny_text_to_image import save_pipeline
from torch import nn

from dg4d_lib.diffusion.pipelines import (
    GIB,
    WORKSPACE_GB,
    choose_offload,
    guidance_arguments,
    is_flow_matching,
    load_pipeline,
    peak_gib,
    pipeline_class_name,
)
from dg4d_lib.errors import BadInput

BF16 = 2  # bytes


def wan_transformer() -> nn.Module:
    from diffusers import WanTransformer3DModel

    return WanTransformer3DModel(
        num_attention_heads=24, in_channels=48, out_channels=48, ffn_dim=14336, num_layers=30
    )  # fmt: skip


def umt5() -> nn.Module:
    from transformers import UMT5Config, UMT5EncoderModel

    sizes = {"d_model": 4096, "d_kv": 64, "d_ff": 10240, "num_layers": 24, "num_heads": 64, "vocab_size": 256384}
    return UMT5EncoderModel(UMT5Config(feed_forward_proj="gated-gelu", **sizes))


def qwen_transformer() -> nn.Module:
    from diffusers import QwenImageTransformer2DModel

    return QwenImageTransformer2DModel()


def qwen_encoder() -> nn.Module:
    from transformers import Qwen2_5_VLConfig, Qwen2_5_VLForConditionalGeneration

    text = {"hidden_size": 3584, "intermediate_size": 18944, "num_hidden_layers": 28, "num_attention_heads": 28}
    text |= {"num_key_value_heads": 4, "vocab_size": 152064, "tie_word_embeddings": False}
    rope = {"rope_type": "default", "mrope_section": [16, 24, 24], "rope_theta": 1e6}
    eyes = {"depth": 32, "hidden_size": 1280, "intermediate_size": 3420, "num_heads": 16, "out_hidden_size": 3584}
    config = Qwen2_5_VLConfig(text_config={**text, "rope_parameters": rope}, vision_config=eyes)
    return Qwen2_5_VLForConditionalGeneration(config)


def ltx_transformer() -> nn.Module:
    from diffusers import LTXVideoTransformer3DModel

    return LTXVideoTransformer3DModel()


def count(make: Callable[[], nn.Module]) -> tuple[int, int]:
    """Parameters of a network, and of its largest module without parts."""
    with torch.device("meta"):
        network = make()
    leaves = [module for module in network.modules() if not list(module.children())]
    return (
        sum(one.numel() for one in network.parameters()),
        max(sum(one.numel() for one in leaf.parameters(recurse=False)) for leaf in leaves),
    )


@pytest.fixture(scope="module")
def counts() -> dict[str, tuple[int, int]]:
    makers = (wan_transformer, umt5, qwen_transformer, qwen_encoder, ltx_transformer)
    return {make.__name__: count(make) for make in makers}


def test_the_networks_have_the_published_sizes(counts: dict[str, tuple[int, int]]) -> None:
    billions = {name: parameters / 1e9 for name, (parameters, _) in counts.items()}
    assert billions == {
        "wan_transformer": pytest.approx(5.0, abs=0.1),
        "umt5": pytest.approx(5.7, abs=0.1),
        "qwen_transformer": pytest.approx(20.4, abs=0.2),
        "qwen_encoder": pytest.approx(8.3, abs=0.1),
        "ltx_transformer": pytest.approx(1.9, abs=0.1),
    }


@pytest.mark.parametrize(
    ("networks", "memory_gb", "offload"),
    [
        (("wan_transformer", "umt5"), 24, "none"),
        (("wan_transformer", "umt5"), 16, "model"),
        (("wan_transformer", "umt5"), 12, "sequential"),
        (("qwen_transformer", "qwen_encoder"), 80, "none"),
        (("qwen_transformer", "qwen_encoder"), 48, "model"),
        (("qwen_transformer", "qwen_encoder"), 24, "sequential"),
        (("qwen_transformer", "qwen_encoder"), 12, "sequential"),
    ],
)
def test_every_model_of_open_fits_its_budget(
    networks: tuple[str, ...], memory_gb: float, offload: str, counts: dict[str, tuple[int, int]]
) -> None:
    sizes = {name: BF16 * counts[name][0] for name in networks}
    assert choose_offload(sizes, memory_gb) == offload
    if offload == "sequential":
        largest = BF16 * max(counts[name][1] for name in networks) / GIB
        assert largest + WORKSPACE_GB < memory_gb / 2  # layer by layer, half of it is left for activations
    else:
        assert peak_gib(sizes, "none" if offload == "none" else "model") <= memory_gb


@pytest.mark.parametrize(
    ("config", "flow"),
    [
        ({"_class_name": "FlowMatchEulerDiscreteScheduler"}, True),
        ({"_class_name": "UniPCMultistepScheduler", "use_flow_sigmas": True}, True),
        ({"_class_name": "UniPCMultistepScheduler", "prediction_type": "flow_prediction"}, True),
        ({"_class_name": "DDIMScheduler", "prediction_type": "epsilon"}, False),
        ({"_class_name": "EulerDiscreteScheduler", "prediction_type": "v_prediction"}, False),
    ],
)
def test_flow_matching_is_told_by_the_scheduler(config: dict[str, Any], flow: bool, tmp_path: Path) -> None:
    assert not is_flow_matching(tmp_path)
    (tmp_path / "scheduler").mkdir()
    (tmp_path / "scheduler" / "scheduler_config.json").write_text(json.dumps(config))
    assert is_flow_matching(tmp_path) == flow


def test_a_class_that_diffusers_lacks_is_named(tmp_path: Path) -> None:
    (tmp_path / "model_index.json").write_text('{"_class_name": ["mine", "MinePipeline"]}')
    assert pipeline_class_name(tmp_path) == "MinePipeline"
    with pytest.raises(BadInput, match="has no OtherPipeline, which MinePipeline"):
        load_pipeline(tmp_path, torch.float32, "OtherPipeline")
    (tmp_path / "model_index.json").write_text("[]")
    with pytest.raises(BadInput, match="names no pipeline"):
        pipeline_class_name(tmp_path)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_pipeline(tmp_path_factory.mktemp("models") / "tiny")


@pytest.mark.parametrize(
    ("file", "part"),
    [("text_encoder/model.safetensors", "mlp.fc1"), ("vae/diffusion_pytorch_model.safetensors", "decoder.conv_in")],
)
def test_missing_tensors_are_refused(file: str, part: str, tiny: Path, tmp_path: Path) -> None:
    broken = shutil.copytree(tiny, tmp_path / "broken")
    kept = {name: value for name, value in load_file(broken / file).items() if part not in name}
    save_file(kept, broken / file, {"format": "pt"})
    with pytest.raises(BadInput, match=rf"does not match its config\.json: 2 tensors are missing .*{part}\.bias"):
        load_pipeline(broken, torch.float32)


def test_files_in_half_precision_are_read_where_it_is_requested_or_there_are_no_others(
    tiny: Path, tmp_path: Path
) -> None:
    both = shutil.copytree(tiny, tmp_path / "both")
    for file in both.glob("*/*.safetensors"):
        half = {name: torch.full_like(value, 0.5).half() for name, value in load_file(file).items()}
        save_file(half, file.with_name(f"{file.stem}.fp16.safetensors"), {"format": "pt"})
    (both / "vae" / "diffusion_pytorch_model.safetensors").unlink()
    full, half = load_pipeline(both, torch.float32), load_pipeline(both, torch.float16)
    weights = [part.parameters() for part in (full.unet, full.text_encoder, full.vae, half.unet, half.text_encoder)]
    assert [all(bool((value == 0.5).all()) for value in part) for part in weights] == [False, False, True, True, True]


@pytest.mark.parametrize(
    ("default", "distilled", "expected"),
    [
        (4.0, False, {"true_cfg_scale": 7.0, "negative_prompt": " "}),
        (4.0, True, {"guidance_scale": 7.0}),
        (1.0, False, {"guidance_scale": 7.0}),
    ],
)
def test_guidance_has_the_name_that_has_an_effect(default: float, distilled: bool, expected: dict[str, Any]) -> None:
    class Pipeline:
        def __init__(self) -> None:
            network = nn.Identity()
            network.config = SimpleNamespace(guidance_embeds=distilled)
            self.components = {"transformer": network}

        def __call__(self, prompt: str, true_cfg_scale: float = default, guidance_scale: float | None = None) -> None:
            """Take the arguments; the signature alone is read."""

    assert guidance_arguments(Pipeline(), 7.0) == expected
