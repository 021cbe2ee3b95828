"""Animated meshes and splats as USDZ, and scenes of several assets.

Animations loop as in the GLB: one key after the last frame repeats the first; default values are those of the first
frame. A package contains one layer with the prim `/asset`, and the textures:

    /asset                      with splats: variant set "representation", "splats" (selected) or "mesh"
    /asset/mesh/subject         the tracked mesh; or /asset/mesh/frame_000, ... for meshes per frame
    /asset/mesh/materials/...   see usd_materials.py
    /asset/mesh/rig             skeleton, see usd_skeleton.py, if the mesh is skinned
    /asset/splats               only in the variant "splats", which deactivates /asset/mesh

So no reader draws both on top of each other. A mesh per frame has no points at other times, because Blender ignores
animated visibility. Readers that ignore animated textures, such as Blender, show the texture of the first frame.
"""

import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt
from torch import Tensor

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.normals import SmoothNormals, mesh_normal_groups, weld
from dg4d_lib.assets.formats.usd_materials import add_material, encode_texture
from dg4d_lib.assets.formats.usd_skeleton import add_skeleton, as_skel_root
from dg4d_lib.assets.formats.usd_splats import add_splats_variant
from dg4d_lib.assets.formats.usd_stage import (
    TIME_CODES_PER_SECOND,
    animate,
    bounds,
    file_reference,
    integers,
    new_stage,
    time_code,
    to_array,
    vectors,
)
from dg4d_lib.assets.formats.usdz import UsdzPackage, write_usdz_package
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.tracking.rig import Rig

DEFAULTS = GltfSettings()
ABOUT = "dg4d"  # key of the layer's custom data with the asset's JSON


def write_usdz(
    path: Path,
    surface: Asset4D | Sequence[TexturedMesh],
    fps: float,
    states: Gaussians | None = None,
    about: Mapping[str, Any] | None = None,
    settings: GltfSettings = DEFAULTS,
    *,
    open_pbr: bool = False,
    half: bool = False,
) -> None:
    """Write point samples of a mesh, optionally with splats, as USDZ; equal input gives equal bytes.

    Args:
        path: output file, `.usdz`.
        surface: tracked mesh, or a mesh per frame; the frame rate of an `Asset4D` is ignored.
        fps: frames per second.
        states: one state of the cloud per frame.
        about: JSON about the asset, stored as text in the layer's custom data; `name` becomes the display name.
        settings: image (jpeg replaces webp, which USDZ does not support), quality, moving_normals, roughness and
            metallic.
        open_pbr: add MaterialX networks, which the ARKit rules do not allow.
        half: half precision for what moves of the splats.

    Raises:
        BadInput: no frames, no triangles, different numbers of states and frames, an fps that is not positive, or
            numbers that are not finite.
        OSError: the file could not be written.
    """
    meshes = [surface.mesh] if isinstance(surface, Asset4D) else list(surface)
    frames = len(surface.offsets) if isinstance(surface, Asset4D) else len(meshes)
    _check(surface, meshes, frames, fps, states)
    stage = _new_asset(about, frames, fps)
    UsdGeom.Xform.Define(stage, "/asset/mesh")
    UsdGeom.Scope.Define(stage, "/asset/mesh/materials")
    if isinstance(surface, Asset4D):
        pictures = _add_tracked(stage, surface, fps, settings, open_pbr)
    else:
        pictures = _add_frames(stage, meshes, fps, settings, open_pbr)
    if states is not None:
        add_splats_variant(stage, states, fps, half)
    write_usdz_package(path, stage, "asset.usdc", pictures)


def write_skinned_usdz(
    path: Path,
    asset: Asset4D,
    rig: Rig,
    about: Mapping[str, Any] | None = None,
    settings: GltfSettings = DEFAULTS,
) -> None:
    """Write a tracked mesh that its rig moves as USDZ for Quick Look; equal input gives equal bytes.

    Args:
        path: output file, `.usdz`.
        asset: mesh and frames per second; textures per frame are not written.
        rig: rig of this asset.
        about: as in `write_usdz`.
        settings: image, quality, roughness and metallic.

    Raises:
        BadInput: no frames, no triangles, an fps that is not positive, numbers that are not finite, or the rig of
            another mesh.
        OSError: the file could not be written.
    """
    _check(asset, [asset.mesh], len(asset.offsets), asset.fps, None)
    if len(rig.weights) != len(asset.mesh.vertices) or len(rig.quats) != len(asset.offsets):
        raise BadInput(
            f"the rig must have the {len(asset.mesh.vertices)} vertices and {len(asset.offsets)} frames of the mesh; "
            f"given {len(rig.weights)} and {len(rig.quats)}: fit the rig again"
        )
    stage = _new_asset(about, len(asset.offsets), asset.fps)
    as_skel_root(stage, "/asset/mesh")
    UsdGeom.Scope.Define(stage, "/asset/mesh/materials")
    rest, moved = to_array(asset.mesh.vertices), to_array(asset.mesh.vertices + asset.offsets)
    states = np.concatenate([rest[None], moved])
    mesh, first = _add_mesh(stage, "subject", asset.mesh, states, None, settings)
    add_skeleton(stage, mesh, rest, first, rig, asset.fps)
    name, content = encode_texture("subject", asset.mesh.texture, settings)
    for file in add_material(stage, mesh, "subject", settings, open_pbr=False):
        file.Set(file_reference(name))
    write_usdz_package(path, stage, "asset.usdc", {name: content})


