"""The `tracked` and `meshes` artifacts: textured meshes in safetensors; equal meshes give equal bytes."""

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import to_bytes
from dg4d_lib.mesh.textured import TexturedMesh, TrackedMesh
from steps.artifacts.media import read_tensors, write_zip


def write_tracked(path: Path, tracked: TrackedMesh) -> None:
    """Write a tracked mesh; textures are rounded to 8 bits."""
    tensors = {**_tensors(tracked.mesh), "offsets": tracked.offsets.float().cpu().contiguous()}
    if tracked.textures is not None:
        tensors["textures"] = to_bytes(tracked.textures).contiguous()
    path.write_bytes(save(tensors, {"tracked": json.dumps({"rest": tracked.reference_frame})}))


def read_tracked(path: Path) -> TrackedMesh:
    """Read a file of `write_tracked`.

    Raises:
        BadInput: the file is not a tracked mesh.
    """
    try:
        about, tensors = read_tensors(path, "tracked")
        textures = tensors["textures"].float() / 255 if "textures" in tensors else None
        return TrackedMesh(_mesh(tensors), tensors["offsets"], textures, float(about["rest"]))
    except (SafetensorError, KeyError) as error:
        raise BadInput(
            f"{path.name} is not a tracked mesh ({error}); give the `tracked` output of extract_mesh"
        ) from error


def write_meshes(path: Path, meshes: Mapping[int, TexturedMesh]) -> None:
    """Write meshes by the number of their frame."""
    write_zip(path, [(f"{frame:03d}.safetensors", save(_tensors(mesh))) for frame, mesh in sorted(meshes.items())])


def read_meshes(path: Path) -> list[TexturedMesh]:
    """Read a file of `write_meshes`, in the order of the frames.

    Raises:
        BadInput: the file holds no meshes, or frames are missing between them.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = sorted(name for name in archive.namelist() if name.endswith(".safetensors"))
            meshes = [_mesh(load(archive.read(name))) for name in names]
    except (zipfile.BadZipFile, SafetensorError, KeyError) as error:
        raise BadInput(f"{path.name} holds no meshes ({error}); give the `meshes` output of extract_mesh") from error
    frames = [int(Path(name).stem) for name in names]
    if not frames or frames != list(range(frames[0], frames[0] + len(frames))):
        raise BadInput(f"{path.name} should hold a mesh of every frame; it has frames {frames}: extract the mesh again")
    return meshes


def _tensors(mesh: TexturedMesh) -> dict[str, Tensor]:
    tensors = {
        "vertices": mesh.vertices.detach().cpu().float(),
        "faces": mesh.faces.cpu().to(torch.int32),
        "uvs": mesh.uvs.detach().cpu().float(),
        "texture": to_bytes(mesh.texture),
    }
    if mesh.smoothing_groups is not None:
        tensors["smoothing_groups"] = mesh.smoothing_groups.cpu().to(torch.int32)
    return {name: value.contiguous() for name, value in tensors.items()}


def _mesh(tensors: Mapping[str, Tensor]) -> TexturedMesh:
    texture, groups = tensors["texture"].float() / 255, tensors.get("smoothing_groups")
    return TexturedMesh(tensors["vertices"], tensors["faces"], tensors["uvs"], texture, groups)
