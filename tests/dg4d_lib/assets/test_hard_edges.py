"""Hard edges of a user's model, and surfaces that part: every file has the normals of the moved faces."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.foreign_glb import _read, read_foreign_glb
from dg4d_lib.assets.formats.foreign_motion import TANGENTS, write_moving_glb
from dg4d_lib.assets.formats.glb import write_frames_glb, write_glb
from dg4d_lib.assets.formats.gltf import INDEX_DATA, VERTEX_DATA, GlbReader, GltfDocument, read_accessor
from dg4d_lib.assets.formats.rigged import write_rigged_glb
from dg4d_lib.assets.formats.usd import write_skinned_usdz, write_usdz
from dg4d_lib.assets.placement import Placement
from dg4d_lib.mesh.extraction.simplify import simplify_mesh
from dg4d_lib.mesh.extraction.topology import group_vertices
from dg4d_lib.mesh.models.atlas import merge_parts
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.unwrap import unwrap
from dg4d_lib.mesh.tracking.rig import Rig, fit_rig

MOST = 1000  # triangles
ANGLES = (0, 20, 90, 110)  # degrees
QUARTER = Rotation.from_euler("y", 90, degrees=True).as_quat().tolist()


def flat_box_glb(pieces: int = 1, boxes: int = 1, **attributes: np.ndarray) -> bytes:
    """Return a turned and stretched box of 24 vertices with a normal per face.

    Args:
        pieces: primitives that the triangles are split into.
        boxes: number of boxes on top of each other.
        attributes: further attributes of the vertices.
    """
    box = trimesh.creation.box()
    corners, normals = box.triangles.reshape(-1, 3), np.repeat(box.face_normals, 3, 0)
    rows, index = np.unique(np.concatenate([corners, normals], 1).round(6), axis=0, return_inverse=True)
    floors = np.repeat(np.arange(boxes), len(rows))
    places, normals = (np.tile(part, (boxes, 1)).astype("<f4") for part in (rows[:, :3], rows[:, 3:]))
    places[:, 1] += floors
    faces = np.concatenate([index.reshape(-1, 3) + len(rows) * floor for floor in range(boxes)])
    document = GltfDocument({})
    given = {"POSITION": places, "NORMAL": normals, **attributes}
    accessors = {name: document.add_accessor(name, values, VERTEX_DATA) for name, values in given.items()}
    primitives = [
        {"attributes": accessors, "indices": document.add_accessor("t", part.ravel().astype("<u2"), INDEX_DATA)}
        for part in np.array_split(faces, pieces)
    ]
    mesh = document.add("meshes", name="box", primitives=primitives)
    node = document.add("nodes", name="box", mesh=mesh, rotation=QUARTER, scale=[1.0, 2.0, 3.0])
    document.tree["scene"] = document.add("scenes", nodes=[node])
    return document.to_bytes()


def turned(vertices: np.ndarray, angles: tuple[int, ...] = ANGLES) -> np.ndarray:
    """Return vertices turned about x, at every angle."""
    return np.stack([Rotation.from_euler("x", angle, degrees=True).apply(vertices) for angle in angles]).astype("f4")


def shown(content: bytes, target: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, unit normals and triangles of the first primitive of a GLB, with one morph target."""
    reader = GlbReader(content)
    primitive = reader.tree["meshes"][0]["primitives"][0]
    places, normals = (
        read_accessor(reader, primitive["attributes"][name]).astype(np.float64)
        + (0 if target is None else read_accessor(reader, primitive["targets"][target][name]))
        for name in ("POSITION", "NORMAL")
    )
    faces = read_accessor(reader, primitive["indices"], raw=True).reshape(-1, 3).astype(np.int64)
    return places, normals / np.linalg.norm(normals, axis=1, keepdims=True), faces


