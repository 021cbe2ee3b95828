"""Quality of `--asset`: true meshes of the first frame, driven by their videos, beside the frozen truth.

    python -m benchmarks.own_asset FOLDER [--names panda mage] [--sheets DIR]
    python -m benchmarks.own_asset --made-up

FOLDER has a folder per object with `input/`, `view_AZIMUTH/`, `bank/` and `mesh.npz`. The model of an object is its mesh
of frame 0, with colors baked from frame 0 of the bank.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import benchmarks.measure  # noqa: F401 (before torch: how its threads wait)

import numpy as np  # isort: skip
import torch  # isort: skip
from jaxtyping import Float, Int
from PIL import Image
from torch import Tensor

from benchmarks.objects.drawing import Painted
from benchmarks.objects.specimens import OBJECTS
from dg4d_lib.cameras.orbit import OrbitCamera, viewmats
from dg4d_lib.fitting.asset_motion import fit_asset_motion
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import over_white
from dg4d_lib.mesh.models.control_graph import build_control_graph
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.surface_cloud import cover_surface
from dg4d_lib.mesh.texturing.bake import locate_texels, vertex_normals
from dg4d_lib.mesh.texturing.unwrap import unwrap
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.metrics.image import iou, psnr
from dg4d_lib.metrics.surface import chamfer_distance, sample_surface
from dg4d_lib.metrics.video import temporal_error
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import AssetSettings
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.ground_truth import find_ground_truths
from steps.artifacts.media import read_png
from steps.fitting.priors import read_bank_folder

SIZE = 256  # pixels of the compared pictures
TEXTURE = 512  # texels per side of baked models
SAMPLES = 20000  # points of a surface for the chamfer distance
DEPTH_SLACK = 0.02  # world units by which a texel may lie behind the surface that a bank view shows
COLUMNS = ("psnr", "psnr_obj", "iou", "terr", "chamfer", "flipped", "input")
FPS = 12.0


@dataclass(frozen=True)
class Subject:
    """Model of an object at its first frame, its footage, and its truth.

    Attributes:
        name: of the object.
        model: mesh of frame 0, in world units.
        footage: cut-outs, straight alpha.
        views: azimuth to cut-outs.
        vertices: of the true meshes.
        faces: of the true meshes.
        weights: of the faces in samples of the surface.
    """

    name: str
    model: Model
    footage: Float[Tensor, "t h w 4"]
    views: dict[float, Float[Tensor, "t h w 4"]]
    vertices: Float[Tensor, "t v 3"]
    faces: Int[Tensor, "f 3"]
    weights: Float[Tensor, " f"]


def read_subjects(folder: Path, names: Sequence[str] = ()) -> Iterator[Subject]:
    """Read the objects of a data set, all of them if none is named."""
    for truth in find_ground_truths(folder):
        if (names and truth.name not in names) or truth.mesh is None or truth.bank is None:
            continue
        with np.load(truth.mesh) as archive:
            vertices = torch.from_numpy(archive["vertices"].astype(np.float32))
            faces = torch.from_numpy(archive["faces"].astype(np.int64))
            weights = torch.from_numpy(archive["face_weight"].astype(np.float32))
        footage = torch.stack([read_png(path) for path in truth.inputs])
        views = {view.azimuth_deg: torch.stack([read_png(path) for path in view.frames]) for view in truth.views}
        model = baked_model(vertices[0], faces, truth.bank)
        yield Subject(truth.name, model, footage, views, vertices, faces, weights)


def made_up_subjects(frames: int, names: Sequence[str] = ()) -> Iterator[Subject]:
    """Draw our own objects, for tuning."""
    azimuths = (-75.0, 15.0, 105.0, 195.0)
    cameras = [OrbitCamera(0, azimuth, width=SIZE, height=SIZE) for azimuth in (0.0, *azimuths)]
    for name, make in OBJECTS.items():
        if names and name not in names:
            continue
        painted = Painted(make())
        pictures = torch.stack([painted.draw(frame / frames, cameras) for frame in range(frames)], 1)
        vertices = torch.stack([painted.vertices(frame / frames) for frame in range(frames)])
        linear = np.power(painted.colors.numpy(), 2.2)
        part = ModelPart(name, vertices[0].numpy(), painted.faces.numpy(), colors=linear)
        views = dict(zip(azimuths, pictures[1:], strict=True))
        yield Subject(name, Model((part,)), pictures[0], views, vertices, painted.faces, torch.ones(len(painted.faces)))


def baked_model(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], bank_folder: Path) -> Model:
    """Return a mesh with a texture: means over the views of a bank's first frame that see a texel, by their angle."""
    bank = read_bank_folder(bank_folder)
    sources, corners, uvs = map(torch.from_numpy, unwrap(vertices.numpy(), faces.numpy(), TEXTURE))
    split, corners = vertices[sources.long()], corners.long()
    normals = vertex_normals(vertices, faces)[sources.long()]
    texels = locate_texels(split, normals, corners, uvs, TEXTURE)
    pictures = bank.pictures[:, bank.frames.index(0)].float() / 255
    depth = rasterize_mesh(vertices, faces, list(bank.cameras)).depth
    total, weight = torch.zeros(len(texels.rows), 3), torch.full((len(texels.rows), 1), 1e-9)
    for camera, matrix, picture, nearest in zip(bank.cameras, viewmats(bank.cameras), pictures, depth, strict=True):
        seen = texels.positions @ matrix[:3, :3].T.float() + matrix[:3, 3].float()
        pixel = seen[:, :2] / seen[:, 2:] * camera.focal + camera.width / 2
        column, row = (pixel.floor().long().clamp(0, camera.width - 1)).T
        towards = torch.nn.functional.normalize(camera.position().float() - texels.positions, dim=-1)
        facing = (towards * texels.normals).sum(-1).abs()  # some meshes are one-sided
        visible = (seen[:, 2] < nearest[row, column] + DEPTH_SLACK) & (picture[row, column, 3] > 0.9)
        share = (facing.square().square() * visible + 1e-6 * (picture[row, column, 3] > 0.5))[:, None]
        total += share * picture[row, column, :3]
        weight += share
    texture = np.full((TEXTURE, TEXTURE, 4), 255, np.uint8)
    texture[texels.rows, texels.columns, :3] = (255 * total / weight).round().clamp(0, 255).numpy()
    for _ in range(4):  # grow the charts, for bilinear sampling
        texture = _grown(texture, texels.rows, texels.columns)
    return Model((ModelPart("object", split.numpy(), corners.numpy(), uvs.numpy(), texture),))


