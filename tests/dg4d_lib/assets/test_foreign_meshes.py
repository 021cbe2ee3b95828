"""OBJ, PLY and USD of other programs, and GLBs made of them."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from foreign_models import BOX, CORNERS, RED_AND_BLUE, png
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdSkel, UsdUtils, UsdVol

from dg4d_lib.assets.formats.foreign_glb import read_foreign_glb
from dg4d_lib.assets.formats.model_glb import write_model_glb
from dg4d_lib.assets.formats.model_pictures import decode_picture
from dg4d_lib.assets.formats.obj import read_obj
from dg4d_lib.assets.formats.ply_mesh import read_ply_mesh
from dg4d_lib.assets.formats.usd_model import check_usdz, read_usd
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import ModelPart

OBJ = """mtllib a.mtl
o thing
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0.25 0
vt 0.25 1
vt 0.75 1
usemtl painted
f 1/1/1 2/1/1 -2/2/1 4/2/1
usemtl plain
f 1 2 3
"""
MTL = "newmtl painted\nmap_Kd p.png\nnewmtl plain\nKd 0 1 0\n"
FILES = {"a.mtl": MTL.encode(), "p.png": png(RED_AND_BLUE)}


def test_obj_becomes_a_part_per_material() -> None:
    painted, plain = read_obj(OBJ, FILES.get, decode_picture, 100).parts
    assert (painted.name, plain.name) == ("thing painted", "thing plain")
    assert (len(painted.faces), len(plain.faces)) == (2, 1)
    np.testing.assert_array_equal(painted.vertices[painted.faces[0]], [(0, 0, 0), (1, 0, 0), (1, 1, 0)])
    np.testing.assert_allclose(painted.sample(np.array([0]), np.full((1, 3), 1 / 3))[0], [[1, 0, 0]], atol=1e-5)
    np.testing.assert_allclose(plain.sample(np.array([0]), np.full((1, 3), 1 / 3))[0], [[0, 1, 0]], atol=1e-5)


def test_numbers_that_do_not_fit_are_refused() -> None:
    with pytest.raises(BadInput, match="not finite numbers"):
        read_obj("v 0 0 1e300\nv 1 0 0\nv 1 1 0\nf 1 2 3\n", FILES.get, decode_picture, 100)


@pytest.mark.parametrize("line", ["f 1 2 9", "f 0 1 2", "f 1 2 x", "v 1 y 2", "vt 1", "f 1 2 -9"])
def test_wrong_lines_are_named(line: str) -> None:
    with pytest.raises(BadInput, match="line 15 of the OBJ"):
        read_obj(f"{OBJ}\n{line}\nf 1 2 3", FILES.get, decode_picture, 100)


def painted(**files: bytes) -> np.ndarray:
    """Return the color of the first triangle of the OBJ, with other files beside it."""
    model = read_obj(OBJ, {"a.mtl": MTL.encode(), **files}.get, decode_picture, 100)
    return model.parts[0].sample(np.array([0]), np.full((1, 3), 1 / 3))[0]


@pytest.mark.parametrize(
    ("statement", "name"),
    [
        ("my paint.png", "my paint.png"),
        ("-s 1 1 1 -bm 2 my paint.png", "my paint.png"),
        (r"C:\Users\an artist\p.png", "p.png"),
        ("/home/an artist/p.png", "p.png"),
        (r'"sub folder\p.png"', "sub folder/p.png"),
        ("./p.png", "p.png"),
    ],
)
def test_textures_are_found_by_any_name(statement: str, name: str) -> None:
    files = {"a.mtl": MTL.replace("p.png", statement).encode(), name: png(RED_AND_BLUE)}
    np.testing.assert_allclose(painted(**files), [[1, 0, 0]], atol=1e-5)


def test_a_missing_texture_is_named() -> None:
    with pytest.raises(BadInput, match=r"texture 'p\.png' of the model is missing"):
        read_obj(OBJ, {"a.mtl": MTL.encode()}.get, decode_picture, 100)


def test_lines_may_go_on() -> None:
    broken = OBJ.replace("f 1/1/1 2/1/1 ", "f 1/1/1 \\\r\n2/1/1 \\\n")
    assert len(read_obj(broken, FILES.get, decode_picture, 100).faces) == 3


def test_what_is_no_number_does_not_color() -> None:
    text = "v 0 0 0 nan 0 0\nv 1 0 0 1 0 0\nv 1 1 0 1 0 0\nvt nan inf\nf 1/1 2/1 3/1\n"
    (part,) = read_obj(text, FILES.get, decode_picture, 100).parts
    assert part.colors is None
    write_model_glb(read_obj(text.replace("v 0 0 0 nan 0 0", "v 0 0 0"), FILES.get, decode_picture, 100))


def test_texture_coordinates_that_are_missing_are_left_out() -> None:
    (part,) = read_obj("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1/1 2/2 3/7\n", FILES.get, decode_picture, 100).parts
    assert part.uvs is None and len(part.faces) == 1


def middle(part: ModelPart) -> list[float]:
    """Return the color in the middle of the first triangle."""
    color: list[float] = part.sample(np.array([0]), np.full((1, 3), 1 / 3))[0][0].tolist()
    return color


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def test_colors_of_vertices_without_a_material_are_kept() -> None:
    text = TRIANGLE.replace("\n", " 1 0.5 0.25\n") + "f 1 2 3\n"
    (part,) = read_obj(text, FILES.get, decode_picture, 100).parts
    assert middle(part) == pytest.approx([1, 0.5, 0.25], abs=1e-5)


@pytest.mark.parametrize(
    ("given", "expected"),
    [((255, 128, 0), (1, 128 / 255, 0)), ((1.02, 0.5, 0), (1, 0.5, 0))],
    ids=["bytes", "rounded"],
)
def test_colors_of_vertices_are_bytes_or_fractions(given: tuple[float, ...], expected: tuple[float, ...]) -> None:
    text = TRIANGLE.replace("\n", " {} {} {}\n".format(*given)) + "f 1 2 3\n"
    content = write_model_glb(read_obj(text, FILES.get, decode_picture, 100))
    (part,) = read_foreign_glb(content, 100).model.parts
    assert middle(part) == pytest.approx(expected, abs=1e-5) and 0 <= part.colors.min() <= part.colors.max() <= 1


@pytest.mark.parametrize(("given", "expected"), [("255 0.5 0", (1, 0.5, 0)), ("-0.1 1.2 1", (0, 1, 1))])
def test_colors_of_materials_are_clamped_in_the_glb(given: str, expected: tuple[float, ...]) -> None:
    files = {"a.mtl": f"newmtl A\nKd {given}\n".encode()}
    model = read_obj(f"mtllib a.mtl\n{TRIANGLE}usemtl A\nf 1 2 3\n", files.get, decode_picture, 100)
    (part,) = read_foreign_glb(write_model_glb(model), 100).model.parts
    assert middle(part) == pytest.approx(expected, abs=1e-5) and 0 <= min(part.factor) <= max(part.factor) <= 1


def test_a_number_sign_in_a_name_begins_no_comment() -> None:
    files = {"set #1.mtl": b"newmtl M #1\nmap_Kd p #1.png\nnewmtl M #2\nKd 0 1 0 # green\n"}
    files["p #1.png"] = png(RED_AND_BLUE)
    text = f"# mtllib none\nmtllib set #1.mtl\n{TRIANGLE}vt 0.25 0.5 # left\n"
    text += "usemtl M #1\nf 1/1 2/1 3/1 # a face\nusemtl M #2\nf 1 2 3\n"
    red, green = read_obj(text, files.get, decode_picture, 100).parts
    assert (red.name, green.name) == ("model M #1", "model M #2")
    assert middle(red) == pytest.approx([1, 0, 0], abs=1e-5) and middle(green) == pytest.approx([0, 1, 0], abs=1e-5)


def test_a_corner_without_texture_coordinates_leaves_the_others_textured() -> None:
    model = read_obj(OBJ.replace("4/2/1", "4"), FILES.get, decode_picture, 100)
    assert middle(model.parts[0]) == pytest.approx([1, 0, 0], abs=1e-5)
    np.testing.assert_array_equal(model.parts[0].uvs[model.parts[0].faces[1, 2]], (0, 1))


@pytest.mark.parametrize("names", ["a.mtl b.mtl", "b.mtl a.mtl", "a b.mtl"])
def test_materials_are_found_in_every_file_named(names: str) -> None:
    red = b"newmtl A\nkd 1 0 0\n"
    files = {"a.mtl": red, "b.mtl": b"newmtl B\nKd 0 0 1\n"} if names != "a b.mtl" else {names: red}
    (part,) = read_obj(f"mtllib {names}\n{TRIANGLE}usemtl A\nf 1 2 3\n", files.get, decode_picture, 100).parts
    assert middle(part) == pytest.approx([1, 0, 0], abs=1e-5)


PLY = """ply
format ascii 1.0
comment TextureFile  my paint.png
element vertex 4
property float x
property float y
property float z
property float s
property float t
element face 1
property list uchar int vertex_indices
end_header
0 0 0 0.25 0
1 0 0 0.25 0
1 1 0 0.25 1
0 1 0 0.25 1
4 0 1 2 3
"""


def ply(text: str = PLY, **files: bytes) -> ModelPart:
    (part,) = read_ply_mesh(text.encode(), files.get, decode_picture, 100).parts
    return part


def test_ply_with_a_texture() -> None:
    part = ply(**{"my paint.png": png(RED_AND_BLUE)})
    assert len(part.faces) == 2  # of the quad
    np.testing.assert_allclose(part.sample(np.array([0, 1]), np.full((2, 3), 1 / 3))[0], [[1, 0, 0]] * 2, atol=1e-5)


def test_ply_without_color_is_gray() -> None:
    part = ply(PLY.replace("comment TextureFile", "comment"))
    np.testing.assert_allclose(part.sample(np.array([0]), np.full((1, 3), 1 / 3))[0], [[0.8] * 3], atol=1e-5)


@pytest.mark.parametrize("of", ["vertices", "faces"])
@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_with_colors(of: str, encoding: str) -> None:
    mesh = trimesh.Trimesh(CORNERS, BOX, process=False)
    reds = np.array([255, 0, 0, 255], np.uint8), np.array([0, 0, 255, 255], np.uint8)
    if of == "vertices":
        mesh.visual.vertex_colors = np.where(CORNERS[:, :1] < 0, *reds)
    else:
        mesh.visual.face_colors = np.where((CORNERS[BOX, 0] < 0).all(1)[:, None], *reds)
    content = mesh.export(file_type="ply", encoding=encoding)
    (part,) = read_ply_mesh(content, FILES.get, decode_picture, 100).parts
    corners = part.vertices[part.faces]
    np.testing.assert_allclose(corners, CORNERS[BOX])
    left = (corners[..., 0] < 0).all(1)
    colors, _ = part.sample(np.arange(12), np.full((12, 3), 1 / 3))
    np.testing.assert_allclose(colors[left], [[1, 0, 0]] * left.sum(), atol=1e-5)
    right = (corners[..., 0] > 0).all(1)
    np.testing.assert_allclose(colors[right], [[0, 0, 1]] * right.sum(), atol=1e-5)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (PLY, r"texture 'my paint\.png' of the model is missing"),
        (PLY.replace("element face 1", "element face 101"), r"101 faces; asset\.max_faces allows 100"),
        (PLY.replace("0 1 2 3", "0 1 2 9"), "cannot be read"),
        (PLY.replace("1 1 0 0.25", "1 nan 0 0.25").replace("comment TextureFile", "comment"), "not finite"),
        (PLY[:-20], "cannot be read"),
        (PLY.replace("property float y", "property taste y"), "cannot be read"),
        (PLY.replace("property float t", "property float t\nproperty ushort red"), "colors of 16 bits"),
    ],
    ids=["no texture", "too many", "far index", "nan", "cut", "unknown type", "wide colors"],
)
def test_broken_ply_gets_a_sentence(text: str, sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        ply(text)


def test_a_glb_of_a_model_is_that_model() -> None:
    model = read_obj(OBJ, FILES.get, decode_picture, 100)
    again = read_foreign_glb(write_model_glb(model), 100).model
    for ours, theirs in zip(again.parts, model.parts, strict=True):
        assert ours.name == theirs.name
        np.testing.assert_array_equal(ours.vertices, theirs.vertices)
        np.testing.assert_array_equal(ours.faces, theirs.faces)
    ids, middle = np.arange(3), np.full((3, 3), 1 / 3)
    np.testing.assert_allclose(again.sample(ids, middle)[0], model.sample(ids, middle)[0], atol=1e-6)


def usdz(folder: Path, up: str) -> Path:
    stage = Usd.Stage.CreateNew(str(folder / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, up)
    mesh = UsdGeom.Mesh.Define(stage, "/box")
    mesh.AddTranslateOp().Set(Gf.Vec3d(0, 0, 3))
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, corner)) for corner in CORNERS])
    mesh.CreateFaceVertexCountsAttr([3] * 12)
    mesh.CreateFaceVertexIndicesAttr(BOX.ravel().tolist())
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("displayColor", mesh.GetDisplayColorAttr().GetTypeName(), "constant").Set(
        [Gf.Vec3f(0, 0, 1)]
    )
    stage.Save()
    UsdUtils.CreateNewUsdzPackage(str(folder / "a.usda"), str(folder / "a.usdz"))
    return folder / "a.usdz"


@pytest.mark.parametrize(("up", "center"), [("Y", (0, 0, 3)), ("Z", (0, 3, 0))])
def test_usd_is_turned_upright(up: str, center: tuple[float, ...], tmp_path: Path) -> None:
    path = usdz(tmp_path, up)
    check_usdz(path)
    model = read_usd(path, decode_picture, 100)
    np.testing.assert_allclose(model.vertices.mean(0), center, atol=1e-6)
    assert len(model.faces) == 12 and model.parts[0].name == "box"
    np.testing.assert_allclose(model.sample(np.array([0]), np.full((1, 3), 1 / 3))[0], [[0, 0, 1]], atol=1e-5)


def packed(folder: Path, stage: Usd.Stage) -> Path:
    stage.Save()
    path = folder / "b.usdz"
    UsdUtils.CreateNewUsdzPackage(stage.GetRootLayer().realPath, str(path))
    return path


def box_of(stage: Usd.Stage, path: str) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, corner)) for corner in CORNERS])
    mesh.CreateFaceVertexCountsAttr([3] * 12)
    mesh.CreateFaceVertexIndicesAttr(BOX.ravel().tolist())
    return mesh


def material_of(stage: Usd.Stage, path: str, color: tuple[float, float, float]) -> UsdShade.Material:
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*color))
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    return material


def test_usd_meshes_of_several_materials_have_a_part_for_each(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    mesh = box_of(stage, "/box")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material_of(stage, "/red", (1, 0, 0)))
    subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset("lid", [0, 1, 99])
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(material_of(stage, "/blue", (0, 0, 1)))
    lid, rest = read_usd(packed(tmp_path, stage), decode_picture, 100).parts
    assert (lid.name, len(lid.faces), lid.factor) == ("box lid", 2, (0, 0, 1))
    assert (rest.name, len(rest.faces), rest.factor) == ("box", 10, (1, 0, 0))
    np.testing.assert_array_equal(lid.vertices[lid.faces], CORNERS[BOX[:2]])


def test_usd_meshes_that_renderers_leave_out_are_not_read(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    for purpose in ("default", "render", "proxy", "guide"):
        UsdGeom.Imageable(UsdGeom.Xform.Define(stage, f"/{purpose}")).CreatePurposeAttr(purpose)
        box_of(stage, f"/{purpose}/{purpose}_box")
    box_of(stage, "/hidden").MakeInvisible()
    model = read_usd(packed(tmp_path, stage), decode_picture, 100)
    assert [part.name for part in model.parts] == ["default_box", "render_box"]


@pytest.mark.parametrize("visible", [True, False])
def test_usd_point_instancers_are_refused_where_they_are_rendered(visible: bool, tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    box_of(stage, "/box")
    instancer = UsdGeom.PointInstancer.Define(stage, "/forest")
    box_of(stage, "/forest/tree")
    if visible:
        with pytest.raises(BadInput, match=r"the PointInstancer 'forest'\); export it without instancing"):
            read_usd(packed(tmp_path, stage), decode_picture, 100)
    else:
        instancer.MakeInvisible()
        assert [part.name for part in read_usd(packed(tmp_path, stage), decode_picture, 100).parts] == ["box"]


@pytest.mark.parametrize("mirror", [1.0, -1.0])
@pytest.mark.parametrize(("orientation", "volume"), [("rightHanded", 1.0), ("leftHanded", -1.0)])
def test_usd_meshes_keep_their_outside_in_a_mirror(
    orientation: str, volume: float, mirror: float, tmp_path: Path
) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    mesh = box_of(stage, "/box")
    mesh.CreateOrientationAttr(orientation)
    mesh.AddScaleOp().Set(Gf.Vec3f(mirror, 1, 1))
    model = read_usd(packed(tmp_path, stage), decode_picture, 100)
    assert trimesh.Trimesh(model.vertices, model.faces, process=False).volume == pytest.approx(volume)


def test_usd_splats_are_refused_with_the_formats_that_are_read(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdVol.ParticleField3DGaussianSplat.Define(stage, "/splats")
    with pytest.raises(
        BadInput, match=r"splats and no mesh.*splats/000\.ply of a dg4d package, or its mesh, asset\.usdz"
    ):
        read_usd(packed(tmp_path, stage), decode_picture, 100)


def test_usd_faces_of_two_corners_are_left_out(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    mesh = box_of(stage, "/box")
    mesh.GetFaceVertexCountsAttr().Set([2, *[3] * 11, 1])
    colors = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "uniform")
    colors.Set([Gf.Vec3f(1, 0, 0), Gf.Vec3f(0, 1, 0), *[Gf.Vec3f(0, 0, 1)] * 11])
    (part,) = read_usd(packed(tmp_path, stage), decode_picture, 100).parts
    np.testing.assert_array_equal(part.vertices[part.faces], CORNERS[BOX.ravel()[2:35].reshape(11, 3)])
    np.testing.assert_allclose(part.colors[part.faces][:, 0], [(0, 1, 0), *[(0, 0, 1)] * 10])


@pytest.mark.parametrize("counts", [[3] * 11 + [4], [-1, 37]])
def test_usd_faces_that_do_not_fit_are_refused(counts: list[int], tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    box_of(stage, "/box").GetFaceVertexCountsAttr().Set(counts)
    with pytest.raises(BadInput, match="do not fit its points"):
        read_usd(packed(tmp_path, stage), decode_picture, 100)


def test_usd_colors_may_be_inputs_of_the_material(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    mesh, material = box_of(stage, "/box"), material_of(stage, "/paint", (1, 0, 0))
    tint = material.CreateInput("tint", Sdf.ValueTypeNames.Color3f)
    tint.Set(Gf.Vec3f(0, 1, 0))
    UsdShade.Shader(stage.GetPrimAtPath("/paint/surface")).GetInput("diffuseColor").ConnectToSource(tint)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    (part,) = read_usd(packed(tmp_path, stage), decode_picture, 100).parts
    assert part.factor == (0, 1, 0)


def test_usd_textures_may_be_inputs_of_the_material_and_are_scaled(tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(png(RED_AND_BLUE))
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    mesh, material = box_of(stage, "/box"), material_of(stage, "/paint", (0, 1, 0))
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "constant").Set([(0.25, 0.5)])
    texture = UsdShade.Shader.Define(stage, "/paint/texture")
    texture.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(0.2, 1, 1, 1))
    file = material.CreateInput("file", Sdf.ValueTypeNames.Asset)
    file.Set(Sdf.AssetPath("p.png"))
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).ConnectToSource(file)
    color = UsdShade.Shader(stage.GetPrimAtPath("/paint/surface")).GetInput("diffuseColor")
    color.ConnectToSource(texture.ConnectableAPI(), "rgb")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    (part,) = read_usd(packed(tmp_path, stage), decode_picture, 100).parts
    red_in_srgb = 0.4845  # of 0.2 in linear light
    assert middle(part) == pytest.approx([red_in_srgb, 0, 0], abs=1e-4)


def test_usd_instances_are_read_at_every_place(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    box_of(stage, "/original/box")
    stage.GetPrimAtPath("/original").SetSpecifier(Sdf.SpecifierClass)
    for number in range(2):
        place = UsdGeom.Xform.Define(stage, f"/place_{number}")
        place.AddTranslateOp().Set(Gf.Vec3d(3 * number, 0, 0))
        place.GetPrim().GetReferences().AddInternalReference("/original")
        place.GetPrim().SetInstanceable(True)
    first, second = read_usd(packed(tmp_path, stage), decode_picture, 100).parts
    np.testing.assert_allclose(second.vertices, first.vertices + np.float32([3, 0, 0]))


def test_usd_skeletons_pose_their_meshes(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    stage.SetStartTimeCode(5)
    root = UsdSkel.Root.Define(stage, "/root")
    skeleton = UsdSkel.Skeleton.Define(stage, "/root/bones")
    skeleton.CreateJointsAttr(["bone"])
    skeleton.CreateBindTransformsAttr([Gf.Matrix4d(1)])
    skeleton.CreateRestTransformsAttr([Gf.Matrix4d(1)])
    motion = UsdSkel.Animation.Define(stage, "/root/motion")
    motion.CreateJointsAttr(["bone"])
    motion.CreateTranslationsAttr().Set([Gf.Vec3f(0, 7, 0)], 5)
    motion.CreateRotationsAttr().Set([Gf.Quatf(1)], 5)
    motion.CreateScalesAttr().Set([Gf.Vec3h(1, 1, 1)], 5)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([motion.GetPath()])
    binding = UsdSkel.BindingAPI.Apply(box_of(stage, "/root/box").GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set([0] * 8)
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0] * 8)
    stage.SetDefaultPrim(root.GetPrim())
    model = read_usd(packed(tmp_path, stage), decode_picture, 100)
    np.testing.assert_allclose(model.vertices.mean(0), (0, 7, 0), atol=1e-5)


def test_usd_that_refers_to_other_files_is_refused(tmp_path: Path) -> None:
    other = Usd.Stage.CreateNew(str(tmp_path / "other.usda"))
    box_of(other, "/box")
    other.SetDefaultPrim(other.GetPrimAtPath("/box"))
    other.Save()
    with zipfile.ZipFile(tmp_path / "a.usdz", "w") as archive:
        archive.writestr("a.usda", f'#usda 1.0\ndef "box" (references = @{tmp_path}/other.usda@) {{}}\n')
    with pytest.raises(BadInput, match="outside of its package"):
        read_usd(tmp_path / "a.usdz", decode_picture, 100)


def test_usd_textures_outside_of_the_package_are_not_read(tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(png(RED_AND_BLUE))
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    mesh, material = box_of(stage, "/box"), material_of(stage, "/paint", (1, 0, 0))
    texture = UsdShade.Shader.Define(stage, "/paint/texture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(str(tmp_path / "p.png")))
    color = UsdShade.Shader(stage.GetPrimAtPath("/paint/surface")).GetInput("diffuseColor")
    color.ConnectToSource(texture.ConnectableAPI(), "rgb")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    stage.Save()
    with zipfile.ZipFile(tmp_path / "a.usdz", "w") as archive:
        archive.write(tmp_path / "a.usda", "a.usda")
    with pytest.raises(BadInput, match=r"p\.png' of the model is missing"):
        read_usd(tmp_path / "a.usdz", decode_picture, 100)


def test_usd_with_too_many_triangles_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="more than 11 triangles"):
        read_usd(usdz(tmp_path, "Y"), decode_picture, 11)