def worst_angle_deg(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> float:
    """Return the largest angle between the normal of a corner and that of its face."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    of_faces = np.cross(b - a, c - a)
    of_faces /= np.linalg.norm(of_faces, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.einsum("fkc,fc->fk", normals[faces], of_faces).clip(-1, 1)).max()))


def merged_box(pieces: int = 1) -> Asset4D:
    """Return a box with hard edges as one mesh, at rest and turned by 90 degrees."""
    mesh, _ = merge_parts(read_foreign_glb(flat_box_glb(pieces), MOST).model.placed(np.diag([2.0, 2, 2, 1])), 64)
    moved = torch.from_numpy(turned(mesh.vertices.numpy(), (0, 90)))
    return Asset4D(mesh, moved - mesh.vertices, 4.0)


def test_normals_of_hard_edges_turn_with_a_model():
    glb = read_foreign_glb(flat_box_glb(), MOST)
    content, _ = write_moving_glb(glb, np.eye(4), turned(glb.model.vertices), 4.0, {})
    for target in range(len(ANGLES)):
        assert worst_angle_deg(*shown(content, target)) < 1


def test_a_lid_of_a_model_turns_alone():
    """The sides of lid and box have equal normals at equal places at rest."""
    glb = read_foreign_glb(flat_box_glb(boxes=2), MOST)
    rest = glb.model.vertices
    moved = np.where(np.arange(len(rest))[:, None] < 24, rest, turned(rest))
    content, _ = write_moving_glb(glb, np.eye(4), moved, 4.0, {})
    for target in range(len(ANGLES)):
        assert worst_angle_deg(*shown(content, target)) < 1


@pytest.mark.parametrize("pieces", [1, 5])
@pytest.mark.parametrize("settings", [GltfSettings(), GltfSettings(quantized=False), GltfSettings(meshopt=True)])
def test_hard_edges_of_a_model_stay_hard_in_one_mesh(pieces: int, settings: GltfSettings):
    content = write_glb(merged_box(pieces), settings)
    for target in (None, 0):
        assert worst_angle_deg(*shown(content, target)) < 1


def rig_of(asset: Asset4D) -> Rig:
    return fit_rig(asset.mesh.vertices, asset.offsets, 0.02, 8)


def test_hard_edges_stay_hard_with_a_skeleton():
    asset = merged_box()
    assert worst_angle_deg(*shown(write_rigged_glb(asset, rig_of(asset), GltfSettings()), None)) < 1


def written(path: Path, asset: Asset4D, skinned: bool) -> Usd.Stage:
    """Write an asset as USDZ, with a skeleton or with points per frame, and open it."""
    if skinned:
        write_skinned_usdz(path, asset, rig_of(asset))
    else:
        write_usdz(path, asset, 4.0)
    return Usd.Stage.Open(str(path))


@pytest.mark.parametrize("skinned", [False, True])
def test_hard_edges_stay_hard_in_usdz(skinned: bool, tmp_path: Path):
    asset, path = merged_box(), tmp_path / "a.usdz"
    stage = written(path, asset, skinned)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh/subject"))
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get(0)).reshape(-1, 3)
    assert len(mesh.GetPointsAttr().Get(0)) == 24
    for time in (0, 6):
        points, normals = np.array(mesh.GetPointsAttr().Get(time)), np.array(mesh.GetNormalsAttr().Get(time))
        assert worst_angle_deg(points, normals, faces) < 1


def test_a_smooth_model_stays_smooth_across_its_materials():
    """Vertices of two parts at one place have equal normals."""
    ball = trimesh.creation.icosphere(2, 0.5)
    document = GltfDocument({})
    attributes = {
        name: document.add_accessor(name, rows.astype("<f4"), VERTEX_DATA)
        for name, rows in (("POSITION", ball.vertices), ("NORMAL", 2 * ball.vertices))
    }
    halves = [half.ravel().astype("<u2") for half in np.array_split(ball.faces, 2)]
    primitives = [
        {"attributes": attributes, "indices": document.add_accessor("triangles", half, INDEX_DATA)} for half in halves
    ]
    node = document.add("nodes", mesh=document.add("meshes", primitives=primitives), rotation=QUARTER)
    document.tree["scene"] = document.add("scenes", nodes=[node])
    mesh, _ = merge_parts(read_foreign_glb(document.to_bytes(), MOST).model, 64)
    places, normals, _ = shown(write_glb(Asset4D(mesh, torch.zeros(1, len(mesh.vertices), 3), 4.0)), None)
    assert (normals * places / 0.5).sum(1).min() > 0.995


def boxes() -> tuple[Asset4D, Asset4D]:
    """Return a lid that lies on a box and rises in frame 1, with the box and alone; copies at every edge."""
    height, count = np.array([0, 0.2, 0]), 36
    box = trimesh.creation.box((1, 0.2, 1)).triangles.reshape(-1, 3)
    both = torch.tensor(np.concatenate([box + height, box]), dtype=torch.float32)
    offsets = torch.zeros(2, 2 * count, 3)
    offsets[1, :count, 1] = 1
    faces, texture = torch.arange(2 * count).reshape(-1, 3), torch.full((8, 8, 3), 0.5)
    uvs = torch.rand(2 * count, 2, generator=torch.Generator().manual_seed(0))
    mesh = TexturedMesh(both, faces, uvs, texture)
    lid = TexturedMesh(both[:count], faces[: count // 3], uvs[:count], texture)
    return Asset4D(mesh, offsets, 4.0), Asset4D(lid, offsets[:, :count], 4.0)


@pytest.mark.parametrize("target", [None, 0])
def test_a_lid_has_normals_of_its_own(target: int | None):
    (_, both, _), (_, alone, _) = (shown(write_glb(asset), target) for asset in boxes())
    np.testing.assert_allclose(both[: len(alone)], alone, atol=1e-6)


def test_a_lid_has_normals_of_its_own_with_a_skeleton():
    (_, both, _), (_, alone, _) = (
        shown(write_rigged_glb(asset, rig_of(asset), GltfSettings(quantized=False)), None) for asset in boxes()
    )
    np.testing.assert_allclose(both[: len(alone)], alone, atol=1e-6)


@pytest.mark.parametrize("skinned", [False, True])
def test_a_lid_has_points_and_normals_of_its_own_in_usdz(skinned: bool, tmp_path: Path):
    found = []
    for asset in boxes():
        path = tmp_path / f"{len(found)}.usdz"
        if skinned:
            write_skinned_usdz(path, asset, rig_of(asset))
        else:
            write_usdz(path, asset, 4.0)
        stage = Usd.Stage.Open(str(path))
        mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh/subject"))
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(0))
        assert not set(corners[:36]) & set(corners[36:])
        assert len(set(corners[:36])) == 8
        found.append([np.array(mesh.GetNormalsAttr().Get(time))[corners[:36]] for time in (0, 6)])
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


def test_tangents_of_a_model_are_left_to_the_players():
    tangents = np.tile(np.float32([0, 1, 0, 1]), (24, 1))
    glb = read_foreign_glb(flat_box_glb(TANGENT=tangents), MOST)
    content, notes = write_moving_glb(glb, np.eye(4), turned(glb.model.vertices), 4.0, {})
    assert TANGENTS in notes
    (primitive,) = GlbReader(content).tree["meshes"][0]["primitives"]
    assert primitive["attributes"].keys() == {"POSITION", "NORMAL"}


def test_morph_targets_of_tangents_are_not_read():
    reader = GlbReader(flat_box_glb(TANGENT=np.tile(np.float32([0, 1, 0, 1]), (24, 1))))
    (primitive,) = reader.tree["meshes"][0]["primitives"]
    normals = primitive["attributes"]["NORMAL"]
    reader.tree["meshes"][0].update(weights=[0.5])
    primitive["targets"] = [{"NORMAL": normals, "TANGENT": normals}]
    (piece,) = _read(reader, MOST).pieces
    assert piece.morphed.keys() == {"NORMAL"}
    np.testing.assert_allclose(piece.morphed["NORMAL"], read_accessor(reader, normals), atol=1e-6)


def bending_ball() -> Asset4D:
    """Return a ball that is unwrapped as an extracted mesh is, bends, and is placed in meters."""
    ball = trimesh.creation.icosphere(3, 0.5)
    vertices, faces = ball.vertices.astype(np.float32), np.asarray(ball.faces)
    sources, corners, uvs = map(torch.from_numpy, unwrap(vertices, faces, 128))
    bent = torch.from_numpy(vertices + 0.1 * np.sin(5 * vertices[:, [1, 2, 0]] + np.arange(3)[:, None, None]))
    rest = torch.from_numpy(vertices)
    mesh = TexturedMesh(rest[sources], corners, uvs, torch.full((8, 8, 3), 0.5))
    placed = Placement(1.7, (0.1, 0.2, 0.3)).surface(Asset4D(mesh, (bent.float() - rest)[:, sources], 4.0))
    assert isinstance(placed, Asset4D) and len(sources) > len(vertices)
    return placed


def level_of_detail(asset: Asset4D) -> Asset4D:
    mesh, offsets = simplify_mesh(asset.mesh, asset.offsets, 400)
    return Asset4D(mesh, offsets, asset.fps)


@pytest.mark.parametrize(
    ("write", "targets"),
    [
        (write_glb, (None, 0, 1)),
        (lambda asset: write_glb(asset, GltfSettings(meshopt=True)), (None, 0, 1)),
        (lambda asset: write_glb(level_of_detail(asset)), (None, 0, 1)),
        (lambda asset: write_rigged_glb(asset, rig_of(asset), GltfSettings()), (None,)),
        (lambda asset: write_frames_glb([asset.mesh], 4.0), (None,)),
    ],
)
def test_an_extracted_mesh_stays_smooth_across_the_seams_of_its_texture(
    write: Callable[[Asset4D], bytes], targets: tuple[int | None, ...]
):
    content = write(bending_ball())
    _, copies = group_vertices(shown(content, None)[0])
    assert copies.max() + 1 < len(copies)
    for target in targets:
        _, normals, _ = shown(content, target)
        _, first = np.unique(copies, return_index=True)
        np.testing.assert_array_equal(normals, normals[first][copies])


@pytest.mark.parametrize("skinned", [False, True])
def test_the_seams_of_an_extracted_mesh_are_one_point_each_in_usdz(skinned: bool, tmp_path: Path):
    asset, path = bending_ball(), tmp_path / "a.usdz"
    stage = written(path, asset, skinned)
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/asset/mesh/subject")).GetPointsAttr().Get(0)
    assert len(points) == len(group_vertices(asset.mesh.vertices.numpy())[0])
