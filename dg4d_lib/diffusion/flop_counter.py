"""FLOP counter of networks: measures once per input shape, adds up at every call.

torch is imported with the first network, because `count_flops` is entered earlier (`steps/runtime/perform.py`).
"""

import inspect
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any

_OPEN: ContextVar[dict[str, int] | None] = ContextVar("flops", default=None)


@contextmanager
def count_flops() -> Iterator[dict[str, int]]:
    """Count the floating-point operations of networks in the block, by class name.

    A multiply-add counts as two. Only matrix products, convolutions and attention count, as in
    `torch.utils.flop_counter`; other operations are below 1 % of a diffusion network.
    """
    flops: dict[str, int] = {}
    token = _OPEN.set(flops)
    try:
        yield flops
    finally:
        _OPEN.reset(token)


def attach_flop_counter(network: Any) -> Any:
    """Make `count_flops` count the calls of a network, and return the network.

    A VAE is never called as a whole, so its encoder and decoder are counted under its name. If an input requires a
    gradient, the backward pass is counted too: with frozen weights it costs as much as the forward pass. VAEs that
    pass a cache from chunk to chunk are not counted, because the counter calls a network twice.
    """
    if _keeps_state(network):
        return network
    name = type(network).__name__
    for part in (network.encoder, network.decoder) if hasattr(network, "encode") else (network,):
        part.forward = _counting(name, part.forward)
    return network


def _keeps_state(network: Any) -> bool:
    """Return True for VAEs with a cache of features between calls."""
    parts = (getattr(network, name, None) for name in ("encoder", "decoder"))
    return any("feat_cache" in inspect.signature(part.forward).parameters for part in parts if part is not None)


def _counting(name: str, forward: Callable[..., Any]) -> Callable[..., Any]:
    """Return `forward`, counted under a name."""
    import torch  # noqa: PLC0415 - see the module docstring
    from torch.utils.flop_counter import FlopCounterMode  # noqa: PLC0415

    flops_per_call: dict[Hashable, int] = {}

    @torch.compiler.disable(recursive=False)
    @wraps(forward)
    def count(*positional: Any, **named: Any) -> Any:
        flops = _OPEN.get()
        if flops is None:
            return forward(*positional, **named)
        tensors = [value for value in (*positional, *named.values()) if isinstance(value, torch.Tensor)]
        shapes = tuple(value.shape for value in tensors)
        if shapes not in flops_per_call:  # a separate call, because the counter fails with gradients
            detached = {key: _detached(value) for key, value in named.items()}
            with torch.no_grad(), FlopCounterMode(display=False) as counter:
                forward(*map(_detached, positional), **detached)
            flops_per_call[shapes] = counter.get_total_flops()
        outputs = forward(*positional, **named)
        has_backward = torch.is_grad_enabled() and any(value.requires_grad for value in tensors)
        flops[name] = flops.get(name, 0) + flops_per_call[shapes] * (2 if has_backward else 1)
        return outputs

    return count


def _detached(value: Any) -> Any:
    return value.detach() if hasattr(value, "detach") else value
