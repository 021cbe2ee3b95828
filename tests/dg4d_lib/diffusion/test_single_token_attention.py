"""Single-token shortcut against the attention of diffusers."""

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from diffusers.models.attention_processor import Attention
from tiny_svd import tiny_svd
from tiny_weights import TOKEN, tiny_unet
from torch.utils.flop_counter import FlopCounterMode

from dg4d_lib.diffusion.flop_counter import attach_flop_counter, count_flops
from dg4d_lib.diffusion.single_token_attention import SingleTokenProcessor, shorten_attention

NETWORKS = ("pictures", "videos")
BATCH = 3


def drawn(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def network(name: str) -> Any:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return (tiny_unet() if name == "pictures" else tiny_svd().unet).double().eval()


def short(unet: Any) -> Any:
    return shorten_attention(copy.deepcopy(unet))


@torch.no_grad()
def call(unet: Any, tokens: torch.Tensor) -> torch.Tensor:
    """Every row of the batch has other latents."""
    of_pictures = type(unet).__name__ == "UNet2DConditionModel"
    latents = drawn(BATCH, 8, 8, 8) if of_pictures else drawn(BATCH, 4, 8, 8, 8)
    told = (tokens,) if of_pictures else (tokens, drawn(BATCH, 3, seed=1))
    dtype = next(unet.parameters()).dtype
    return unet(latents.to(dtype), torch.tensor(0.5), *(value.to(dtype) for value in told)).sample


def layer(**settings: Any) -> Attention:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return Attention(query_dim=8, cross_attention_dim=6, heads=2, dim_head=5, **settings).double().eval()


@pytest.mark.parametrize("name", NETWORKS)
def test_the_answer_is_diffusers_own_for_every_row_of_the_batch(name: str) -> None:
    unet = network(name)
    tokens = drawn(BATCH, 1, TOKEN, seed=2)
    expected = call(unet, tokens)
    torch.testing.assert_close(call(short(unet), tokens), expected, rtol=1e-11, atol=1e-12)
    assert (call(unet, tokens.roll(1, 0)) - expected).abs().amax((*range(1, expected.ndim),)).min() > 1e-4


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 1e-5), (torch.bfloat16, 0.05), (torch.float16, 0.01)])
def test_in_fewer_digits_it_is_equal_up_to_their_rounding(name: str, dtype: torch.dtype, error: float) -> None:
    exact = network(name)
    tokens = drawn(BATCH, 1, TOKEN, seed=2)
    found = call(short(exact).to(dtype), tokens)
    assert found.dtype == dtype
    torch.testing.assert_close(found.double(), call(exact, tokens), rtol=0, atol=error)


@pytest.mark.parametrize("name", NETWORKS)
def test_several_tokens_are_attended_to_bit_by_bit_as_before(name: str) -> None:
    unet = network(name)
    tokens = drawn(BATCH, 2, TOKEN, seed=2)
    assert torch.equal(call(short(unet), tokens), call(unet, tokens))


@pytest.mark.parametrize("pixels", [(7, 8), (8, 3, 2)])
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"bias": True, "out_bias": False},
        {"residual_connection": True, "rescale_output_factor": 3.0},
        {"cross_attention_norm": "layer_norm"},
        {"norm_num_groups": 2},
        {"dropout": 0.5},
    ],
)
def test_layers_of_any_settings_answer_the_same(settings: dict[str, Any], pixels: tuple[int, ...]) -> None:
    attn = layer(**settings)
    queries, tokens = drawn(BATCH, *pixels), drawn(BATCH, 1, 6, seed=1)
    expected = attn(queries, tokens)
    attn.set_processor(SingleTokenProcessor(attn.processor))
    found = attn(queries, tokens)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_a_mask_training_and_self_attention_take_the_ordinary_way() -> None:
    attn, asked = layer(), []
    attn.set_processor(SingleTokenProcessor(lambda _, queries, *told: asked.append(told) or queries))
    queries, tokens, mask = drawn(BATCH, 7, 8), drawn(BATCH, 1, 6), torch.zeros(BATCH, 1)
    attn(queries, tokens)
    assert not asked
    attn(queries, tokens, mask)
    attn(queries)
    attn.train()(queries, tokens)
    assert [(told[0] is tokens, told[1] is mask) for told in asked] == [(True, True), (False, False), (True, False)]


def test_what_is_left_is_one_value_and_one_output_per_row() -> None:
    attn = layer()
    attn.set_processor(SingleTokenProcessor(attn.processor))
    with FlopCounterMode(display=False) as flops:
        attn(drawn(BATCH, 7, 8), drawn(BATCH, 1, 6))
    assert flops.get_total_flops() == 2 * BATCH * (6 * 10 + 10 * 8)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_ledger_counts_what_is_left_out(name: str) -> None:
    counts = []
    for unet in (network(name), shorten_attention(network(name))):
        with count_flops() as flops:
            call(attach_flop_counter(unet), drawn(BATCH, 1, TOKEN))
        counts.append(sum(flops.values()))
    assert 0.5 * counts[0] < counts[1] < 0.99 * counts[0]


@pytest.mark.parametrize("name", NETWORKS)
def test_only_attention_to_tokens_is_shortened_and_files_stay_as_they_are(name: str, tmp_path: Path) -> None:
    unet = network(name)
    unet.save_pretrained(tmp_path / "before")
    shorten_attention(unet).save_pretrained(tmp_path / "after")
    for file in (tmp_path / "before").iterdir():
        assert file.read_bytes() == (tmp_path / "after" / file.name).read_bytes()
    for place, processor in unet.attn_processors.items():
        assert isinstance(processor, SingleTokenProcessor) == (".attn2." in place)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.slow
def test_a_compiled_network_says_the_same(name: str) -> None:
    unet = network(name)
    tokens = drawn(BATCH, 1, TOKEN, seed=2)
    expected = call(unet, tokens)
    compiled = short(unet)
    compiled.compile(backend="eager")
    torch.testing.assert_close(call(compiled, tokens), expected, rtol=1e-11, atol=1e-12)
