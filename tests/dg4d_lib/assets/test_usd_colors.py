"""Materials of USD files of other programs, on a square with a color in every quarter."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_models import png
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from dg4d_lib.assets.formats.model_pictures import decode_picture
from dg4d_lib.assets.formats.usd_model import check_usdz, read_usd
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, Wrap

RED, BLUE, GREEN, YELLOW = (1, 0, 0), (0, 0, 1), (0, 1, 0), (1, 1, 0)
QUARTERS = np.zeros((16, 16, 4), np.uint8)
QUARTERS[:8, :8], QUARTERS[:8, 8:] = (255, 0, 0, 255), (0, 0, 255, 255)
QUARTERS[8:, :8], QUARTERS[8:, 8:] = (0, 255, 0, 255), (255, 255, 0, 0)
SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
TYPES = Sdf.ValueTypeNames


class Painted:
    """A textured square under construction."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "paint.png").write_bytes(png(QUARTERS))
        self.stage = Usd.Stage.CreateNew(str(folder / "a.usda"))
        self.mesh = UsdGeom.Mesh.Define(self.stage, "/square")
        self.mesh.CreatePointsAttr([(x, y, 0) for x, y in SQUARE])
        self.mesh.CreateFaceVertexCountsAttr([4])
        self.mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        self.material = UsdShade.Material.Define(self.stage, "/paint")
        self.surface, self.texture = self.shader("UsdPreviewSurface"), self.shader("UsdUVTexture")
        self.texture.CreateInput("file", TYPES.Asset).Set("paint.png")
        self.reader = self.shader("UsdPrimvarReader_float2")
        self.texture.CreateInput("st", TYPES.Float2).ConnectToSource(self.reader.ConnectableAPI(), "result")
        color = self.surface.CreateInput("diffuseColor", TYPES.Color3f)
        color.ConnectToSource(self.texture.ConnectableAPI(), "rgb")
        self.material.CreateSurfaceOutput().ConnectToSource(self.surface.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(self.mesh.GetPrim()).Bind(self.material)

    def shader(self, kind: str, path: str = "") -> UsdShade.Shader:
        found = UsdShade.Shader.Define(self.stage, f"/paint/{path or kind}")
        found.CreateIdAttr(kind)
        return found

    def coordinates(self, name: str, values: list[tuple[float, float]]) -> None:
        primvars = UsdGeom.PrimvarsAPI(self.mesh)
        primvars.CreatePrimvar(name, TYPES.TexCoord2fArray, "vertex").Set([Gf.Vec2f(*value) for value in values])
        self.reader.CreateInput("varname", TYPES.String).Set(name)

    def transform(self, **values: Any) -> None:
        transform = self.shader("UsdTransform2d")
        for name, value in values.items():
            transform.CreateInput(name, TYPES.Float if name == "rotation" else TYPES.Float2).Set(value)
        transform.CreateInput("in", TYPES.Float2).ConnectToSource(self.reader.ConnectableAPI(), "result")
        self.texture.GetInput("st").ConnectToSource(transform.ConnectableAPI(), "result")

    def read(self) -> Model:
        self.stage.Save()
        UsdUtils.CreateNewUsdzPackage(str(self.folder / "a.usda"), str(self.folder / "a.usdz"))
        check_usdz(self.folder / "a.usdz")
        return read_usd(self.folder / "a.usdz", decode_picture, 100)


@pytest.fixture
def painted(tmp_path: Path) -> Painted:
    return Painted(tmp_path)


def quarters(model: Model) -> list[tuple[float, ...]]:
    """Return the colors of the quarters: lower left and right, upper left and right."""
    (part,) = model.parts
    found = []
    for x, y in ((0.25, 0.2), (0.8, 0.25), (0.2, 0.8), (0.75, 0.8)):
        for number, corners in enumerate(part.vertices[part.faces]):
            weights = np.linalg.solve(np.stack([corners[:, 0], corners[:, 1], np.ones(3)]).astype(float), (x, y, 1.0))
            if (weights >= 0).all():
                found.append(tuple(part.sample(np.array([number]), weights[None])[0][0].round(4).tolist()))
                break
    return found


def test_texture_coordinates_are_those_that_the_texture_reads(painted: Painted) -> None:
    painted.coordinates("st", [(0.9, 0.1)] * 4)  # of a light map, say
    painted.coordinates("st1", SQUARE)
    assert quarters(painted.read()) == [GREEN, YELLOW, RED, BLUE]


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        ({"translation": (0.5, 0)}, [YELLOW, GREEN, BLUE, RED]),
        ({"scale": (0.5, 1)}, [GREEN, GREEN, RED, RED]),
        ({"rotation": 90.0}, [YELLOW, BLUE, GREEN, RED]),  # u is minus v, and v is u
        ({"scale": (0.5, 0.5), "rotation": -90.0, "translation": (0, 1)}, [RED, RED, RED, RED]),
    ],
    ids=["translation", "scale", "rotation", "in this order"],
)
def test_texture_coordinates_are_transformed(
    transform: dict[str, Any], expected: list[tuple[int, ...]], painted: Painted
) -> None:
    painted.coordinates("st", SQUARE)
    painted.transform(**transform)
    assert quarters(painted.read()) == expected


