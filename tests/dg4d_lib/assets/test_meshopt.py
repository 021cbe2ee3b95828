"""EXT_meshopt_compression as other programs write it."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dg4d_lib.assets.formats.gltf import GlbReader, GltfDocument
from dg4d_lib.assets.formats.meshopt import pack_vertices
from dg4d_lib.errors import BadInput

meshoptimizer = pytest.importorskip("meshoptimizer", reason="meshoptimizer is not installed: make clients")


def view(content: bytes, stride: int, count: int, **packed: str) -> bytes:
    """Return the bytes of a compressed buffer view of a GLB, as the reader finds them."""
    document = GltfDocument({})
    number = document.add_view("v", content)
    location = document.tree["bufferViews"][number]
    location["extensions"] = {"EXT_meshopt_compression": {**location, "byteStride": stride, "count": count, **packed}}
    return GlbReader(document.to_bytes()).view(number)


def filtered(name: str, rows: NDArray[Any]) -> bytes:
    return view(pack_vertices(rows), rows[0].nbytes, len(rows), mode="ATTRIBUTES", filter=name)


def test_octahedral_normals_are_unit_vectors() -> None:
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    x, y, z = (normals / np.abs(normals).sum(1, keepdims=True)).T
    folded = (1 - np.abs(y)) * np.copysign(1, x), (1 - np.abs(x)) * np.copysign(1, y)
    stored = np.where(z < 0, folded, (x, y)).T
    rows = np.concatenate([stored, np.ones((50, 1)), np.zeros((50, 1))], 1)
    found = np.frombuffer(filtered("OCTAHEDRAL", np.rint(127 * rows).astype("i1")), "i1").reshape(-1, 4)
    np.testing.assert_allclose(found[:, :3] / 127, normals, atol=0.02)  # 8 bits


def test_quaternions_get_their_largest_number() -> None:
    quats = np.tile((0.1, -0.2, 0.3, np.sqrt(0.86)), (6, 1))
    rows = np.concatenate([np.rint(quats[:, :3] * 2**0.5 * 32767), np.full((6, 1), 32767)], 1)  # 3: the last is largest
    found = np.frombuffer(filtered("QUATERNION", rows.astype("<i2")), "<i2").reshape(-1, 4)
    np.testing.assert_allclose(found / 32767, quats, atol=1e-4)  # 16 bits


def test_exponential_numbers_are_floats() -> None:
    values = np.random.default_rng(0).normal(size=(50, 3))
    mantissas = np.rint(values * 2**20).astype(np.int64)
    rows = ((-20 & 255) << 24 | mantissas & 0xFFFFFF).astype("<u4")
    np.testing.assert_allclose(np.frombuffer(filtered("EXPONENTIAL", rows), "<f4").reshape(-1, 3), values, atol=1e-6)


def test_index_sequences_are_read() -> None:
    indices = np.array([0, 1, 2, 1, 3, 7, 7], np.uint32)
    meshoptimizer.encode_index_version(1)
    packed = meshoptimizer.encode_index_sequence(indices, len(indices), 8)
    assert np.frombuffer(view(packed, 2, len(indices), mode="INDICES"), "<u2").tolist() == indices.tolist()


@pytest.mark.parametrize(
    ("stride", "packed"),
    [
        (4, {"mode": "ATTRIBUTES", "filter": "COLOR"}),
        (4, {"mode": "ATTRIBUTES", "filter": "QUATERNION"}),
        (4, {"mode": "TRIANGLES", "filter": "OCTAHEDRAL"}),
        (4, {"mode": "LINES"}),
        (1, {"mode": "TRIANGLES"}),
    ],
    ids=["unknown filter", "short rows", "filtered triangles", "unknown mode", "short indices"],
)
def test_what_the_extension_does_not_allow_is_refused(stride: int, packed: dict[str, str]) -> None:
    with pytest.raises(BadInput, match="export it without compression"):
        view(pack_vertices(np.zeros((3, 4), np.uint8)), stride, 3, **packed)
