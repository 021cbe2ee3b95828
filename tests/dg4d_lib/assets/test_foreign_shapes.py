"""Shapes and colors of OBJ and PLY that few programs write: concave, far from the origin, with polygons of any size."""

import io
import re
import struct
from collections.abc import Callable

import numpy as np
import pytest
from foreign_models import RED_AND_BLUE, png
from PIL import Image

from dg4d_lib.assets.formats import ply_elements
from dg4d_lib.assets.formats.model_pictures import decode_picture
from dg4d_lib.assets.formats.obj import read_obj
from dg4d_lib.assets.formats.ply_mesh import read_ply_mesh
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import Model, ModelPart

ANGLES = np.arange(48) * 2 * np.pi / 48
RINGS = np.array([(np.cos(a), y, np.sin(a)) for y in np.linspace(0, 2, 9) for a in ANGLES])
CYLINDER = RINGS + np.array([450123, 5412345, 30])
STARTS = [(48 * k + i, 48 * k + (i + 1) % 48) for k in range(8) for i in range(48)]
QUADS = [(a, b, b + 48, a + 48) for a, b in STARTS]
SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
FILES = {"paint.png": png(RED_AND_BLUE)}


def obj(text: str, **files: bytes) -> Model:
    return read_obj(text, files.get, decode_picture, 10_000)


def ply(properties: str, rows: list[tuple[float, ...]], faces: list[str], of_faces: str = "", order: str = "") -> bytes:
    """Return an ASCII PLY, or a binary one in the given byte order; lists are of bytes, all other numbers floats."""
    form = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    names = ["x", "y", "z", *properties.split()]
    lines = [f"ply\nformat {form} 1.0\ncomment TextureFile paint.png\nelement vertex {len(rows)}"]
    lines += [f"property float {name}" for name in names]
    lines += [f"element face {len(faces)}", "property list uchar uchar vertex_indices"]
    lines += [f"property {one}" for one in of_faces.split(", ") if one] + ["end_header\n"]
    header = "\n".join(lines).encode()
    if not order:
        return header + "\n".join([*(" ".join(map(str, row)) for row in rows), *faces, ""]).encode()
    return (
        header
        + b"".join(struct.pack(f"{order}{len(row)}f", *row) for row in rows)
        + b"".join(bytes(map(int, face.split())) for face in faces)
    )


def part_of(content: bytes) -> ModelPart:
    (part,) = read_ply_mesh(content, FILES.get, decode_picture, 100).parts
    return part


def colors(part: ModelPart) -> list[list[float]]:
    """Return the colors in the middle of all triangles."""
    count = len(part.faces)
    found: list[list[float]] = part.sample(np.arange(count), np.full((count, 3), 1 / 3))[0].round(3).tolist()
    return found


def cylinder_obj() -> Model:
    lines = ["v {:.6f} {:.6f} {:.6f}".format(*row) for row in CYLINDER]
    return obj("\n".join(lines + ["f " + " ".join(str(corner + 1) for corner in quad) for quad in QUADS]))


def cylinder_ply() -> Model:
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(CYLINDER)}\n"
    header += "".join(f"property double {name}\n" for name in "xyz") + f"element face {len(QUADS)}\n"
    header += "property list uchar int vertex_index\nend_header\n"
    body = CYLINDER.astype("<f8").tobytes() + b"".join(struct.pack("<B4i", 4, *quad) for quad in QUADS)
    return read_ply_mesh(header.encode() + body, FILES.get, decode_picture, 10_000)


@pytest.mark.parametrize("read", [cylinder_obj, cylinder_ply])
def test_models_far_from_the_origin_keep_their_shape(read: Callable[[], Model]) -> None:
    model = read()
    found, given = (
        values[faces] for values, faces in ((model.vertices, model.faces[::2]), (CYLINDER, np.array(QUADS)[:, :3]))
    )
    error = (found - found.mean((0, 1))) - (given - given.mean((0, 1)))
    assert np.abs(error).max() < 2e-6 and np.abs(model.vertices).max() < 2
    assert model.notes == (
        "the model is far from the origin; it was moved by minus (450123, 5.41235e+06, 30), to keep its shape in "
        "single precision",
    )


