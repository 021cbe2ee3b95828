"""EXT_meshopt_compression with the reference library: lossless compression, and decompression of all its modes."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.errors import BackendUnavailable, BadInput

EXTENSION = "EXT_meshopt_compression"
VERTEX_FORMAT, INDEX_FORMAT = 0, 1  # codec versions that the extension prescribes
_FILTERS = {"OCTAHEDRAL": "decode_filter_oct", "QUATERNION": "decode_filter_quat", "EXPONENTIAL": "decode_filter_exp"}
_STRIDES: dict[tuple[str, str], Sequence[int]] = {  # bytes per row that modes and filters of the extension allow
    ("TRIANGLES", "NONE"): (2, 4),
    ("INDICES", "NONE"): (2, 4),
    ("ATTRIBUTES", "NONE"): range(4, 257, 4),
    ("ATTRIBUTES", "OCTAHEDRAL"): (4, 8),
    ("ATTRIBUTES", "QUATERNION"): (8,),
    ("ATTRIBUTES", "EXPONENTIAL"): range(4, 257, 4),
}


def pack_vertices(rows: NDArray[Any]) -> bytes:
    """Compress rows of vertex data; a row has a multiple of 4 bytes, at most 256.

    Raises:
        BackendUnavailable: meshoptimizer is missing.
    """
    library = _library()
    library.encode_vertex_version(VERTEX_FORMAT)
    return library.encode_vertex_buffer(rows, len(rows), rows[0].nbytes)


def pack_triangles(indices: NDArray[Any]) -> bytes:
    """Compress three indices per triangle; decompression may rotate them, (1, 2, 0) for (0, 1, 2).

    Raises:
        BackendUnavailable: meshoptimizer is missing.
    """
    library = _library()
    library.encode_index_version(INDEX_FORMAT)
    return library.encode_index_buffer(indices.ravel(), indices.size, int(indices.max()) + 1)


def unpack(content: bytes, packed: dict[str, Any]) -> bytes:
    """Decompress a buffer view.

    Args:
        content: compressed bytes.
        packed: extension of the view, with `count`, `byteStride`, `mode` and, optionally, `filter`.

    Raises:
        BackendUnavailable: meshoptimizer is missing.
        BadInput: the content is corrupt, or the extension has no such mode, filter or stride.
        KeyError, TypeError, ValueError: the JSON is broken.
    """
    library, count, stride = _library(), packed["count"], packed["byteStride"]
    mode, name = packed["mode"], packed.get("filter", "NONE")
    if stride not in _STRIDES.get((mode, name), ()):
        raise BadInput(
            f"this GLB is compressed with mode {mode!r}, filter {name!r} and {stride} bytes per row, which "
            f"{EXTENSION} does not allow; export it without compression"
        )
    try:
        if mode == "ATTRIBUTES":
            rows = library.decode_vertex_buffer(count, stride, content, np.dtype((np.void, stride)))
        else:
            decode = library.decode_index_buffer if mode == "TRIANGLES" else library.decode_index_sequence
            rows = decode(count, np.uint32().nbytes, content).astype(f"<u{stride}")
    except RuntimeError as error:
        raise BadInput(f"this GLB cannot be decompressed ({error}); export the file again") from error
    if name != "NONE":
        rows = getattr(library, _FILTERS[name])(rows, count, stride)
    return rows.tobytes()


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
