"""KHR_draco_mesh_compression: meshes of other programs' GLBs, decompressed."""

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats.gltf import COMPONENT_OF, COMPONENTS, INDEX_DATA, VERTEX_DATA, GlbReader, padded_rows
from dg4d_lib.errors import BadInput

EXTENSION = "KHR_draco_mesh_compression"
TRIANGLES = 4


def unpack_draco(reader: GlbReader) -> None:
    """Give the file plain accessors in place of compressed ones; the extension is gone then.

    Raises:
        BadInput: a mesh cannot be decompressed.
        KeyError, IndexError, TypeError, ValueError, AttributeError: the JSON is broken.
    """
    tree = reader.tree
    for names in (tree.get("extensionsUsed", []), tree.get("extensionsRequired", [])):
        if EXTENSION in names:
            names.remove(EXTENSION)
    primitives = [primitive for mesh in tree.get("meshes", ()) for primitive in mesh["primitives"]]
    compressed = [primitive for primitive in primitives if EXTENSION in primitive.get("extensions", {})]
    if not compressed:
        return
    unpacked = _Unpacked(reader)
    for primitive in compressed:
        unpacked.add(primitive, primitive["extensions"].pop(EXTENSION))
    reader.binary = bytes(unpacked.binary)
    if "buffers" in tree:
        tree["buffers"][0]["byteLength"] = len(reader.binary)


class _Unpacked:
    """Decompressed meshes, appended to the buffer of a file."""

    def __init__(self, reader: GlbReader) -> None:
        self.reader, self.tree = reader, reader.tree
        self.binary = bytearray(reader.binary)
        self.meshes: dict[int, Any] = {}

    def add(self, primitive: dict[str, Any], packed: dict[str, Any]) -> None:
        """Give a primitive its triangles and attributes; data that several primitives share is decompressed once."""
        accessors, views, index = self.tree["accessors"], self.tree["bufferViews"], packed["bufferView"]
        if index not in self.meshes:
            self.meshes[index] = _decode(self.reader.view(index))
            views[index] = {}  # of the compressed bytes, which nothing needs any more; becomes that of the triangles
        mesh = self.meshes[index]
        rows = {attribute["unique_id"]: attribute["data"] for attribute in mesh.attributes}
        for name, number in packed["attributes"].items():
            accessor = accessors[primitive["attributes"][name]]
            values = np.asarray(rows[number]).reshape(len(rows[number]), -1)
            stored = padded_rows(values.astype(COMPONENTS[accessor["componentType"]]))
            views.append(self._view(stored, target=VERTEX_DATA, byteStride=stored.strides[0]))
            _point(accessor, len(views) - 1, stored)
            if "min" in accessor:  # the compression is lossy, so bounds differ
                width = values.shape[1]
                accessor |= {"min": stored[:, :width].min(0).tolist(), "max": stored[:, :width].max(0).tolist()}
        triangles = np.asarray(mesh.faces, "<u4").reshape(-1)
        views[index] = views[index] or self._view(triangles, target=INDEX_DATA)
        primitive.setdefault("indices", len(accessors))
        if primitive["indices"] == len(accessors):
            accessors.append({"type": "SCALAR"})
        _point(accessors[primitive["indices"]], index, triangles)
        primitive["mode"] = TRIANGLES

    def _view(self, rows: NDArray[Any], **kind: int) -> dict[str, int]:
        """Append rows to the buffer; return their view."""
        start = len(self.binary)
        self.binary += rows.tobytes() + bytes(-rows.nbytes % 4)
        return {"buffer": 0, "byteOffset": start, "byteLength": rows.nbytes, **kind}


def _point(accessor: dict[str, Any], view: int, rows: NDArray[Any]) -> None:
    """Let an accessor be the rows of a view."""
    accessor.pop("byteOffset", None)
    accessor |= {"bufferView": view, "count": len(rows), "componentType": COMPONENT_OF[rows.dtype]}


def _decode(content: bytes) -> Any:
    draco: Any = import_module("DracoPy")  # without type annotations
    try:
        mesh = draco.decode(content)
        if not hasattr(mesh, "faces"):
            raise ValueError("it holds points and no triangles")
    except (draco.FileTypeException, ValueError, TypeError, RuntimeError) as error:
        raise BadInput(f"a mesh of the model is compressed with Draco and broken ({error}); export it again") from error
    return mesh
