"""glTF animation tracks: morph weights, node visibility and animated properties.

All tracks loop: a key one frame after the last frame repeats the first frame, so a looping player does not jump and the
animation lasts as long as the video. Nodes are shown with scale 1 and hidden with scale 0, in steps, because core glTF
has no visibility.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.gltf import GltfDocument

POINTER = "KHR_animation_pointer"
STILL = 1e-6  # change of a place, relative to its distance, or of a quaternion, that is not written


@dataclass(frozen=True)
class Span:
    """Consecutive frames shown by one node.

    Attributes:
        first: first frame.
        end: frame after the last one.
        total: frames of the whole animation.
    """

    first: int
    end: int
    total: int

    @property
    def keys(self) -> list[int]:
        """Frames of the span and the next one; the latter may be `total`, which stands for frame 0."""
        return list(range(self.first, self.end + 1))

    @property
    def poses(self) -> list[int]:
        """Frames shown at the keys that need a morph target, each once; frame 0 is the base, which needs none.

        An animation of frame 0 alone keeps it as a zero morph target, because glTF requires at least one.
        """
        return [frame for frame in dict.fromkeys(key % self.total for key in self.keys) if frame > 0] or [0]

    def weights(self) -> NDArray[np.float32]:
        """Return the weights of the poses at the keys: one-hot, or zeros for the base."""
        return np.array([[pose == key % self.total for pose in self.poses] for key in self.keys], "<f4")

    def visibility(self) -> tuple[list[int], NDArray[np.float32]]:
        """Return the keys at which the node appears or disappears, and its scale from each key on."""
        keys = sorted({0, self.first, self.end, self.total})
        visible = [self.first <= key % self.total < self.end for key in keys]
        return keys, np.repeat(np.array(visible, "<f4")[:, None], 3, axis=1)


def split_into_spans(frames: int, longest: int) -> list[Span]:
    """Split an animation into consecutive spans of at most `longest` frames."""
    return [Span(first, min(first + longest, frames), frames) for first in range(0, frames, longest)]


class Animation:
    """glTF animation under construction."""

    def __init__(self, document: GltfDocument, fps: float) -> None:
        self._document, self._fps = document, fps
        self._samplers: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        self._times: dict[tuple[int, ...], int] = {}

    def add_morph(
        self, node: int, name: str, keys: list[int], weights: NDArray[np.float32], interpolation: str
    ) -> None:
        """Animate the morph weights of a node; `weights` has a row per key, which is a frame number."""
        self._add(name, keys, weights.ravel(), interpolation, {"node": node, "path": "weights"})

    def add_transform(
        self,
        node: int,
        name: str,
        keys: list[int],
        translations: NDArray[np.float32],
        rotations: NDArray[np.float32],
        interpolation: str,
    ) -> None:
        """Animate the place of a node and its rotation, xyzw; rows are keys, as of `add_morph`."""
        if np.abs(translations - translations[0]).max() > STILL * (1 + np.abs(translations[0]).max()):
            self._add(f"{name} place", keys, translations, interpolation, {"node": node, "path": "translation"})
        if np.abs(rotations - rotations[0]).max() > STILL:
            self._add(f"{name} rotation", keys, rotations, interpolation, {"node": node, "path": "rotation"})

    def add_visibility(self, node: int, name: str, span: Span) -> None:
        """Show a node during its span only; readers without animation show the node of frame 0."""
        keys, scales = span.visibility()
        self._document.tree["nodes"][node]["scale"] = scales[0].tolist()
        self._add(f"{name} shown", keys, scales, "STEP", {"node": node, "path": "scale"})

    def add_pointer(self, pointer: str, name: str, values: NDArray[np.float32]) -> None:
        """Animate any property with a value per frame; readers without KHR_animation_pointer ignore it."""
        self._document.use_extension(POINTER)
        target = {"path": "pointer", "extensions": {POINTER: {"pointer": pointer}}}
        self._add(name, list(range(len(values) + 1)), np.concatenate((values, values[:1])), "STEP", target)

    def finish(self) -> None:
        """Add the animation to the document."""
        self._document.add("animations", name="motion", samplers=self._samplers, channels=self._channels)

    def _add(
        self, name: str, keys: list[int], values: NDArray[np.float32], interpolation: str, target: dict[str, Any]
    ) -> None:
        output = self._document.add_accessor(f"{name} over time", values)
        sampler = {"input": self._seconds(keys), "output": output, "interpolation": interpolation}
        self._channels.append({"sampler": len(self._samplers), "target": target})
        self._samplers.append(sampler)

    def _seconds(self, keys: list[int]) -> int:
        index = tuple(keys)
        if index not in self._times:
            seconds = (np.array(keys) / self._fps).astype("<f4")
            self._times[index] = self._document.add_accessor("times", seconds)
        return self._times[index]
