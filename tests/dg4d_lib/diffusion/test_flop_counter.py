"""FLOP counter against torch's counter around a manual loop, and against a hand-counted convolution."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tiny_weights import TOKEN, tiny_unet, tiny_vae
from torch.utils.flop_counter import FlopCounterMode

from dg4d_lib.diffusion.flop_counter import attach_flop_counter, count_flops

plain = tiny_unet()


def call(unet: Any, batch: int = 1) -> torch.Tensor:
    with torch.no_grad():
        return unet(torch.ones(batch, 8, 32, 32), 500, encoder_hidden_states=torch.ones(batch, 1, TOKEN)).sample


def by_torch(work: Callable[[], object]) -> int:
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def test_a_unet_does_what_torch_counts_whether_its_shapes_are_new_or_known() -> None:
    expected = by_torch(lambda: [call(plain, batch) for batch in (1, 2, 1)])
    unet = attach_flop_counter(tiny_unet())
    with count_flops() as flops:
        call(unet)
        first = flops["UNet2DConditionModel"]
        call(unet, 2)
        call(unet)
    assert first == by_torch(lambda: call(plain)) > 1e6
    assert flops == {"UNet2DConditionModel": expected} == {"UNet2DConditionModel": 4 * first}


def test_a_convolution_costs_two_operations_per_weight_and_output() -> None:
    layer = attach_flop_counter(torch.nn.Conv2d(3, 5, 3, padding=1))
    with count_flops() as flops:
        layer(torch.ones(2, 3, 8, 8))
    assert flops == {"Conv2d": 2 * (5 * 3 * 3 * 3) * (2 * 8 * 8)}


@pytest.mark.parametrize("attention", [False, True])
def test_the_way_back_to_the_pictures_is_counted_and_a_way_that_is_not_gone_is_not(attention: bool) -> None:
    vae = tiny_vae(mid_block_add_attention=attention).requires_grad_(False)
    pictures = torch.rand(1, 3, 64, 64, requires_grad=True)

    def there_and_back() -> None:
        vae.encode(2 * pictures - 1).latent_dist.mode().sum().backward()  # no leaf: the counter minds

    there_and_back_again = by_torch(there_and_back)
    there = by_torch(lambda: vae.encode(pictures.detach()))
    back_of_decoder = by_torch(lambda: vae.decode(torch.ones(1, 4, 8, 8)))
    attach_flop_counter(vae)
    with count_flops() as flops:
        there_and_back()
        assert flops["AutoencoderKL"] == pytest.approx(there_and_back_again, rel=0.02)
        before = flops["AutoencoderKL"]
        vae.encode(pictures.detach())
        assert flops["AutoencoderKL"] - before == pytest.approx(there, rel=0.01)
        before = flops["AutoencoderKL"]
        vae.decode(torch.ones(1, 4, 8, 8))
        assert flops["AutoencoderKL"] - before == pytest.approx(back_of_decoder, rel=0.01)


def test_counting_changes_no_result_and_calls_outside_are_not_entered() -> None:
    torch.manual_seed(0)
    unet = tiny_unet()
    expected = call(unet)
    assert torch.equal(call(attach_flop_counter(unet)), expected)
    with count_flops() as flops:
        assert torch.equal(call(unet), expected)
        inside = dict(flops)
    call(unet)
    assert flops == inside


def test_an_error_in_a_network_leaves_nothing_counting() -> None:
    unet = attach_flop_counter(tiny_unet())
    with count_flops() as flops:
        with pytest.raises(RuntimeError):
            unet(torch.ones(1, 3, 32, 32), 500, encoder_hidden_states=torch.ones(1, 1, TOKEN))
        assert flops == {}
        assert not torch.utils._python_dispatch._get_current_dispatch_mode_stack()
        call(unet)
        assert flops["UNet2DConditionModel"] > 1e6


@pytest.mark.slow
def test_a_compiled_network_is_counted_as_well() -> None:
    unet = attach_flop_counter(tiny_unet())
    expected = call(unet)
    unet.compile(backend="eager")
    with count_flops() as flops:
        for _ in range(2):
            torch.testing.assert_close(call(unet), expected)
    assert flops["UNet2DConditionModel"] == 2 * by_torch(lambda: call(plain))
