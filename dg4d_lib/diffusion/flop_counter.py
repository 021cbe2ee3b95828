"""How much arithmetic networks do: counted once per shape of their inputs, and added up at every call.

Steps are counted from outside (`steps/main.py`), before torch may be imported: it is imported where networks are.
"""

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any

_OPEN: ContextVar[dict[str, int] | None] = ContextVar("flops", default=None)


@contextmanager
def counting_flops() -> Iterator[dict[str, int]]:
    """Count what networks do while the block runs: floating-point operations, by the name of their class.

    A multiplication and an addition are two. Only matrix products, convolutions and attention count, as
    `torch.utils.flop_counter` has it; the rest is less than a hundredth of a diffusion network.
    """
    flops: dict[str, int] = {}
    token = _OPEN.set(flops)
    try:
        yield flops
    finally:
        _OPEN.reset(token)


def counted(network: Any) -> Any:
    """The same network, whose calls are from now on entered where flops are being counted.

    Of a VAE, which is never called as a whole, its encoder and its decoder are counted under its name. Where inputs
    have a gradient, the way back to them is entered too: with frozen weights, that of a matrix product or a convolution
    costs as much as the way there.
    """
    name = type(network).__name__
    for part in (network.encoder, network.decoder) if hasattr(network, "encode") else (network,):
        part.forward = _counting(name, part.forward)
    return network


def _counting(name: str, forward: Callable[..., Any]) -> Callable[..., Any]:
    """`forward`, entered under a name."""
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
        if shapes not in of_one_call:  # a call of its own: the counter does not bear gradients
            apart = {key: _detached(value) for key, value in named.items()}
            with torch.no_grad(), FlopCounterMode(display=False) as counter:
                forward(*map(_detached, positional), **apart)
            of_one_call[shapes] = counter.get_total_flops()
        made = forward(*positional, **named)
        there_and_back = torch.is_grad_enabled() and any(value.requires_grad for value in tensors)
        flops[name] = flops.get(name, 0) + of_one_call[shapes] * (2 if there_and_back else 1)
        return made

    return count


def _detached(value: Any) -> Any:
    return value.detach() if hasattr(value, "detach") else value
