"""Animations of a glTF document that show frames one after another.

All are closed: a last key, one frame after the last frame, shows the first frame again, so a player that loops has no
jump and the animation lasts as long as the video. Nodes are shown by scale 1 and hidden by scale 0, in steps: core
glTF has nothing else for it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.gltf import GltfDocument

POINTER = "KHR_animation_pointer"


@dataclass(frozen=True)
class Span:
    """Consecutive frames that one node shows.

    Attributes:
        first: the first of them.
        end: the first that is not one of them.
        of: frames of the whole animation.
    """

    first: int
    end: int
    of: int

    @property
    def keys(self) -> list[int]:
        """Its frames and the one that it leads to; that may be `of`, which stands for frame 0."""
        return list(range(self.first, self.end + 1))

    @property
    def poses(self) -> list[int]:
        """The frames that are seen at its keys, each once."""
        return list(dict.fromkeys(key % self.of for key in self.keys))

    def weights(self) -> NDArray[np.float32]:
        """The weights of its poses at its keys: one is 1."""
        return np.array([[pose == key % self.of for pose in self.poses] for key in self.keys], "<f4")

    def shown(self) -> tuple[list[int], NDArray[np.float32]]:
        """Where it appears and disappears: keys, and the scale of its node from each on."""
        keys = sorted({0, self.first, self.end, self.of})
        visible = [self.first <= key % self.of < self.end for key in keys]
        return keys, np.repeat(np.array(visible, "<f4")[:, None], 3, axis=1)


def split_into_spans(frames: int, longest: int) -> list[Span]:
    """Spans of an animation, one after another, none longer than `longest` frames."""
    return [Span(first, min(first + longest, frames), frames) for first in range(0, frames, longest)]


class Animation:
    """Tracks that are played together."""

    def __init__(self, document: GltfDocument, fps: float) -> None:
        self._document, self._fps = document, fps
        self._samplers: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        self._times: dict[tuple[int, ...], int] = {}

    def morph(self, node: int, name: str, span: Span, interpolation: str) -> None:
        """A node shows the poses of its span, one at each key."""
        self._add(name, span.keys, span.weights().ravel(), interpolation, {"node": node, "path": "weights"})

    def show(self, node: int, name: str, span: Span) -> None:
        """A node is there in its span only; in readers that play nothing, the node of frame 0 is."""
        keys, scales = span.shown()
        self._document.tree["nodes"][node]["scale"] = scales[0].tolist()
        self._add(f"{name} shown", keys, scales, "STEP", {"node": node, "path": "scale"})

    def point(self, pointer: str, name: str, values: NDArray[np.float32]) -> None:
        """Something that is no node has a value at every frame; readers that do not know the extension leave it."""
        self._document.use(POINTER)
        target = {"path": "pointer", "extensions": {POINTER: {"pointer": pointer}}}
        self._add(name, list(range(len(values) + 1)), np.concatenate((values, values[:1])), "STEP", target)

    def finish(self) -> None:
        """Add it to the document."""
        self._document.add("animations", name="motion", samplers=self._samplers, channels=self._channels)

    def _add(
        self, name: str, keys: list[int], values: NDArray[np.float32], interpolation: str, target: dict[str, Any]
    ) -> None:
        output = self._document.add_accessor(f"{name} over time", values)
        sampler = {"input": self._seconds(keys), "output": output, "interpolation": interpolation}
        self._channels.append({"sampler": len(self._samplers), "target": target})
        self._samplers.append(sampler)

    def _seconds(self, keys: list[int]) -> int:
        wanted = tuple(keys)
        if wanted not in self._times:
            seconds = (np.array(keys) / self._fps).astype("<f4")
            self._times[wanted] = self._document.add_accessor("times", seconds)
        return self._times[wanted]
