"""Base class of the per-frame variables of a motion fit."""

from collections.abc import Sequence
from typing import TypeVar

import torch

Variables = TypeVar("Variables", bound="FrameVariables")


class FrameVariables:
    """Base of data classes of tensors whose first axis is the frame."""

    @classmethod
    def joined(cls: type[Variables], frames: Sequence[Variables]) -> Variables:
        """Return the variables of several frames."""
        return cls(**{name: torch.cat([getattr(one, name) for one in frames]) for name in vars(frames[0])})

    def trainable(self: Variables) -> Variables:
        """Return a copy that gradients are computed for."""
        return type(self)(**{name: value.detach().clone().requires_grad_() for name, value in vars(self).items()})

    def detach(self: Variables) -> Variables:
        """Return the variables without gradients."""
        return type(self)(**{name: value.detach() for name, value in vars(self).items()})

    def continued(self: Variables, last: Variables, speed: float) -> Variables:
        """Extrapolate from this frame over the last one, by a share of the motion between them."""
        ends = {name: (value, getattr(last, name)) for name, value in vars(self).items()}
        return type(self)(**{name: end + speed * (end - start) for name, (start, end) in ends.items()})
