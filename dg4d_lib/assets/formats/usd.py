"""Animated meshes and splats as USDZ, and scenes of several assets.

Frame i is at time code i, and the stage has as many time codes per second as the asset has frames. Animations loop as
in the GLB: one key after the last frame repeats the first; default values are those of the first frame. A package
contains one layer with the prim `/asset`, and the textures:

    /asset                      variant set "representation": "mesh" (default) or "splats"
    /asset/mesh/subject         the tracked mesh; or /asset/mesh/frame_000, ... for meshes per frame
    /asset/mesh/materials/...   UsdPreviewSurface materials: the baked color of a rough dielectric
    /asset/splats               only in the variant "splats", which deactivates /asset/mesh

So no reader draws both on top of each other, and readers without variants or splats show the mesh. A mesh per frame
has no points at other times, because Blender ignores animated visibility. Readers that ignore animated textures, such
as Blender, show the texture of the first frame.

Splats use the schema `ParticleField3DGaussianSplat` of OpenUSD's UsdVol: linear scales and opacities, unit quaternions,
and spherical harmonics of sRGB colors, as declared by the color space. Animated values are float32, or half floats in
the schema's separate attributes, which not every reader supports.
"""

import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdVol, Vt
from torch import Tensor

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.materials import encode_image, to_uint8
from dg4d_lib.assets.formats.normals import SmoothNormals
from dg4d_lib.assets.formats.usdz import UsdzPackage, write_usdz_package
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh

DEFAULTS = GltfSettings()
ABOUT = "dg4d"  # key of the layer's custom data with the asset's JSON
EXTENT_SIGMAS = 3.0  # standard deviations of a Gaussian inside its bounds
MIN_HALF = 2.0**-14  # smallest normal half float; smaller scales would lose precision or become 0


def write_usdz(
    path: Path,
    surface: Asset4D | Sequence[TexturedMesh],
    fps: float,
    states: Gaussians | None = None,
    about: Mapping[str, Any] | None = None,
    settings: GltfSettings = DEFAULTS,
) -> None:
    """Write a tracked mesh or a mesh per frame, optionally with splats, as USDZ; equal input gives equal bytes.

    Args:
        path: output file, `.usdz`.
        surface: the animated mesh; the frame rate of an `Asset4D` is ignored.
        fps: frames per second.
        states: one state of the cloud per frame.
        about: JSON about the asset, stored as text in the layer's custom data; `name` becomes the display name.
        settings: image (jpeg replaces webp, which USDZ does not support), quality, quantized (for splats),
            moving_normals, roughness and metallic.

    Raises:
        BadInput: no frames, no triangles, different numbers of states and frames, an fps that is not positive, or
            numbers that are not finite.
        OSError: the file could not be written.
    """
    about = dict(about or {})
    meshes = [surface.mesh] if isinstance(surface, Asset4D) else list(surface)
    frames = len(surface.offsets) if isinstance(surface, Asset4D) else len(meshes)
    _check(surface, meshes, frames, fps, states)
    stage = _new_stage("/asset", "component", str(about.get("name", "asset")), fps, frames)
    if about:
        stage.GetRootLayer().customLayerData = {ABOUT: json.dumps(about, ensure_ascii=False)}
    UsdGeom.Xform.Define(stage, "/asset/mesh")
    UsdGeom.Scope.Define(stage, "/asset/mesh/materials")
    if isinstance(surface, Asset4D):
        pictures = _add_tracked(stage, surface, settings)
    else:
        pictures = _add_frames(stage, meshes, settings)
    if states is not None:
        _add_splats(stage, states, settings.quantized)
    write_usdz_package(path, stage, "asset.usdc", pictures)


@dataclass(frozen=True)
class UsdPlacement:
    """Placement of an asset in space and time.

    Attributes:
        name: display name, any text.
        file: output of `write_usdz`.
        transform: asset to scene, acts on column vectors.
        start_s: start of the animation, seconds; the asset stands still before.
        speed: playback speed relative to the recording, above 0.
    """

    name: str
    file: Path
    transform: Float[Tensor, "4 4"]
    start_s: float = 0.0
    speed: float = 1.0


