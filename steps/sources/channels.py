"""Channels of a picture that hold its colors, alpha or depth, by their names; layers of OpenEXR."""

from typing import NamedTuple

import OpenImageIO as oiio

from dg4d_lib.errors import quoted

DEPTH_NAMES = ("z", "depth", "depth.z", "depth.v")  # names or their last parts; preferred to red, green and blue
MAIN_LAYERS = {"combined", "beauty", "rgba"}  # names of the finished picture among render passes


class Channels(NamedTuple):
    """Channels of a picture.

    Attributes:
        picked: red, green and blue, and alpha if present; gray is repeated.
        has_alpha: True if the last one is alpha.
        notes: a sentence that names the layer, if it is one of several with colors.
    """

    picked: list[int]
    has_alpha: bool
    notes: tuple[str, ...] = ()


def find_channels(spec: oiio.ImageSpec, depth: bool = False) -> Channels:
    """Find the channels of colors and alpha in one layer; with `depth` one that is named so goes before colors."""
    names = [name.lower() for name in spec.channelnames]
    layers: dict[str, dict[int, str]] = {}  # of every layer its channels, and the ends of their names
    for channel, name in enumerate(names):
        layer, _, end = name.rpartition(".")
        layers.setdefault(layer, {})[channel] = end
    colored = [layer for layer, ends in layers.items() if {"r", "g", "b"} <= set(ends.values())]

    def rank(layer: str) -> tuple[bool, bool, bool]:
        """Rank a layer: channels without a layer first, then a finished picture, then a layer with alpha."""
        return not layer, not MAIN_LAYERS.isdisjoint(layer.split(".")), spec.alpha_channel in layers[layer]

    layer = max(colored or layers, key=rank)  # the first one of equals
    ends = layers[layer]
    alpha = spec.alpha_channel if spec.alpha_channel in ends else _with_end(ends, "a")
    alpha = alpha if alpha >= 0 else _with_end(layers.get("", {}), "a")  # of the picture, beside layers of colors
    found = _depth_channel(names) if depth else -1
    if found >= 0:
        colors, is_one_of_several = [found] * 3, False
    elif layer in colored:
        colors, is_one_of_several = [_with_end(ends, name) for name in "rgb"], bool(layer) and len(colored) > 1
    else:
        rest = [channel for channel in ends if channel != alpha] or [0]
        colors, is_one_of_several = rest[:3] if len(rest) >= 3 else rest[:1] * 3, False
    notes: tuple[str, ...] = ()
    if is_one_of_several:
        own_name = spec.channelnames[colors[0]].rpartition(".")[0]
        notes = (f"The picture has {len(colored)} layers with colors; {quoted(own_name)} is used.",)
    return Channels([*colors, alpha] if alpha >= 0 else colors, alpha >= 0, notes)


def _with_end(ends: dict[int, str], wanted: str) -> int:
    """Return the first channel whose name ends so; -1 without."""
    return next((channel for channel, end in ends.items() if end == wanted), -1)


def _depth_channel(names: list[str]) -> int:
    """Return the first channel that is named as depth, or whose name ends so; -1 without."""
    suffixes = tuple(f".{name}" for name in DEPTH_NAMES)
    exact = [channel for channel, name in enumerate(names) if name in DEPTH_NAMES]
    ending = [channel for channel, name in enumerate(names) if name.endswith(suffixes)]
    return (exact or ending or [-1])[0]