def test_models_near_the_origin_stay_where_they_are() -> None:
    model = obj("v 5 0 0\nv 6 0 0\nv 6 1 0\nf 1 2 3\n")
    assert model.vertices.tolist() == [[5, 0, 0], [6, 0, 0], [6, 1, 0]] and model.notes == ()


ELL = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0)]


def area(model: Model) -> float:
    a, b, c = model.vertices[model.faces].swapaxes(0, 1)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


@pytest.mark.parametrize("start", range(6))
def test_concave_polygons_keep_their_notches(start: int) -> None:
    corners = np.roll(np.arange(6), start)
    lines = ["v {} {} {}".format(*row) for row in ELL]
    model = obj("\n".join([*lines, "f " + " ".join(str(corner + 1) for corner in corners)]))
    assert area(model) == pytest.approx(3)
    face = " ".join(map(str, (6, *corners)))
    assert area(read_ply_mesh(ply("", ELL, [face]), FILES.get, decode_picture, 100)) == pytest.approx(3)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_polygons_of_any_size_have_the_colors_of_their_faces(order: str) -> None:
    rows = [*SQUARE, (2, 0, 0), (2, 1, 0), (1.5, 2, 0)]
    faces = ["4 0 1 2 3 255 0 0", "5 1 4 5 6 2 0 255 0", "3 0 1 2 0 0 255"]
    part = part_of(ply("", rows, faces, "uchar red, uchar green, uchar blue", order))
    assert colors(part) == [[1, 0, 0]] * 2 + [[0, 1, 0]] * 3 + [[0, 0, 1]]


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_polygons_with_colored_corners_are_split(order: str) -> None:
    rows = [(*place, 0.0, 1.0, 0.0) for place in SQUARE]
    assert colors(part_of(ply("red green blue", rows, ["4 0 1 2 3"], order=order))) == [[0, 1, 0]] * 2


def test_colors_have_the_names_of_several_programs() -> None:
    rows = [(*place, 0.0, 1.0, 0.0) for place in SQUARE]
    assert colors(part_of(ply("diffuse_red diffuse_green diffuse_blue", rows, ["3 0 1 2"]))) == [[0, 1, 0]]


def test_colors_of_floats_may_go_to_255() -> None:
    rows = [(*place, 0.0, 255.0, 0.0) for place in SQUARE]
    assert colors(part_of(ply("red green blue", rows, ["3 0 1 2"]))) == [[0, 1, 0]]


@pytest.mark.parametrize("names", ["s t", "u v", "texture_u texture_v"])
def test_polygons_with_textured_corners_are_split(names: str) -> None:
    rows = [(*place, 0.75, 0.5) for place in SQUARE]
    assert colors(part_of(ply(names, rows, ["4 0 1 2 3"]))) == [[0, 0, 1]] * 2


def test_polygons_have_the_texture_coordinates_of_their_faces() -> None:
    faces = ["4 0 1 2 3 8 .25 0 .25 0 .25 1 .25 1", "3 0 1 2 6 .75 0 .75 0 .75 1"]
    part = part_of(ply("", SQUARE, faces, "list uchar float texcoord"))
    assert colors(part) == [[1, 0, 0]] * 2 + [[0, 0, 1]]


@pytest.mark.parametrize(
    "content",
    [
        ply("", SQUARE, ["4 0 1 2"]),
        ply("", SQUARE, ["4 0 1 2"], order="<"),
        ply("", SQUARE, ["3 0 1 nan"]),
        ply("", SQUARE, ["3 0 1 x"]),
        ply("", SQUARE, ["-3 0 1 2"]),
        ply("", SQUARE, ["2 0 1"]),
        ply("", SQUARE, ["3 0 1 2"]).replace(b"ascii", b"base64"),
        ply("", SQUARE, ["3 0 1 2"]).replace(b"element vertex 4", b"element vertex -4"),
        ply("", SQUARE, ["3 0 1 2"]).replace(b"element vertex 4", b"element vertex 4000000000000"),
        ply("", SQUARE, ["3 0 1 2"]).replace(b"property float x", b"property"),
    ],
)
def test_broken_rows_get_a_sentence(content: bytes) -> None:
    with pytest.raises(BadInput, match="PLY cannot be read"):
        part_of(content)