def compose_usdz(path: Path, placements: Sequence[UsdPlacement]) -> None:
    """Write a scene of several assets as USDZ; every file is stored once, however often it is placed.

    The scene has the frame rate of its fastest asset and ends with the last one; finished assets stand still.

    Raises:
        BadInput: no placements, a file that is not a USDZ with a default prim, or an invalid time, speed or transform.
        OSError: the file could not be written.
    """
    if not placements:
        raise BadInput("a scene needs at least one asset; given none")
    for placement in placements:
        _check_placement(placement)
    packages = {placement.file: UsdzPackage(placement.file) for placement in placements}
    fps = max(package.fps for package in packages.values())
    end_s = max(p.start_s + packages[p.file].duration_s / p.speed for p in placements)
    stage = _new_stage("/scene", "assembly", "scene", fps, end_s * fps)
    names = _identifiers([placement.name for placement in placements])
    named = list(zip(placements, names, strict=True))
    folders = {placement.file: name for placement, name in reversed(named)}  # the first name of every file
    for placement, name in named:
        xform = UsdGeom.Xform.Define(stage, f"/scene/{name}")
        xform.AddTransformOp().Set(Gf.Matrix4d(placement.transform.T.tolist()))  # USD transforms row vectors
        xform.GetPrim().SetDisplayName(placement.name)
        layer = f"./{folders[placement.file]}/{packages[placement.file].layer}"
        offset = Sdf.LayerOffset(placement.start_s * fps, 1 / placement.speed)
        xform.GetPrim().GetPayloads().AddPayload(layer, Sdf.Path(), offset)
    files = {
        f"{folders[file]}/{name}": content
        for file, package in packages.items()
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


def _new_stage(root: str, kind: str, name: str, fps: float, end: float) -> Usd.Stage:
    """Create a stage with a default prim."""
    stage = Usd.Stage.CreateInMemory(load=Usd.Stage.LoadNone)  # payloads exist in the package only
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(end)
    prim = UsdGeom.Xform.Define(stage, root).GetPrim()
    prim.SetDisplayName(name)
    model = Usd.ModelAPI(prim)
    model.SetKind(kind)
    model.SetAssetName(name)
    stage.SetDefaultPrim(prim)
    return stage


def _add_tracked(stage: Usd.Stage, asset: Asset4D, settings: GltfSettings) -> dict[str, bytes]:
    """Define a tracked mesh; return its images by name in the package."""
    _, texture = _add_mesh(stage, "subject", asset.mesh, asset.mesh.vertices + asset.offsets, settings)
    if asset.textures is None:
        pictures = [_picture("subject", asset.mesh.texture, settings)]
    else:
        pictures = [_picture(f"subject_{i:03d}", pixels, settings) for i, pixels in enumerate(asset.textures)]
        _animate(texture, [_reference(name) for name, _ in pictures])
    texture.Set(_reference(pictures[0][0]))
    return dict(pictures)


def _add_frames(stage: Usd.Stage, meshes: Sequence[TexturedMesh], settings: GltfSettings) -> dict[str, bytes]:
    """Define a mesh per frame, each present at its frame only; return their images by name in the package."""
    pictures = {}
    for frame, textured in enumerate(meshes):
        name = f"frame_{frame:03d}"
        mesh, texture = _add_mesh(stage, name, textured, textured.vertices[None], settings)
        _empty_except_at(mesh, frame, len(meshes))
        file, content = _picture(name, textured.texture, settings)
        texture.Set(_reference(file))
        pictures[file] = content
    return pictures


def _add_mesh(
    stage: Usd.Stage, name: str, textured: TexturedMesh, states: Float[Tensor, "t v 3"], settings: GltfSettings
) -> tuple[UsdGeom.Mesh, Usd.Attribute]:
    """Define a mesh with a material; return it and the attribute of its texture file."""
    corners = textured.faces.cpu().numpy()
    points, point_of = _weld(_array(states))
    faces = point_of[corners]
    normals_of = SmoothNormals(points[0], faces)
    mesh = UsdGeom.Mesh.Define(stage, f"/asset/mesh/{name}")
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(_integers(np.full(len(faces), 3)))
    mesh.CreateFaceVertexIndicesAttr(_integers(faces))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    _animate(mesh.CreatePointsAttr(), [_vectors(pose) for pose in points])
    _animate(mesh.CreateExtentAttr(), [_bounds(pose, pose) for pose in points])
    poses = points if settings.moving_normals else points[:1]
    _animate(mesh.CreateNormalsAttr(), [_vectors(normals_of(pose)) for pose in poses])
    kind, per_corner = Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, per_corner)
    u, v = _array(textured.uvs).T
    st.Set(Vt.Vec2fArray.FromNumpy(np.stack((u, 1 - v), axis=1)))  # in USD, v points up
    st.SetIndices(_integers(corners))
    return mesh, _add_material(stage, mesh, name, settings)