def _grown(texture: np.ndarray, rows: Tensor, columns: Tensor) -> np.ndarray:
    from scipy.ndimage import distance_transform_edt

    empty = np.ones(texture.shape[:2], bool)
    empty[rows, columns] = False
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return texture[tuple(nearest)]


def score(
    subject: Subject, states: Gaussians, moved: Float[Tensor, "t v 3"], faces: Int[Tensor, "f 3"]
) -> dict[str, float]:
    """Compare renders and meshes of a motion with the truth."""
    rasterize = get_rasterizer("auto")
    rows = []
    for azimuth, truth in {0.0: subject.footage, **subject.views}.items():
        camera = OrbitCamera(0, azimuth, width=SIZE, height=SIZE)
        with torch.no_grad():
            drawn = rasterize(states, [camera] * len(states.means), torch.ones(3))
        rows.append(_figures(drawn.color.clamp(0, 1), drawn.alpha, truth))
    mean = {name: float(np.mean([row[name] for row in rows[1:]])) for name in rows[0]}
    generator = torch.Generator().manual_seed(0)
    distances = [
        chamfer_distance(
            sample_surface(ours, faces, SAMPLES, generator),
            sample_surface(theirs, subject.faces, SAMPLES, generator, subject.weights),
        )
        for ours, theirs in zip(moved, subject.vertices, strict=True)
    ]
    return {**mean, "chamfer": float(np.mean(distances)), "input": rows[0]["psnr"]}


def _figures(
    color: Float[Tensor, "t h w 3"], alpha: Float[Tensor, "t h w 1"], truth: Float[Tensor, "t h w 4"]
) -> dict[str, float]:
    theirs = over_white(truth)
    region = ((alpha > 0.5) | (truth[..., 3:] > 0.5)).float()
    return {
        "psnr": float(psnr(color, theirs).mean()),
        "psnr_obj": float(psnr(color, theirs, region).mean()),
        "iou": float(iou(alpha, truth[..., 3:]).mean()),
        "terr": float(temporal_error(color, theirs)),
    }