@pytest.mark.parametrize(
    ("declared", "sentence"),
    [
        ("property float z", "vertices lack z"),
        ("property list uchar uchar vertex_indices", "faces lack vertex_indices"),
    ],
)
def test_what_a_ply_lacks_is_named(declared: str, sentence: str) -> None:
    other = declared.rpartition(" ")[0].encode() + b" taste"
    with pytest.raises(BadInput, match=sentence):
        part_of(ply("", SQUARE, ["3 0 1 2"]).replace(declared.encode(), other))


def test_a_ply_may_declare_an_element_once() -> None:
    content = ply("", SQUARE, ["3 0 1 2"]).replace(b"element face", b"element vertex 1\nproperty float x\nelement face")
    with pytest.raises(BadInput, match="declares the element 'vertex' twice"):
        part_of(content)


def test_elements_after_the_faces_are_not_read() -> None:
    content = ply("", SQUARE, ["3 0 1 2"]).replace(b"end_header", b"element strand 9\nproperty float x\nend_header")
    assert len(part_of(content).faces) == 1


def test_rows_that_are_read_one_by_one_have_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    uneven, even = (ply("", SQUARE, [*["3 0 1 2"] * 3, last]) for last in ("4 0 1 2 3", "3 0 1 2"))
    monkeypatch.setattr(ply_elements, "MOST_UNEVEN", 3)
    assert len(part_of(even).faces) == 4
    with pytest.raises(BadInput, match="'face' has 4 rows of different lengths; at most 3 are read"):
        part_of(uneven)


def test_triangles_of_polygons_count_towards_the_limit() -> None:
    with pytest.raises(BadInput, match=r"2 triangles; asset\.max_faces allows 1.*max_faces=2"):
        read_ply_mesh(ply("", SQUARE, ["4 0 1 2 3"]), FILES.get, decode_picture, 1)


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def test_materials_after_a_byte_order_mark_are_read() -> None:
    model = obj(f"mtllib a.mtl\n{TRIANGLE}usemtl A\nf 1 2 3\n", **{"a.mtl": b"\xef\xbb\xbfnewmtl A\nKd 1 0 0\n"})
    assert colors(model.parts[0]) == [[1, 0, 0]] and model.notes == ()


def test_a_note_names_few_of_many_missing_material_files() -> None:
    (note,) = obj("".join(f"mtllib {i}.mtl\n" * 2 for i in range(8)) + f"{TRIANGLE}usemtl A\nf 1 2 3\n").notes
    assert note.endswith("'0.mtl', '1.mtl', '2.mtl', '3.mtl', '4.mtl' and 3 more")


def test_colors_of_vertices_need_no_materials() -> None:
    model = obj("v 0 0 0 0 1 0\nv 1 0 0 0 1 0\nv 0 1 0 0 1 0\nusemtl A\nf 1 2 3\n")
    assert colors(model.parts[0]) == [[0, 1, 0]] and model.notes == ()


@pytest.mark.parametrize(
    ("statement", "note"),
    [
        (
            "mtllib gone.mtl\n",
            "no color was found for the materials 'A', 'B'; MTL files that are missing.*: 'gone.mtl'$",
        ),
        ("", "no color was found for the materials 'A', 'B'$"),
    ],
)
def test_missing_materials_are_named(statement: str, note: str) -> None:
    (found,) = obj(f"{statement}{TRIANGLE}usemtl B\nf 1 2 3\nusemtl A\nf 1 2 3\n").notes
    assert re.search(note, found)


@pytest.mark.parametrize("name", ["gray.png", "dark.png"])
def test_pictures_of_16_bits_keep_their_levels(name: str) -> None:
    levels = np.arange(256, dtype=np.uint16).reshape(16, 16) // (1 if name == "gray.png" else 4)
    wide, narrow = Image.fromarray(257 * levels), Image.fromarray(levels.astype(np.uint8))
    assert wide.mode == "I;16"
    found, expected = (decode_picture(encoded(picture), name) for picture in (wide, narrow))
    np.testing.assert_array_equal(found, expected)


def encoded(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    return buffer.getvalue()
