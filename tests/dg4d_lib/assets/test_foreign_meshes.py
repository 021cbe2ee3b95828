"""OBJ and USD of other programs, and GLBs made of them."""

from pathlib import Path

import numpy as np
import pytest
from foreign_models import BOX, CORNERS, RED_AND_BLUE, png
from pxr import Gf, Usd, UsdGeom, UsdUtils

from dg4d_lib.assets.formats.foreign_glb import read_foreign_glb
from dg4d_lib.assets.formats.model_glb import write_model_glb
from dg4d_lib.assets.formats.model_pictures import decode_picture
from dg4d_lib.assets.formats.obj import read_obj
from dg4d_lib.assets.formats.usd_model import check_usdz, read_usd
from dg4d_lib.errors import BadInput

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


@pytest.mark.parametrize("line", ["f 1 2 9", "f 0 1 2", "f 1 2 x", "v 1 y 2", "vt 1", "f 1 2 -9"])
def test_wrong_lines_are_named(line: str) -> None:
    with pytest.raises(BadInput, match="line 15 of the OBJ"):
        read_obj(f"{OBJ}\n{line}\nf 1 2 3", FILES.get, decode_picture, 100)


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


def test_usd_with_too_many_triangles_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="more than 11 triangles"):
        read_usd(usdz(tmp_path, "Y"), decode_picture, 11)