def _weld(states: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Merge vertices that coincide in all states; return the points "t p 3" and the point of every vertex."""
    paths = np.ascontiguousarray(states.swapaxes(0, 1).reshape(states.shape[1], -1)) + 0.0  # turns -0 into 0
    keys = paths.view(f"V{paths.itemsize * paths.shape[1]}")[:, 0]
    _, first, group = np.unique(keys, return_index=True, return_inverse=True)
    kept, point_of_group = np.unique(first, return_inverse=True)  # sorted by vertex index
    return paths[kept].reshape(len(kept), *states.shape[::2]).swapaxes(0, 1), point_of_group[group]


def _empty_except_at(mesh: UsdGeom.Mesh, frame: int, frames: int) -> None:
    """Remove a mesh's points and triangles at all frames but its own."""
    keys = {0: False, frame: True, frame + 1: False}
    if frame == 0:
        keys[frames] = True
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    attributes = (mesh.GetPointsAttr(), mesh.GetNormalsAttr(), mesh.GetFaceVertexCountsAttr())
    for attribute in (*attributes, mesh.GetFaceVertexIndicesAttr(), st.GetIndicesAttr()):
        value = attribute.Get(0)
        attribute.Clear()
        attribute.Set(value if frame == 0 else type(value)())
        for time, present in sorted(keys.items()):
            attribute.Set(value if present else type(value)(), time)


def _add_material(stage: Usd.Stage, mesh: UsdGeom.Mesh, name: str, settings: GltfSettings) -> Usd.Attribute:
    """Bind a UsdPreviewSurface material to a mesh; return the attribute of its texture file."""
    path = f"/asset/mesh/materials/{name}"
    material = UsdShade.Material.Define(stage, path)
    surface = _add_shader(stage, f"{path}/surface", "UsdPreviewSurface")
    color = _add_shader(stage, f"{path}/color", "UsdUVTexture")
    coordinates = _add_shader(stage, f"{path}/coordinates", "UsdPrimvarReader_float2")
    kinds = Sdf.ValueTypeNames
    coordinates.CreateInput("varname", kinds.String).Set("st")
    coordinates.CreateOutput("result", kinds.Float2)
    color.CreateInput("st", kinds.Float2).ConnectToSource(coordinates.ConnectableAPI(), "result")
    color.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    for wrap in ("wrapS", "wrapT"):
        color.CreateInput(wrap, kinds.Token).Set("clamp")
    color.CreateOutput("rgb", kinds.Float3)
    surface.CreateInput("diffuseColor", kinds.Color3f).ConnectToSource(color.ConnectableAPI(), "rgb")
    surface.CreateInput("roughness", kinds.Float).Set(settings.roughness)
    surface.CreateInput("metallic", kinds.Float).Set(settings.metallic)
    surface.CreateOutput("surface", kinds.Token)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return color.CreateInput("file", kinds.Asset).GetAttr()


def _add_shader(stage: Usd.Stage, path: str, kind: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(kind)
    return shader


def _add_splats(stage: Usd.Stage, states: Gaussians, half: bool) -> None:
    """Add the variants "mesh" (default) and "splats"."""
    choice = stage.GetDefaultPrim().GetVariantSets().AddVariantSet("representation")
    for name in ("mesh", "splats"):
        choice.AddVariant(name)
    choice.SetVariantSelection("splats")
    with choice.GetVariantEditContext():
        stage.OverridePrim("/asset/mesh").SetActive(False)
        _define_splats(stage, states, half)
    choice.SetVariantSelection("mesh")


def _define_splats(stage: Usd.Stage, states: Gaussians, half: bool) -> None:
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/asset/splats")
    means, scales, harmonics = _array(states.means), _array(states.scales), _array(states.harmonics)
    quats = _array(torch.nn.functional.normalize(states.quats, dim=-1))
    reach = EXTENT_SIGMAS * np.sqrt(_array(states.covariances.diagonal(dim1=-2, dim2=-1)))
    _animate(splats.CreateExtentAttr(), [_bounds(m - r, m + r) for m, r in zip(means, reach, strict=True)])
    if half:
        means, quats, scales = (values.astype("<f2") for values in (means, quats, scales.clip(MIN_HALF)))
        create = splats.CreatePositionshAttr, splats.CreateOrientationshAttr, splats.CreateScaleshAttr
    else:
        create = splats.CreatePositionsAttr, splats.CreateOrientationsAttr, splats.CreateScalesAttr
    _animate(create[0](), [_vectors(mean) for mean in means])
    _animate(create[1](), [_quaternions(quat) for quat in quats])
    _animate(create[2](), [_vectors(scale) for scale in scales])
    splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(_array(states.opacities)))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(round(harmonics.shape[1] ** 0.5) - 1)
    colors = splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(_vectors(harmonics.reshape(-1, 3)))
    colors.SetMetadata("interpolation", UsdGeom.Tokens.vertex)  # not required by the schema, but by Omniverse
    colors.SetMetadata("elementSize", harmonics.shape[1])
    splats.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
    splats.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)
    Usd.ColorSpaceAPI.Apply(splats.GetPrim()).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)


