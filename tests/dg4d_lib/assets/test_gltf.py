"""GLB container."""

import struct

import numpy as np
import pytest

from dg4d_lib.assets.formats.gltf import VERTEX_DATA, GlbReader, GltfDocument, padded_rows
from dg4d_lib.errors import BadInput


def test_what_is_added_comes_back() -> None:
    document = GltfDocument({"a": [1, {"b": None}]})
    points = np.arange(9, dtype="<f4").reshape(3, 3)
    numbers = np.array([7, 1, 3], dtype="<u2")
    first, second = document.add_accessor("points", points, VERTEX_DATA), document.add_accessor("numbers", numbers)
    parsed = GlbReader(document.to_bytes())
    assert np.array_equal(parsed.accessor(first), points)
    assert np.array_equal(parsed.accessor(second), numbers[:, None])
    assert parsed.tree["asset"] == {"version": "2.0", "generator": "dg4d", "extras": {"a": [1, {"b": None}]}}


def test_properties_that_are_none_are_left_out() -> None:
    document = GltfDocument({})
    document.add("nodes", name="n", mesh=None, scale=[1, 1, 1])
    assert document.tree["nodes"] == [{"name": "n", "scale": [1, 1, 1]}]
    assert "extras" not in document.tree["asset"]


def test_views_start_at_multiples_of_four_and_padding_is_zero() -> None:
    document = GltfDocument({})
    document.add_view("odd", b"abcde")
    document.add_view("next", b"f")
    assert [view["byteOffset"] for view in document.tree["bufferViews"]] == [0, 8]
    assert bytes(document.binary) == b"abcde\0\0\0f\0\0\0"


@pytest.mark.parametrize(
    ("dtype", "width", "padded"), [("u1", 3, 4), ("u1", 4, 4), ("u1", 5, 8), ("<i2", 3, 4), ("<f4", 3, 3)]
)
def test_rows_of_vertices_are_padded_with_zeros_to_whole_words(dtype: str, width: int, padded: int) -> None:
    rows = np.ones((2, width), dtype)
    expected = np.zeros((2, padded), dtype)
    expected[:, :width] = 1
    assert np.array_equal(padded_rows(rows), expected)


def test_readers_without_the_compression_are_told_to_reject_the_file() -> None:
    pytest.importorskip("meshoptimizer")
    document, points = GltfDocument({}, compressed=True), np.arange(9, dtype="<f4").reshape(3, 3)
    number = document.add_accessor("points", points, VERTEX_DATA)
    parsed = GlbReader(document.to_bytes())
    assert np.array_equal(parsed.accessor(number), points)
    assert parsed.tree["extensionsRequired"] == parsed.tree["extensionsUsed"] == ["EXT_meshopt_compression"]


def test_chunks_are_padded_and_announced_with_their_true_length() -> None:
    content = GltfDocument({"text": "ä"}).to_bytes()
    (length,) = struct.unpack_from("<I", content, 8)
    (text_length,) = struct.unpack_from("<I", content, 12)
    assert (length, length % 4, text_length % 4) == (len(content), 0, 0)
    assert content[20 + text_length + 4 : 20 + text_length + 8] == b"BIN\0"


def test_interleaved_vertices_of_other_writers_are_read() -> None:
    document = GltfDocument({})
    rows = np.arange(10, dtype="<f4").reshape(2, 5)  # a position and texture coordinates
    view = document.add_view("vertices", rows.tobytes())
    document.tree["bufferViews"][view]["byteStride"] = 20
    common = {"bufferView": view, "componentType": 5126, "count": 2}
    document.add("accessors", type="VEC3", **common)
    document.add("accessors", type="VEC2", byteOffset=12, **common)
    parsed = GlbReader(document.to_bytes())
    assert np.array_equal(parsed.accessor(0), rows[:, :3])
    assert np.array_equal(parsed.accessor(1), rows[:, 3:])


@pytest.mark.parametrize("extra", [1, 100])
def test_an_accessor_beyond_its_view_is_not_read(extra: int) -> None:
    document = GltfDocument({})
    number = document.add_accessor("points", np.zeros((4, 3), "<f4"))
    document.tree["accessors"][number]["count"] += extra
    with pytest.raises((TypeError, ValueError)):
        GlbReader(document.to_bytes()).accessor(number)


def test_a_container_of_another_kind_is_refused_by_its_first_bytes() -> None:
    with pytest.raises(BadInput, match="not a GLB: it starts with b'glTX'"):
        GlbReader(b"glTX" + GltfDocument({}).to_bytes()[4:])


@pytest.mark.parametrize("keep", [0, 3, 11, 19, 24])
def test_a_cut_off_container_is_refused(keep: int) -> None:
    with pytest.raises(BadInput, match="GLB"):
        GlbReader(GltfDocument({}).to_bytes()[:keep])


def test_endlessly_nested_json_is_refused() -> None:
    text = b"[" * 100_000
    content = b"glTF" + struct.pack("<II", 2, 28 + len(text)) + struct.pack("<I4s", len(text), b"JSON") + text
    with pytest.raises(BadInput, match="corrupt"):
        GlbReader(content + struct.pack("<I4s", 0, b"BIN\0"))


def test_numbers_that_are_not_finite_never_reach_the_json() -> None:
    with pytest.raises(ValueError, match="JSON"):
        GltfDocument({"loss": float("nan")}).to_bytes()
