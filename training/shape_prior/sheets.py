"""Contact sheets of synthetic shapes and of the network's predictions."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from dg4d_lib.shape_prior.frustum import SIZE
from training.shape_prior.families import FAMILIES
from training.shape_prior.samples import Sample, make_sample


def over_white(picture: UInt8[np.ndarray, "s s 4"]) -> UInt8[np.ndarray, "s s 3"]:
    """Return a premultiplied picture on white."""
    return np.asarray(picture[..., :3] + (255 - picture[..., 3:]), np.uint8)


def tiles_of(sample: Sample) -> list[UInt8[np.ndarray, "s s 3"]]:
    """Return the picture, the depth of the first surface, of the last, and the color of the last."""
    size = len(sample.picture)
    last = np.arange(len(sample.pixels)), sample.counts.astype(int) - 1
    depth = np.full((2, size * size), 255, np.uint8)
    depth[0, sample.pixels], depth[1, sample.pixels] = sample.depths[:, 0] >> 8, sample.depths[last] >> 8
    back = np.full((size * size, 3), 255, np.uint8)
    back[sample.pixels] = sample.colors[last]
    gray = [np.repeat(plane.reshape(size, size, 1), 3, 2) for plane in depth]
    return [over_white(sample.picture), *gray, back.reshape(size, size, 3)]


def sheet(rows: Sequence[Sequence[UInt8[np.ndarray, "s s 3"]]]) -> Image.Image:
    """Return one picture of rows of tiles."""
    return Image.fromarray(np.concatenate([np.concatenate(row, 1) for row in rows], 0))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a contact sheet of synthetic shapes."""
    parser = argparse.ArgumentParser(prog="python -m training.shape_prior.sheets", description=main.__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--family", choices=[*FAMILIES, "each"], help="one of them, or one row of each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rows", type=int, default=8)
    parser.add_argument("--columns", type=int, default=12)
    parser.add_argument("--tile", type=int, default=SIZE, help="pixels of a side of every tile")
    parser.add_argument("--layers", action="store_true", help="four tiles for every shape, not its picture alone")
    given = parser.parse_args(arguments)
    names = list(FAMILIES) if given.family == "each" else [given.family] * given.rows
    rows = []
    for row, name in enumerate(names):
        made = [make_sample(given.seed, row * given.columns + i, name) for i in range(given.columns)]
        rows.append([tile for sample in made for tile in (tiles_of(sample) if given.layers else tiles_of(sample)[:1])])
    whole = sheet(rows)
    size = (whole.width * given.tile // SIZE, whole.height * given.tile // SIZE)
    whole.resize(size, Image.Resampling.LANCZOS).save(given.output)


if __name__ == "__main__":
    main()