def _new_asset(about: Mapping[str, Any] | None, frames: int, fps: float) -> Usd.Stage:
    about = dict(about or {})
    stage = new_stage("/asset", "component", str(about.get("name", "asset")), time_code(frames, fps))
    if about:
        stage.GetRootLayer().customLayerData = {ABOUT: json.dumps(about, ensure_ascii=False)}
    return stage


@dataclass(frozen=True)
class UsdPlacement:
    """Placement of an asset in space and time.

    Attributes:
        name: display name, any text.
        file: output of `write_usdz`.
        transform: asset to scene, acts on column vectors.
        start_s: start of the animation, seconds; the asset stands still before.
        speed: playback speed relative to the recording, above 0.
        hold_s: time in the recording of the pose that the asset holds afterwards, seconds; None: of the last key, which
            repeats the first frame.
    """

    name: str
    file: Path
    transform: Float[Tensor, "4 4"]
    start_s: float = 0.0
    speed: float = 1.0
    hold_s: float | None = None

    @property
    def source(self) -> tuple[Path, float | None]:
        """File and last key; placements that share both share the stored data."""
        return self.file, self.hold_s


def compose_usdz(path: Path, placements: Sequence[UsdPlacement], duration_s: float | None = None) -> None:
    """Write a scene of several assets as USDZ; every file is stored once for all placements with the same `hold_s`.

    Args:
        path: output file, `.usdz`.
        placements: assets in space and time; finished assets stand still.
        duration_s: duration of the scene, seconds, above 0; None: until the last asset has played once.

    Raises:
        BadInput: no placements, a file that is not a USDZ with a default prim, or an invalid time, speed or transform.
        OSError: the file could not be written.
    """
    if not placements:
        raise BadInput("a scene needs at least one asset; given none")
    for placement in placements:
        _check_placement(placement)
    packages = {source: UsdzPackage(*source) for source in dict.fromkeys(p.source for p in placements)}
    if duration_s is None:
        duration_s = max(p.start_s + packages[p.source].duration_s / p.speed for p in placements)
    stage = new_stage("/scene", "assembly", "scene", duration_s * TIME_CODES_PER_SECOND)
    names = _identifiers([placement.name for placement in placements])
    named = list(zip(placements, names, strict=True))
    folders = {placement.source: name for placement, name in reversed(named)}  # the first name of every source
    for placement, name in named:
        xform = UsdGeom.Xform.Define(stage, f"/scene/{name}")
        xform.AddTransformOp().Set(Gf.Matrix4d(placement.transform.T.tolist()))  # USD transforms row vectors
        xform.GetPrim().SetDisplayName(placement.name)
        layer = f"./{folders[placement.source]}/{packages[placement.source].layer}"
        offset = Sdf.LayerOffset(placement.start_s * TIME_CODES_PER_SECOND, 1 / placement.speed)
        xform.GetPrim().GetPayloads().AddPayload(layer, Sdf.Path(), offset)
    files = {
        f"{folders[source]}/{name}": content
        for source, package in packages.items()
        for name, content in package.files.items()
    }
    write_usdz_package(path, stage, "scene.usdc", files)


def _check(
    surface: Asset4D | Sequence[TexturedMesh],
    meshes: Sequence[TexturedMesh],
    frames: int,
    fps: float,
    states: Gaussians | None,
) -> None:
    if frames == 0:
        raise BadInput("an animated asset needs at least one frame; given none")
    if not (fps > 0 and np.isfinite(fps)):
        raise BadInput(f"frames per second must be positive; given {fps}")
    values = [value for mesh in meshes for value in (mesh.vertices, mesh.uvs, mesh.texture)]
    if isinstance(surface, Asset4D):
        values += [surface.offsets] if surface.textures is None else [surface.offsets, surface.textures]
    if any(len(mesh.faces) == 0 for mesh in meshes):
        raise BadInput("a mesh without triangles cannot be written as USDZ; extract the mesh again")
    if states is not None:
        if states.means.dim() != 3 or len(states.means) != frames:
            given = f"means of shape {tuple(states.means.shape)}"
            raise BadInput(f"the splats need one state for each of the {frames} frames; given {given}")
        values += vars(states).values()
    if not all(value.isfinite().all() for value in values):
        raise BadInput("the asset holds numbers that are not finite; make it again")


def _check_placement(placement: UsdPlacement) -> None:
    if not (placement.speed > 0 and np.isfinite(placement.speed)):
        raise BadInput(f"{placement.name}: the speed must be positive; given {placement.speed}")
    if not (placement.start_s >= 0 and np.isfinite(placement.start_s)):
        raise BadInput(f"{placement.name}: the start must be 0 seconds or later; given {placement.start_s}")
    if not placement.transform.isfinite().all():
        raise BadInput(f"{placement.name}: the transform holds numbers that are not finite")


