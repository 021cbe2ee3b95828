"""Check of a network on objects with known views: its surface of the first frame beside the inflated one.

    python -m training.shape_prior.evaluate out/shape_prior/network.safetensors FOLDER --sheet sheet.png

FOLDER has a folder per object with `input/000.png` and `view_AZIMUTH/000.png`, cut-outs taken at elevation 0.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from PIL import Image
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface, inflate
from dg4d_lib.shape_prior.frustum import BINS, FAR, KNOTS, NEAR, SIZE, TAN_HALF_FOV
from dg4d_lib.shape_prior.network import ShapePrediction, ShapePriorNetwork, load_network

THRESHOLD = -0.7  # logit: the best cut for intersection over union is half of the overlap that is reached
RENDER = 256  # pixels of the compared pictures
NOTHING = -8.0  # logit outside the silhouette


@torch.no_grad()
def predict(network: ShapePriorNetwork, cutout: Float[Tensor, "h w 4"]) -> ShapePrediction:
    """Return the mean of the predictions for a picture and for its mirror image (fields that are pictures only)."""
    alpha = cutout[..., 3:]
    picture = torch.cat([cutout[..., :3] * alpha, alpha], -1).permute(2, 0, 1)[None]
    picture = interpolate(picture, (SIZE, SIZE), mode="bilinear", antialias=True).clamp(0, 1)
    here, there = network(picture), network(picture.flip(3))
    return ShapePrediction(
        occupancy=(here.occupancy + there.occupancy.flip(3)) / 2,
        colors=(here.colors + there.colors.flip(4)) / 2,
        color_scale=(here.color_scale + there.color_scale.flip(3)) / 2,
        mirror_moment=here.mirror_moment,
        mirror_point=here.mirror_point,
        symmetric=here.symmetric,
    )


def surface_of(cutout: Float[Tensor, "h w 4"], prediction: ShapePrediction, threshold: float) -> InflatedSurface:
    """Return the surface at a threshold of the occupancy's logit, colored from the picture and the hidden colors."""
    alpha = interpolate(cutout[None, None, ..., 3], (SIZE, SIZE), mode="bilinear", antialias=True)[0, 0]
    logits = prediction.occupancy[0] - threshold
    missing = (0.5 - logits.amax(0)).clamp(min=0)  # every pixel of the silhouette has some matter
    logits = torch.where(alpha > 0.5, logits + missing, NOTHING).clamp(NOTHING, -NOTHING)
    volume = np.pad(logits.permute(1, 2, 0).numpy(), 1, constant_values=NOTHING)
    places, faces, _, _ = marching_cubes(volume, 0.0)
    row, column, cell = (places - 1 + 0.5).T
    distance = NEAR + cell / BINS * (FAR - NEAR)
    x, y = (2 * column / SIZE - 1) * TAN_HALF_FOV, (1 - 2 * row / SIZE) * TAN_HALF_FOV
    vertices = torch.from_numpy(np.stack([x * distance, y * distance, RADIUS - distance], -1)).double()
    triangles = torch.from_numpy(faces.astype(np.int64))
    corners = vertices[triangles]
    if (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() < 0:
        triangles, corners = triangles.flip(1), corners.flip(1)
    normals = torch.zeros_like(vertices)
    crosses = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for corner in range(3):
        normals.index_add_(0, triangles[:, corner], crosses)
    to_camera = torch.tensor([0.0, 0, RADIUS], dtype=torch.float64) - vertices
    cosine = torch.nn.functional.cosine_similarity(normals, to_camera)
    at = torch.from_numpy(np.stack([2 * column / SIZE - 1, 2 * row / SIZE - 1], -1)).float()
    depth = torch.from_numpy((distance - NEAR) / (FAR - NEAR)).float()
    shown = (torch.sigmoid(12 * cosine) * _first(logits, at, depth))[:, None].float()
    colors = shown * _front(cutout, at) + (1 - shown) * _hidden(prediction.colors[0], at, depth)
    return InflatedSurface(vertices, triangles, colors.double(), shown[:, 0] > 0.5)


def _first(logits: Float[Tensor, "64 128 128"], at: Float[Tensor, "v 2"], depth: Float[Tensor, " v"]) -> Tensor:
    """Return 1 for points on the first surface of their ray, 0 for points behind it."""
    cells = torch.arange(BINS)[:, None, None]
    first = torch.where(logits > 0, cells, BINS).amin(0).float() / BINS
    own = grid_sample(first[None, None], at[None, None], mode="nearest", align_corners=False)[0, 0, 0]
    return (depth < own + 2.5 / BINS).float()


def _front(cutout: Float[Tensor, "h w 4"], at: Float[Tensor, "v 2"]) -> Float[Tensor, "v 3"]:
    planes = torch.cat([cutout[..., :3] * cutout[..., 3:], cutout[..., 3:]], -1).permute(2, 0, 1)[None]
    found = grid_sample(planes, at[None, None], align_corners=False, padding_mode="border")[0, :, 0].T
    return (found[:, :3] / found[:, 3:].clamp(min=0.05)).clamp(0, 1)


def _hidden(
    colors: Float[Tensor, "8 3 128 128"], at: Float[Tensor, "v 2"], depth: Float[Tensor, " v"]
) -> Float[Tensor, "v 3"]:
    place = torch.cat([at, 2 * depth[:, None] - 1], 1)[None, None, None]
    volume = colors.permute(1, 0, 2, 3)[None]
    assert volume.shape[2] == KNOTS
    return grid_sample(volume, place, align_corners=True, padding_mode="border")[0, :, 0, 0].T


def compare(
    surface: InflatedSurface, views: dict[float, Float64[np.ndarray, "h w 4"]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return intersection over union, psnr and psnr on the object for every view, and the pictures on white."""
    cameras = [OrbitCamera(0, azimuth, width=RENDER, height=RENDER) for azimuth in views]
    color, alpha = (part.double().numpy() for part in render_surface(surface, cameras, supersample=2))
    rows = []
    for c, a, truth in zip(color, alpha, views.values(), strict=True):
        true_alpha = truth[..., 3:]
        error = (c * a + 1 - a - truth[..., :3] * true_alpha - 1 + true_alpha) ** 2
        either, both = (a > 0.5) | (true_alpha > 0.5), (a > 0.5) & (true_alpha > 0.5)
        rows.append(
            (both.sum() / either.sum(), -10 * np.log10(error.mean()), -10 * np.log10(error[either[..., 0]].mean()))
        )
    return np.array(rows), color * alpha + 1 - alpha


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare a network with the inflation on objects whose views are known."""
    parser = argparse.ArgumentParser(prog="python -m training.shape_prior.evaluate", description=main.__doc__)
    parser.add_argument("weights", type=Path)
    parser.add_argument("objects", type=Path)
    parser.add_argument("--threshold", type=float, default=THRESHOLD, help="logit of the surface")
    parser.add_argument("--sheet", type=Path, help="picture: input, truth, inflation, network")
    given = parser.parse_args(arguments)
    network, rows, figures = load_network(given.weights), [], {}
    for folder in sorted(path for path in given.objects.iterdir() if (path / "input").is_dir()):
        names = sorted(folder.glob("view_*"), key=lambda path: float(path.name[5:]))
        views = {float(path.name[5:]): _rgba(path / "000.png") for path in names}
        cutout = torch.from_numpy(_rgba(folder / "input/000.png")).float()
        inflated, before = compare(inflate(cutout, SIZE), views)
        learned, after = compare(surface_of(cutout, predict(network, cutout), given.threshold), views)
        figures[folder.name] = {
            "inflation": inflated.mean(0).round(3).tolist(),
            "network": learned.mean(0).round(3).tolist(),
        }
        figures[folder.name]["views"] = np.stack([inflated[:, 0], learned[:, 0]]).round(3).tolist()
        truth = [view[..., :3] * view[..., 3:] + 1 - view[..., 3:] for view in views.values()]
        own = cutout.numpy()
        rows.append(np.concatenate([own[..., :3] * own[..., 3:] + 1 - own[..., 3:], *truth, *before, *after], 1))
    for name in ("inflation", "network"):
        figures[f"mean of {name}"] = (
            np.mean([each[name] for each in figures.values() if name in each], 0).round(3).tolist()
        )
    for name, row in figures.items():
        sys.stdout.write(f"{name:20s} {json.dumps(row)}\n")
    if given.sheet:
        whole = Image.fromarray((np.concatenate(rows).clip(0, 1) * 255).astype(np.uint8))
        whole.resize((whole.width // 2, whole.height // 2), Image.Resampling.BOX).save(given.sheet)


def _rgba(path: Path) -> Float64[np.ndarray, "h w 4"]:
    with Image.open(path) as image:
        sized = image.convert("RGBA").resize((RENDER, RENDER), Image.Resampling.BOX)
    return np.asarray(sized, np.float64) / 255


if __name__ == "__main__":
    main()
