"""USD materials: the baked color of a rough dielectric, as UsdPreviewSurface and as MaterialX OpenPBR.

The shaders of UsdPreviewSurface are `surface`, `color` and `coordinates` below the material; MaterialX has shaders of
the same names below the node graph `open_pbr`. Both read one texture. Files for Quick Look must not contain MaterialX:
the ARKit rules of OpenUSD's checker allow the shaders of UsdPreviewSurface only.
"""

from hashlib import sha256

from jaxtyping import Float
from pxr import Sdf, Usd, UsdGeom, UsdShade
from torch import Tensor

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.formats.materials import encode_image, to_uint8

MATERIALX = "mtlx"  # render context of MaterialX outputs
MATERIALX_VERSION = "1.39"  # first version with open_pbr_surface
SRGB_TEXTURE = "srgb_texture"  # MaterialX's name of the color space


def add_material(
    stage: Usd.Stage, mesh: UsdGeom.Mesh, name: str, settings: GltfSettings, open_pbr: bool
) -> list[Usd.Attribute]:
    """Bind a material to a mesh; return the attributes that name its texture file.

    Args:
        stage: stage to extend.
        mesh: mesh that gets the material.
        name: name of the material in /asset/mesh/materials.
        settings: roughness and metallic.
        open_pbr: add a MaterialX network.
    """
    path = f"/asset/mesh/materials/{name}"
    material = UsdShade.Material.Define(stage, path)
    files = [_add_preview_surface(stage, material, path, settings)]
    if open_pbr:
        files.append(_add_open_pbr(stage, material, f"{path}/open_pbr", settings))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    return files


def encode_texture(name: str, pixels: Float[Tensor, "h w 3"], settings: GltfSettings) -> tuple[str, bytes]:
    """Encode an image; return its name in the package and its content.

    The name contains a digest, because Blender treats files of equal names in different assets as one image.
    """
    kind, suffix = ("png", "png") if settings.image == "png" else ("jpeg", "jpg")
    content = encode_image(to_uint8(pixels), kind, settings.quality)
    return f"textures/{name}_{sha256(content).hexdigest()[:8]}.{suffix}", content


def _add_preview_surface(
    stage: Usd.Stage, material: UsdShade.Material, path: str, settings: GltfSettings
) -> Usd.Attribute:
    """Add the network of UsdPreviewSurface; return the attribute of its texture file."""
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
    return color.CreateInput("file", kinds.Asset).GetAttr()


def _add_open_pbr(stage: Usd.Stage, material: UsdShade.Material, path: str, settings: GltfSettings) -> Usd.Attribute:
    """Add the MaterialX network; return the attribute of its texture file."""
    graph = UsdShade.NodeGraph.Define(stage, path)
    surface = _add_shader(stage, f"{path}/surface", "ND_open_pbr_surface_surfaceshader")
    color = _add_shader(stage, f"{path}/color", "ND_image_color3")
    coordinates = _add_shader(stage, f"{path}/coordinates", "ND_geompropvalue_vector2")
    kinds = Sdf.ValueTypeNames
    coordinates.CreateInput("geomprop", kinds.String).Set("st")
    coordinates.CreateOutput("out", kinds.Float2)
    color.CreateInput("texcoord", kinds.Float2).ConnectToSource(coordinates.ConnectableAPI(), "out")
    for mode in ("uaddressmode", "vaddressmode"):
        color.CreateInput(mode, kinds.String).Set("clamp")
    color.CreateOutput("out", kinds.Color3f)
    surface.CreateInput("base_color", kinds.Color3f).ConnectToSource(color.ConnectableAPI(), "out")
    surface.CreateInput("specular_roughness", kinds.Float).Set(settings.roughness)
    surface.CreateInput("base_metalness", kinds.Float).Set(settings.metallic)
    surface.CreateOutput("out", kinds.Token)
    graph.CreateOutput("out", kinds.Token).ConnectToSource(surface.ConnectableAPI(), "out")
    material.CreateSurfaceOutput(MATERIALX).ConnectToSource(graph.ConnectableAPI(), "out")
    config = material.GetPrim()
    config.AddAppliedSchema("MaterialXConfigAPI")  # of UsdMtlx, which the wheel lacks
    config.CreateAttribute("config:mtlx:version", kinds.String).Set(MATERIALX_VERSION)
    file = color.CreateInput("file", kinds.Asset).GetAttr()
    file.SetColorSpace(SRGB_TEXTURE)
    return file


def _add_shader(stage: Usd.Stage, path: str, kind: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(kind)
    return shader
