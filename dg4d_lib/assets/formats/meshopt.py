"""EXT_meshopt_compression: lossless compression of vertices and triangles with the reference library."""

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.errors import BackendUnavailable, BadInput

EXTENSION = "EXT_meshopt_compression"
VERTEX_FORMAT, INDEX_FORMAT = 0, 1  # codec versions that the extension prescribes


def pack_vertices(rows: NDArray[Any]) -> bytes:
    """Compress rows of vertex data; a row has a multiple of 4 bytes, at most 256.

    Raises:
        BackendUnavailable: meshoptimizer is missing.
    """
    library = _library()
    library.encode_vertex_version(VERTEX_FORMAT)
    return library.encode_vertex_buffer(rows, len(rows), rows[0].nbytes)


def unpack_vertices(content: bytes, count: int, stride: int) -> bytes:
    """Decompress the output of `pack_vertices`.

    Raises:
        BackendUnavailable: meshoptimizer is missing.
        BadInput: the content is corrupt.
    """
    library = _library()
    try:
        return library.decode_vertex_buffer(count, stride, content, np.dtype((np.void, stride))).tobytes()
    except RuntimeError as error:
        raise BadInput(f"the vertices of this GLB cannot be decompressed ({error}); export the file again") from error


def pack_triangles(indices: NDArray[Any]) -> bytes:
    """Compress three indices per triangle; decompression may rotate them, (1, 2, 0) for (0, 1, 2).

    Raises:
        BackendUnavailable: meshoptimizer is missing.
    """
    library = _library()
    library.encode_index_version(INDEX_FORMAT)
    return library.encode_index_buffer(indices.ravel(), indices.size, int(indices.max()) + 1)


def unpack_triangles(content: bytes, count: int, size: int) -> bytes:
    """Decompress the output of `pack_triangles` to unsigned integers of 2 or 4 bytes.

    Raises:
        BackendUnavailable: meshoptimizer is missing.
        BadInput: the content is corrupt.
    """
    library = _library()
    try:
        return library.decode_index_buffer(count, np.uint32().nbytes, content).astype(f"<u{size}").tobytes()
    except RuntimeError as error:
        raise BadInput(f"the triangles of this GLB cannot be decompressed ({error}); export the file again") from error


def order_for_compression(
    faces: NDArray[np.integer[Any]], vertices: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort triangles by the vertices they share, and vertices by the triangles that use them.

    Args:
        faces: indices of the vertices, a row per triangle.
        vertices: number of vertices.

    Returns:
        The old index of every vertex in the new order, and the triangles in the new order with new indices.

    Raises:
        BackendUnavailable: meshoptimizer is missing.
    """
    library = _library()
    indices = np.ascontiguousarray(faces.ravel(), np.uint32)
    library.optimize_vertex_cache(indices, indices.copy(), indices.size, vertices)
    uses = np.unique(indices, return_index=True)
    order = uses[0][np.argsort(uses[1])].astype(np.int64)  # by first use
    order = np.concatenate((order, np.setdiff1d(np.arange(vertices), order)))
    new_index = np.empty(vertices, np.int64)
    new_index[order] = np.arange(vertices)
    return order, new_index[indices.astype(np.int64)].reshape(-1, 3)


def _library() -> ModuleType:
    try:
        import meshoptimizer  # noqa: PLC0415 (optional dependency)
    except ImportError as error:
        raise BackendUnavailable(
            f"{EXTENSION} needs the package meshoptimizer; run `deploy/install.sh meshopt`, "
            "or set pack.gltf.meshopt=false"
        ) from error
    return meshoptimizer
