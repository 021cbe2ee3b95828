"""USD reader: meshes of the first frame with their base colors, for `--asset`.

USDZ is checked before the USD library opens it: entries must be stored without compression, as the format demands, so
that a small file cannot grow.
"""

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Usd, UsdGeom, UsdShade, UsdSkel, UsdVol

from dg4d_lib.assets.formats.usd_colors import WHITE, Decode, UsdColor, UsdMaterials
from dg4d_lib.assets.formats.usdz import check_entries
from dg4d_lib.errors import BadInput, listed
from dg4d_lib.mesh.models.model import Model, ModelPart, single_precision, too_many_triangles
from dg4d_lib.mesh.models.polygons import triangulate

MAX_PRIMS = 100_000
GRAY = (0.5, 0.5, 0.5)  # of a material without a readable color, linear
MOST_NAMED = 5  # objects in a note
_BROKEN = (TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RuntimeError)  # the last one by pxr


def check_usdz(path: Path) -> None:
    """Refuse zips that are not USDZ: compressed or overlapping entries, or too many.

    Raises:
        BadInput: says why.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise BadInput(f"the USDZ is broken ({error}); export it again") from error
    check_entries(entries, path.stat().st_size, "the USDZ")


def read_usd(path: Path, decode: Decode, max_faces: int) -> Model:
    """Read the rendered meshes of a USDZ, at its first time, y up; a part per mesh and material.

    Skeletons pose their meshes, and meshes of instances are read at every place.

    Args:
        path: file that `check_usdz` accepted.
        decode: decodes pictures; given the content and the name.
        max_faces: largest number of triangles.

    Raises:
        BadInput: it cannot be read, has a PointInstancer, or no or too many triangles.
    """
    try:
        stage = Usd.Stage.Open(str(path))
    except Exception as error:  # pxr raises its own ErrorException, a RuntimeError
        raise BadInput(f"the USD file cannot be read ({str(error)[:200]}); export it again") from error
    if stage is None:
        raise BadInput("the USD file cannot be read; export it again")
    package = stage.GetRootLayer().realPath
    layers = [layer.realPath for layer in stage.GetUsedLayers() if not layer.anonymous]
    if any(layer != package and not layer.startswith(f"{package}[") for layer in layers):
        raise BadInput("the USD file refers to files outside of its package; pack them into the USDZ")
    start = stage.GetStartTimeCode()
    stage.SetEditTarget(stage.GetSessionLayer())
    UsdSkel.BakeSkinning(stage.Traverse(), Gf.Interval(start))
    time, upright = Usd.TimeCode(start), np.eye(3)
    cache = UsdGeom.XformCache(time)
    if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z:
        upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    parts: list[ModelPart] = []
    others: list[str] = []  # visible objects that are not meshes
    faces, materials = 0, UsdMaterials(package, decode)
    for number, prim in enumerate(stage.Traverse(Usd.TraverseInstanceProxies())):
        if number >= MAX_PRIMS:
            raise BadInput(f"the USD file has more than {MAX_PRIMS} objects; simplify it")
        if not prim.IsA(UsdGeom.Boundable) or not _is_rendered(UsdGeom.Imageable(prim), time):
            continue
        if prim.IsA(UsdGeom.PointInstancer):
            raise BadInput(
                f"the USD file has meshes at many places (the PointInstancer {prim.GetName()[:80]!r}); export it "
                "without instancing"
            )
        if not prim.IsA(UsdGeom.Mesh):
            if prim.IsA(UsdGeom.Gprim):
                others.append(f"{prim.GetTypeName()} {prim.GetName()[:80]!r}")
            continue
        found = _parts(UsdGeom.Mesh(prim), time, cache, upright, materials)
        parts += found
        faces += sum(len(part.faces) for part in found)
        if faces > max_faces:
            raise too_many_triangles(max_faces)
    if not parts:
        raise BadInput(_no_mesh(stage))
    return single_precision(parts, (*dict.fromkeys(materials.notes), *_left_out(others)))


def _left_out(objects: list[str]) -> list[str]:
    """Return a note about objects that are not meshes."""
    if not objects:
        return []
    return [f"objects of the USD file that are not meshes were left out: {listed(objects, MOST_NAMED)}"]


def _no_mesh(stage: Usd.Stage) -> str:
    """Return the error message for a file without triangles."""
    if any(prim.IsA(UsdVol.ParticleField) for prim in stage.Traverse()):
        return (
            "the USD file contains splats and no mesh; splats are read from PLY and SPZ: give one of these, such as "
            "splats/000.ply of a dg4d package, or its mesh, asset.usdz"
        )
    return "the USD file contains no triangles; give a mesh with faces"


def _is_rendered(prim: UsdGeom.Imageable, time: Any) -> bool:
    """Return whether a prim is visible and neither a proxy of another one nor a guide."""
    visible = prim.ComputeVisibility(time) != UsdGeom.Tokens.invisible
    return visible and prim.ComputePurpose() not in (UsdGeom.Tokens.proxy, UsdGeom.Tokens.guide)


def _parts(
    mesh: UsdGeom.Mesh, time: Any, cache: Any, upright: NDArray[np.float64], materials: UsdMaterials
) -> list[ModelPart]:
    """Return a part for every material of a mesh.

    Raises:
        BadInput: attributes of the mesh or of its material have values of another type, or do not fit each other.
    """
    try:
        return list(_parts_by_material(mesh, time, cache, upright, materials))
    except _BROKEN as error:
        raise BadInput(
            f"the mesh {mesh.GetPrim().GetName()[:80]!r} of the USD file or its material cannot be read ({error}); "
            "export it again"
        ) from error


def _parts_by_material(
    mesh: UsdGeom.Mesh, time: Any, cache: Any, upright: NDArray[np.float64], materials: UsdMaterials
) -> Iterator[ModelPart]:
    prim = mesh.GetPrim()
    points = np.array(mesh.GetPointsAttr().Get(time) or [], float).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    if not counts.any():
        return
    if counts.min() < 0 or counts.sum() != len(indices) or indices.min() < 0 or indices.max() >= len(points):
        raise BadInput("the faces of a mesh in the USD file do not fit its points; export it again")
    corners = triangulate(points, indices, counts)
    names = [primvar.GetPrimvarName() for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvars() if _is_uv(primvar)]
    colors = _per_corner(prim, ("displayColor",), indices, counts, time)
    matrix = np.array(cache.GetLocalToWorldTransform(prim))  # row vectors
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    if mirrored != (mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded):
        corners = corners[:, ::-1]
    placed = (points @ matrix[:3, :3] + matrix[3, :3]) @ upright.T
    polygons = np.repeat(np.arange(len(counts)), (counts - 2).clip(0))  # of the triangles
    for owner, selected in _faces_by_material(mesh, len(counts), time):
        triangles = corners[selected[polygons]]
        if not len(triangles):
            continue
        color = materials.read(owner)
        if color is not None and color.is_hidden:
            continue
        shown = colors if color is None else None
        uvs = None
        if color is None:
            color = UsdColor(GRAY if shown is None else WHITE)
            if shown is None:
                materials.note_gray(owner)
        elif color.texture is not None:
            uvs = _per_corner(prim, (color.primvar, "st", "UVMap", "st0", *names), indices, counts, time)
            color = UsdColor(GRAY) if uvs is None else color
        rows = [indices[:, None].astype(float), *(values for values in (uvs, shown) if values is not None)]
        unique, faces = np.unique(np.concatenate(rows, 1)[triangles.ravel()], axis=0, return_inverse=True)
        yield ModelPart(
            prim.GetName() if owner == prim else f"{prim.GetName()} {owner.GetName()}",
            placed[unique[:, 0].astype(np.int64)],
            faces.reshape(-1, 3),
            None if uvs is None else color.place(unique[:, 1:3]),
            color.texture,
            color.factor,
            None if shown is None else unique[:, 1:],
            color.masked,
            color.wrap,
        )


def _faces_by_material(mesh: UsdGeom.Mesh, count: int, time: Any) -> Iterator[tuple[Any, NDArray[np.bool_]]]:
    """Return the subsets of a mesh with materials of their own, and the mesh for the rest, each with its faces."""
    rest = np.ones(count, bool)
    for subset in UsdShade.MaterialBindingAPI(mesh.GetPrim()).GetMaterialBindSubsets():
        listed = np.array(subset.GetIndicesAttr().Get(time) or [], np.int64)
        selected = np.zeros(count, bool)
        selected[listed[(listed >= 0) & (listed < count)]] = True
        yield subset.GetPrim(), selected & rest
        rest &= ~selected
    yield mesh.GetPrim(), rest


def _is_uv(primvar: Any) -> bool:
    return str(primvar.GetTypeName()) in ("texCoord2f[]", "texCoord2d[]", "texCoord2h[]", "float2[]")


def _per_corner(
    prim: Any, names: tuple[str, ...], indices: NDArray[np.int64], counts: NDArray[np.int64], time: Any
) -> NDArray[np.float64] | None:
    """Return the values of the first existing primvar at every corner; None if it cannot be used."""
    api = UsdGeom.PrimvarsAPI(prim)
    for name in filter(None, names):
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
            case UsdGeom.Tokens.uniform if len(values) == len(counts):
                return np.repeat(values, counts, 0)
            case UsdGeom.Tokens.constant if len(values):
                return np.repeat(values[:1], len(indices), 0)
    return None