def _animate(attribute: Usd.Attribute, values: Sequence[Any]) -> None:
    """Set a value per frame, the first value again one frame after the last, and as default value."""
    for time, value in enumerate((*values, values[0])):
        attribute.Set(value, time)
    attribute.Set(values[0])


def _array(values: Tensor) -> NDArray[Any]:
    return values.detach().cpu().numpy().astype("<f4")


def _vectors(rows: NDArray[Any]) -> Vt.Vec3fArray | Vt.Vec3hArray:
    return (Vt.Vec3hArray if rows.dtype == np.float16 else Vt.Vec3fArray).FromNumpy(rows)


def _quaternions(wxyz: NDArray[Any]) -> Vt.QuatfArray | Vt.QuathArray:
    kind = Vt.QuathArray if wxyz.dtype == np.float16 else Vt.QuatfArray
    return kind.FromNumpy(np.roll(wxyz, -1, axis=-1))  # USD's memory layout is xyzw


def _integers(values: NDArray[Any]) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(values.ravel().astype("<i4"))


def _bounds(low: NDArray[Any], high: NDArray[Any]) -> Vt.Vec3fArray:
    return _vectors(np.stack((low.min(0), high.max(0))))


def _reference(file: str) -> Sdf.AssetPath:
    """Return the asset path of a file beside the layer."""
    return Sdf.AssetPath(f"./{file}")


def _picture(name: str, pixels: Float[Tensor, "h w 3"], settings: GltfSettings) -> tuple[str, bytes]:
    """Encode an image; return its name in the package and its content.

    The name contains a digest, because Blender treats files of equal names in different assets as one image.
    """
    kind, suffix = ("png", "png") if settings.image == "png" else ("jpeg", "jpg")
    content = encode_image(to_uint8(pixels), kind, settings.quality)
    return f"textures/{name}_{sha256(content).hexdigest()[:8]}.{suffix}", content


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