def _add_tracked(
    stage: Usd.Stage, asset: Asset4D, fps: float, settings: GltfSettings, open_pbr: bool
) -> dict[str, bytes]:
    """Define a tracked mesh; return its images by name in the package."""
    states = to_array(asset.mesh.vertices + asset.offsets)
    mesh, _ = _add_mesh(stage, "subject", asset.mesh, states, fps, settings)
    files = add_material(stage, mesh, "subject", settings, open_pbr)
    if asset.textures is None:
        pictures = [encode_texture("subject", asset.mesh.texture, settings)]
    else:
        pictures = [encode_texture(f"subject_{i:03d}", pixels, settings) for i, pixels in enumerate(asset.textures)]
        for file in files:
            animate(file, [file_reference(name) for name, _ in pictures], fps)
    for file in files:
        file.Set(file_reference(pictures[0][0]))
    return dict(pictures)


def _add_frames(
    stage: Usd.Stage, meshes: Sequence[TexturedMesh], fps: float, settings: GltfSettings, open_pbr: bool
) -> dict[str, bytes]:
    """Define a mesh per frame, each present at its frame only; return their images by name in the package."""
    pictures = {}
    for frame, textured in enumerate(meshes):
        name = f"frame_{frame:03d}"
        mesh, _ = _add_mesh(stage, name, textured, to_array(textured.vertices[None]), None, settings)
        _empty_except_at(mesh, frame, len(meshes), fps)
        file, content = encode_texture(name, textured.texture, settings)
        for attribute in add_material(stage, mesh, name, settings, open_pbr):
            attribute.Set(file_reference(file))
        pictures[file] = content
    return pictures


def _add_mesh(
    stage: Usd.Stage,
    name: str,
    textured: TexturedMesh,
    states: Float[np.ndarray, "t v 3"],
    fps: float | None,
    settings: GltfSettings,
) -> tuple[UsdGeom.Mesh, Int[np.ndarray, " p"]]:
    """Define a mesh with a pose per frame, or with a single pose that is not animated.

    Args:
        stage: stage to extend.
        name: name of the prim.
        textured: triangles, texture coordinates and smoothing groups.
        states: vertices in every pose; those that coincide in all poses and share a normal become one point.
        fps: frames per second; None to write the first pose only.
        settings: moving_normals.

    Returns:
        The mesh, and the vertex of every point.
    """
    corners = textured.faces.cpu().numpy()
    groups = mesh_normal_groups(textured, states)
    first, point_of = weld(states, groups)
    points = states[: None if fps is not None else 1, first]
    faces = point_of[corners]
    normals_of = SmoothNormals(groups[first], faces)
    mesh = UsdGeom.Mesh.Define(stage, f"/asset/mesh/{name}")
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(integers(np.full(len(faces), 3)))
    mesh.CreateFaceVertexIndicesAttr(integers(faces))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    poses = points if settings.moving_normals else points[:1]
    for attribute, values in (
        (mesh.CreatePointsAttr(), [vectors(pose) for pose in points]),
        (mesh.CreateExtentAttr(), [bounds(pose, pose) for pose in points]),
        (mesh.CreateNormalsAttr(), [vectors(normals_of(pose)) for pose in poses]),
    ):
        attribute.Set(values[0])
        if fps is not None and len(values) > 1:
            animate(attribute, values, fps)
    kind, per_corner = Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, per_corner)
    u, v = to_array(textured.uvs).T
    st.Set(Vt.Vec2fArray.FromNumpy(np.stack((u, 1 - v), axis=1)))  # in USD, v points up
    st.SetIndices(integers(corners))
    return mesh, first


def _empty_except_at(mesh: UsdGeom.Mesh, frame: int, frames: int, fps: float) -> None:
    """Remove a mesh's points and triangles at all frames but its own."""
    keys = {0: False, frame: True, frame + 1: False}
    if frame == 0:
        keys[frames] = True
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    attributes = (mesh.GetPointsAttr(), mesh.GetNormalsAttr(), mesh.GetFaceVertexCountsAttr())
    for attribute in (*attributes, mesh.GetFaceVertexIndicesAttr(), st.GetIndicesAttr()):
        value = attribute.Get()
        attribute.Set(value if frame == 0 else type(value)())
        for key, present in sorted(keys.items()):
            attribute.Set(value if present else type(value)(), time_code(key, fps))


def _identifiers(names: Sequence[str]) -> list[str]:
    """Return a unique valid prim name for each text."""
    used: set[str] = set()
    identifiers = []
    for name in names:
        plain = re.sub("_+", "_", Tf.MakeValidIdentifier(name)).rstrip("_") or "asset"
        candidates = itertools.chain([plain], (f"{plain}_{number}" for number in itertools.count(2)))
        identifiers.append(next(candidate for candidate in candidates if candidate not in used))
        used.add(identifiers[-1])
    return identifiers
