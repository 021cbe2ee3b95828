"""USD reader: meshes of the first frame with their base colors, for `--asset`.

USDZ is checked before the USD library opens it: entries must be stored without compression, as the format demands, so
that a small file cannot grow.
"""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Ar, Usd, UsdGeom, UsdShade

from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, ModelPart

MAX_ENTRIES = 1000
Decode = Callable[[bytes, str], NDArray[np.uint8]]


def check_usdz(path: Path) -> None:
    """Refuse zips that are no USDZ: compressed or overlapping entries, or too many.

    Raises:
        BadInput: says why.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise BadInput(f"the USDZ is broken ({error}); export it again") from error
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise BadInput("the USDZ has compressed entries, which the format forbids; export it again")
    size, inside = path.stat().st_size, sum(entry.file_size for entry in entries)
    if len(entries) > MAX_ENTRIES or inside > size:
        raise BadInput(
            f"the USDZ says that it holds {len(entries)} files of {inside} bytes, and has {size} bytes itself; at most "
            f"{MAX_ENTRIES} files are read, none twice: export it again"
        )


def read_usd(path: Path, decode: Decode, max_faces: int) -> Model:
    """Read the visible meshes of a USDZ, at its first time, in meters' axes with y up.

    Args:
        path: file that `check_usdz` accepted.
        decode: decodes pictures; given the content and the name.
        max_faces: largest number of triangles.

    Raises:
        BadInput: it cannot be read, or has no or too many triangles.
    """
    try:
        stage = Usd.Stage.Open(str(path))
    except Exception as error:  # pxr raises its own ErrorException, a RuntimeError
        raise BadInput(f"the USD file cannot be read ({str(error)[:200]}); export it again") from error
    if stage is None:
        raise BadInput("the USD file cannot be read; export it again")
    time = Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.Default()
    cache = UsdGeom.XformCache(time)
    upright = np.eye(3)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    parts, faces = [], 0
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Mesh) or UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        part = _part(UsdGeom.Mesh(prim), time, cache, upright, decode)
        if part is None:
            continue
        faces += len(part.faces)
        if faces > max_faces:
            raise BadInput(
                f"the model has more than {max_faces} triangles, the limit asset.max_faces: simplify it, or raise the "
                "limit with --set asset.max_faces=N"
            )
        parts.append(part)
    if not parts:
        raise BadInput("the USD file shows no triangles; give a mesh with faces")
    if not all(np.isfinite(part.vertices).all() for part in parts):
        raise BadInput("the model has vertices that are not finite numbers (NaN or infinity); export it again")
    return Model(tuple(parts))


def _part(mesh: UsdGeom.Mesh, time: Any, cache: Any, upright: NDArray[np.float64], decode: Decode) -> ModelPart | None:
    points = np.array(mesh.GetPointsAttr().Get(time) or [], float).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    if not len(counts) or counts.min() < 3:
        return None
    if counts.sum() != len(indices) or indices.min() < 0 or indices.max() >= len(points):
        raise BadInput("the faces of a mesh in the USD file do not fit its points; export it again")
    corners = _fans(counts)  # three positions in `indices` per triangle
    if mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded:
        corners = corners[:, ::-1]
    uvs = _per_corner(mesh.GetPrim(), ("st", "UVMap", "st0"), indices, time)
    colors = _per_corner(mesh.GetPrim(), ("displayColor",), indices, time)
    texture, factor = _material(mesh.GetPrim(), decode)
    rows = [indices[:, None].astype(float)] + [values for values in (uvs, colors) if values is not None]
    unique, faces = np.unique(np.concatenate(rows, 1), axis=0, return_inverse=True)
    matrix = np.array(cache.GetLocalToWorldTransform(mesh.GetPrim()))  # row vectors
    placed = points @ matrix[:3, :3] + matrix[3, :3]
    split = unique[:, 0].astype(np.int64)
    width = 0 if uvs is None else 2
    textured = uvs is not None and texture is not None
    return ModelPart(
        mesh.GetPrim().GetName(),
        (placed @ upright.T)[split].astype(np.float32),
        faces.ravel()[corners],
        np.stack([unique[:, 1], 1 - unique[:, 2]], 1) if textured else None,
        texture if textured else None,
        (1.0, 1.0, 1.0) if textured or colors is not None else factor,
        unique[:, 1 + width :] if colors is not None and not textured else None,
    )


def _fans(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the corners of the triangles that polygons with these numbers of corners are split into."""
    starts = np.repeat(np.cumsum(counts) - counts, counts - 2)
    number = np.arange(len(starts)) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    return np.stack([starts, starts + number + 1, starts + number + 2], 1)


def _per_corner(prim: Any, names: tuple[str, ...], indices: NDArray[np.int64], time: Any) -> NDArray[np.float64] | None:
    """Return the values of the first existing primvar at every corner; None if it cannot be used."""
    api = UsdGeom.PrimvarsAPI(prim)
    for name in names:
        primvar = api.GetPrimvar(name)
        if not primvar or not primvar.HasValue():
            continue
        values = np.array(primvar.ComputeFlattened(time), float)
        values = values.reshape(len(values), -1) if len(values) else values.reshape(0, 1)
        match primvar.GetInterpolation():
            case UsdGeom.Tokens.faceVarying if len(values) == len(indices):
                return values
            case UsdGeom.Tokens.vertex | UsdGeom.Tokens.varying if len(values) > indices.max():
                return values[indices]
            case UsdGeom.Tokens.constant if len(values):
                return np.repeat(values[:1], len(indices), 0)
    return None


def _material(prim: Any, decode: Decode) -> tuple[NDArray[np.uint8] | None, tuple[float, float, float]]:
    """Return the base color texture, if there is one, and the linear base color."""
    gray = (0.5, 0.5, 0.5)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    if not material:
        return None, gray
    shader, _, _ = material.ComputeSurfaceSource()
    color = shader.GetInput("diffuseColor") if shader else None
    if not color:
        return None, gray
    if not color.HasConnectedSource():
        value = color.Get()
        return None, gray if value is None else (float(value[0]), float(value[1]), float(value[2]))
    source = UsdShade.Shader(color.GetConnectedSources()[0][0].source.GetPrim())
    file = source.GetInput("file")
    picture = file.Get() if file else None
    if picture is None:
        return None, gray
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(picture.resolvedPath)) if picture.resolvedPath else None
    if asset is None:
        raise BadInput(f"the texture {picture.path[:80]!r} of the model is missing; pack it into the USDZ")
    return decode(bytes(asset.GetBuffer()), picture.path), gray
