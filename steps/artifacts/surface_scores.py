"""Distances of a package's meshes to the true meshes of an object."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.metrics.actionbench import align_points, chamfer_3d, chamfer_4d, chamfer_motion, unit_box
from dg4d_lib.metrics.surface import align_bounding_boxes, chamfer_distance, place_points, sample_surface
from steps.artifacts.packages import read_manifest
from steps.artifacts.rendering import fitted_positions, mesh_at, read_surface

UNTRACKED = "CD-M follows points of one mesh; this asset has a mesh per frame (mesh.mode=tracked makes one)"


@dataclass(frozen=True)
class TrueMeshes:
    """Animated mesh of the ground truth.

    Attributes:
        vertices: of every frame.
        faces: triangles.
        weights: factors on the areas of the triangles; None is 1.
    """

    vertices: Float[Tensor, "t v 3"]
    faces: Int[Tensor, "f 3"]
    weights: Float[Tensor, " f"] | None = None

    def __len__(self) -> int:
        return len(self.vertices)


def read_true_meshes(path: Path) -> TrueMeshes:
    """Read `mesh.npz`.

    Raises:
        BadInput: it holds no meshes.
    """
    try:
        with np.load(path) as archive:
            vertices = torch.from_numpy(archive["vertices"].astype(np.float32))
            faces = torch.from_numpy(archive["faces"].astype(np.int64))
            weights = torch.from_numpy(archive["face_weight"].astype(np.float32)) if "face_weight" in archive else None
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise BadInput(f"{path.name} holds no meshes (vertices [t v 3], faces [f 3]): {error!r}") from error
    return TrueMeshes(vertices, faces, weights)


def chamfer_scores(
    package: Path, ground_truth: TrueMeshes, samples: int, seed: int, end: float = 1.0
) -> dict[str, float]:
    """Return chamfer distances, means over frames: without and with one alignment of bounding boxes.

    Args:
        package: unpacked folder.
        ground_truth: true meshes.
        samples: points per surface.
        seed: of all samples.
        end: share of the true frames' time after which the last frame of the fit is repeated.
    """
    generator = torch.Generator().manual_seed(seed)
    theirs = torch.stack(
        [
            sample_surface(frame, ground_truth.faces, samples, generator, ground_truth.weights)
            for frame in ground_truth.vertices
        ]
    )
    meshes, _ = _meshes(package, len(ground_truth), end)
    ours = torch.stack([sample_surface(mesh.vertices, mesh.faces, samples, generator) for mesh in meshes])
    return {
        name: fmean(chamfer_distance(a, b) for a, b in zip(points, theirs, strict=True))
        for name, points in (("chamfer", ours), ("chamfer_aligned", align_bounding_boxes(ours, theirs)))
    }


def actionbench_scores(
    package: Path, ground_truth: TrueMeshes, samples: int, icp_points: int, seed: int, end: float = 1.0
) -> tuple[dict[str, float], str]:
    """Return CD-3D, CD-4D and, of a tracked mesh, CD-M; and the reason why the last is missing, else nothing.

    Args:
        package: unpacked folder.
        ground_truth: true meshes.
        samples: points per surface.
        icp_points: points for the alignment.
        seed: of all samples.
        end: share of the true frames' time after which the last frame of the fit is repeated.
    """
    generator = torch.Generator().manual_seed(seed)
    center, factor = unit_box(ground_truth.vertices.double())
    places = place_points(ground_truth.vertices[0], ground_truth.faces, samples, generator, ground_truth.weights)
    theirs = torch.stack([places.at(frame) for frame in ground_truth.vertices])
    theirs = (theirs - center) * factor
    meshes, tracked = _meshes(package, len(ground_truth), end)
    ours = torch.stack([sample_surface(mesh.vertices, mesh.faces, samples, generator) for mesh in meshes])
    ours = (ours - center) * factor
    alignments = [align_points(a[:icp_points], b[:icp_points]) for a, b in zip(ours, theirs, strict=True)]
    found = {"cd_3d": chamfer_3d(ours, theirs, alignments), "cd_4d": chamfer_4d(ours, theirs, alignments[0])}
    if not tracked:
        return found, UNTRACKED
    places = place_points(meshes[0].vertices, meshes[0].faces, samples, generator)
    followed = torch.stack([places.at(mesh.vertices) for mesh in meshes])
    return {**found, "cd_m": chamfer_motion((followed - center) * factor, theirs, alignments[0])}, ""


def _meshes(package: Path, frames: int, end: float) -> tuple[list[TexturedMesh], bool]:
    """Return the mesh at evenly spaced times, and whether all have the same triangles."""
    manifest = read_manifest(package)
    surface = read_surface(package, manifest)
    meshes = [mesh_at(surface, position) for position in fitted_positions(frames, package, manifest, end)]
    return meshes, isinstance(surface, Asset4D)