@pytest.mark.parametrize(
    ("name", "mode", "first"),
    [
        ("repeat", Wrap.REPEAT, GREEN),
        ("mirror", Wrap.MIRROR, YELLOW),
        ("clamp", Wrap.CLAMP, YELLOW),
        ("", Wrap.REPEAT, GREEN),
    ],
)
def test_wrap_modes_are_read(name: str, mode: Wrap, first: tuple[int, ...], painted: Painted) -> None:
    painted.coordinates("st", [(u + 1, v) for u, v in SQUARE])
    if name:
        painted.texture.CreateInput("wrapS", TYPES.Token).Set(name)
    model = painted.read()
    assert quarters(model)[0] == first and model.parts[0].wrap == (mode, Wrap.REPEAT)


@pytest.mark.parametrize("output", ["a", "r"])
def test_opacity_of_a_texture_cuts_holes(output: str, painted: Painted) -> None:
    painted.coordinates("st", SQUARE)
    mask = painted.shader("UsdUVTexture", "mask")
    mask.CreateInput("file", TYPES.Asset).Set("paint.png")
    for source in (painted.texture, mask):
        opacity = painted.surface.CreateInput("opacity", TYPES.Float)
        opacity.ConnectToSource(source.ConnectableAPI(), output)
    (part,) = painted.read().parts
    middles = np.array([[0.6, 0.2, 0.2], [0.1, 0.8, 0.1]])  # lower left, lower right
    _, alpha = part.sample(np.array([0, 0]), middles)
    assert part.masked and alpha.tolist() == ([255, 0] if output == "a" else [0, 255])


@pytest.mark.parametrize(("level", "threshold", "is_shown"), [(0.0, 0.0, False), (0.4, 0.5, False), (0.4, 0.0, True)])
def test_materials_that_are_transparent_everywhere_are_left_out(
    level: float, threshold: float, is_shown: bool, painted: Painted
) -> None:
    painted.coordinates("st", SQUARE)
    painted.surface.CreateInput("opacity", TYPES.Float).Set(level)
    painted.surface.CreateInput("opacityThreshold", TYPES.Float).Set(threshold)
    if is_shown:
        assert not painted.read().parts[0].masked
    else:
        with pytest.raises(BadInput, match="no triangles"):
            painted.read()


def test_spheres_and_other_objects_without_a_mesh_are_named(painted: Painted) -> None:
    painted.coordinates("st", SQUARE)
    UsdGeom.Sphere.Define(painted.stage, "/ball")
    UsdGeom.Cube.Define(painted.stage, "/die")
    UsdGeom.Sphere.Define(painted.stage, "/unseen").MakeInvisible()
    (note,) = painted.read().notes
    assert "Sphere 'ball', Cube 'die'" in note and "unseen" not in note


def test_a_material_of_another_kind_is_named(painted: Painted) -> None:
    painted.material.GetSurfaceOutput().GetAttr().ClearConnections()
    other = painted.shader("ND_open_pbr_surface_surfaceshader")
    other.CreateInput("base_color", TYPES.Color3f).Set(Gf.Vec3f(1, 0, 0))
    painted.material.CreateSurfaceOutput("mtlx").ConnectToSource(other.ConnectableAPI(), "out")
    (note,) = painted.read().notes
    assert "material 'paint' is gray: only base colors of a UsdPreviewSurface are read" in note


def test_a_material_that_shows_the_colors_of_the_mesh_needs_no_note(painted: Painted) -> None:
    color = painted.shader("UsdPrimvarReader_float3")
    color.CreateInput("varname", TYPES.String).Set("displayColor")
    painted.surface.GetInput("diffuseColor").ConnectToSource(color.ConnectableAPI(), "result")
    painted.mesh.CreateDisplayColorAttr([Gf.Vec3f(0, 1, 0)])
    model = painted.read()
    assert quarters(model) == [GREEN] * 4 and model.notes == ()


@pytest.mark.parametrize(
    ("shader", "name", "kind", "value"),
    [
        ("UsdPreviewSurface", "opacity", TYPES.Token, "x"),
        ("UsdTransform2d", "scale", TYPES.Float, 2.0),
        ("UsdTransform2d", "rotation", TYPES.Float, float("inf")),
        ("UsdUVTexture", "scale", TYPES.Float, 2.0),
    ],
)
def test_values_of_another_type_get_a_sentence(
    shader: str, name: str, kind: Sdf.ValueTypeName, value: Any, painted: Painted
) -> None:
    painted.coordinates("st", SQUARE)
    painted.transform()
    painted.shader(shader).CreateInput(name, kind).Set(value)
    with pytest.raises(BadInput, match="the mesh 'square' of the USD file or its material cannot be read"):
        painted.read()


def test_concave_faces_keep_their_notches(painted: Painted) -> None:
    painted.mesh.GetPointsAttr().Set([(0, 0, 0), (1, 0, 0), (0.2, 0.2, 0), (0, 1, 0)])
    painted.mesh.GetFaceVertexIndicesAttr().Set([3, 0, 1, 2])  # a fan from the first corner would fill the notch
    (part,) = painted.read().parts
    a, b, c = part.vertices[part.faces].swapaxes(0, 1)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(0.2)


def test_meshes_far_from_the_origin_keep_their_shape(painted: Painted) -> None:
    painted.coordinates("st", SQUARE)
    painted.mesh.AddTranslateOp().Set(Gf.Vec3d(450123.3, 5412345.7, 0))
    model = painted.read()
    np.testing.assert_allclose(np.ptp(model.vertices, 0), (1, 1, 0), atol=1e-6)
    assert np.abs(model.vertices).max() < 1 and any("far from the origin" in note for note in model.notes)
