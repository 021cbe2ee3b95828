"""The splats of a compact asset at any moment, with NumPy and safetensors alone: copy it into your program.

    states("out/demo/canonical/asset4d.safetensors", 0.5)["means"]

It knows the kind of deformation that is made unless another is asked for, the HexPlane.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

Array = NDArray[Any]


def states(path: str | Path, time: float) -> dict[str, Array]:
    """Means, log scales, quaternions (wxyz), opacity logits, harmonics; time 0 is the first frame, 1 the last."""
    with safe_open(path, "numpy") as file:
        t = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no dict)
        about = json.loads(file.metadata()["asset4d"])
    low, high = t["deformation.bounds"]
    x, y, z = np.clip((t["gaussians.means"] - low) / (high - low), 0, 1).T
    w = np.full_like(x, time * about["last_time"])
    places = [(y, x), (z, x), (z, y), (w, x), (w, y), (w, z)]
    levels = range(len(about["settings"]["scales"]))
    tables = [[*t[f"deformation.space.{level}"], *t[f"deformation.time.{level}"]] for level in levels]
    products = [np.prod([read(*pair) for pair in zip(planes, places, strict=True)], 0) for planes in tables]
    h = np.maximum(linear(t, "trunk", np.concatenate(products).T), 0)
    for name in ("means", "log_scales", "quats"):
        t[f"gaussians.{name}"] += linear(t, f"heads.{name}.outer", h + linear(t, f"heads.{name}.inner", h))
    return {name.removeprefix("gaussians."): value for name, value in t.items() if name.startswith("gaussians.")}


def read(plane: Array, place: tuple[Array, Array]) -> Array:
    """Bilinear samples of a table of channels, rows, columns: 0 is its first row or column, 1 its last."""
    last = np.array(plane.shape[1:])[:, None] - 1
    near = np.clip(np.floor(place * last), 0, last - 1).astype(int)
    (i, j), (v, u) = near, place * last - near
    upper, lower = (plane[:, k, j] * (1 - u) + plane[:, k, j + 1] * u for k in (i, i + 1))
    return upper * (1 - v) + lower * v


def linear(t: dict[str, Array], name: str, rows: Array) -> Array:
    """Apply a layer of the network."""
    return rows @ t[f"deformation.{name}.weight"].T + t[f"deformation.{name}.bias"]
