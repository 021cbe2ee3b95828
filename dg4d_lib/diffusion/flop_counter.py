"""Floating-point operations of networks: measured once per input shape and added up at every call.

torch is imported with the first network, because `count_flops` is entered before (`steps/runtime/perform.py`).
"""

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any

_OPEN: ContextVar[dict[str, int] | None] = ContextVar("flops", default=None)


@contextmanager
def count_flops() -> Iterator[dict[str, int]]:
    """Count the floating-point operations of networks in the block, by the name of their class.

    A multiplication and an addition are two. Only matrix products, convolutions and attention count, as
    `torch.utils.flop_counter` has it; the rest is less than a hundredth of a diffusion network.
    """
    flops: dict[str, int] = {}
    token = _OPEN.set(flops)
    try:
        yield flops
    finally:
        _OPEN.reset(token)


def attach_flop_counter(network: Any) -> Any:
    """Return the network with its calls counted inside `count_flops`.

    Encoder and decoder of a VAE, which is never called as a whole, are counted under its name. Where inputs have a
    gradient, the backward pass is counted too: with frozen weights it costs as much as the forward pass.
    """
    name = type(network).__name__
    for part in (network.encoder, network.decoder) if hasattr(network, "encode") else (network,):
        part.forward = _counting(name, part.forward)
    return network


def _counting(name: str, forward: Callable[..., Any]) -> Callable[..., Any]:
    """Return `forward`, counted under a name."""
    import torch  # noqa: PLC0415 - see above
    from torch.utils.flop_counter import FlopCounterMode  # noqa: PLC0415

    of_one_call: dict[Hashable, int] = {}

    @torch.compiler.disable(recursive=False)
    @wraps(forward)
    def count(*positional: Any, **named: Any) -> Any:
        flops = _OPEN.get()
        if flops is None:
            return forward(*positional, **named)
        tensors = [value for value in (*positional, *named.values()) if isinstance(value, torch.Tensor)]
        shapes = tuple(value.shape for value in tensors)
        if shapes not in of_one_call:  # a separate call, because the counter does not work with gradients
            apart = {key: _detached(value) for key, value in named.items()}
            with torch.no_grad(), FlopCounterMode(display=False) as counter:
                forward(*map(_detached, positional), **apart)
            of_one_call[shapes] = counter.get_total_flops()
        made = forward(*positional, **named)
        has_backward = torch.is_grad_enabled() and any(value.requires_grad for value in tensors)
        flops[name] = flops.get(name, 0) + of_one_call[shapes] * (2 if has_backward else 1)
        return made

    return count


def _detached(value: Any) -> Any:
    return value.detach() if hasattr(value, "detach") else value
