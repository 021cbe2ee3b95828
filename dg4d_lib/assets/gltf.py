"""The GLB container: a tree of plain JSON in the words of the glTF 2.0 specification, and the bytes it points to."""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.errors import BadInput

VERTEX_DATA = 34962  # buffer view targets
INDEX_DATA = 34963

_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_COMPONENTS: dict[int, np.dtype[Any]] = {
    5126: np.dtype("<f4"),
    5125: np.dtype("<u4"),
    5123: np.dtype("<u2"),
    5121: np.dtype("u1"),
}
_COMPONENT_OF = {dtype: number for number, dtype in _COMPONENTS.items()}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_KIND_OF = {width: kind for kind, width in _WIDTHS.items()}


class Document:
    """A glTF document under construction; what is added later may refer to what was added before, by its number.

    Attributes:
        tree: the JSON.
        binary: the bytes of the one buffer; every view starts at a multiple of four.
    """

    def __init__(self, extras: dict[str, Any]) -> None:
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "dg4d"}}
        if extras:
            self.tree["asset"]["extras"] = extras
        self.binary = bytearray()

    def add(self, collection: str, **item: Any) -> int:
        """Append to `nodes`, `meshes`, ...; a property that is None is left out. Returns its number."""
        items = self.tree.setdefault(collection, [])
        items.append({key: value for key, value in item.items() if value is not None})
        return len(items) - 1

    def add_view(self, name: str, content: bytes, target: int | None = None) -> int:
        """Append bytes to the buffer. Returns the number of their view."""
        start = len(self.binary)
        self.binary += content + bytes(-len(content) % 4)
        return self.add("bufferViews", name=name, buffer=0, byteOffset=start, byteLength=len(content), target=target)

    def add_accessor(self, name: str, values: NDArray[Any], target: int | None = None) -> int:
        """Append rows of numbers ("n" or "n k") with their true bounds. Returns the accessor's number."""
        rows = values.reshape(len(values), -1)
        return self.add(
            "accessors",
            name=name,
            bufferView=self.add_view(name, rows.tobytes(), target),
            componentType=_COMPONENT_OF[rows.dtype],
            count=len(rows),
            type=_KIND_OF[rows.shape[1]],
            min=rows.min(0).tolist(),
            max=rows.max(0).tolist(),
        )

    def to_bytes(self) -> bytes:
        """The finished GLB."""
        tree = {**self.tree, "buffers": [{"byteLength": len(self.binary)}]}
        text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        chunks = b"".join(
            struct.pack("<I", len(content)) + kind + content
            for kind, content in ((_JSON, text), (_BINARY, bytes(self.binary)))
        )
        return _MAGIC + struct.pack("<II", 2, 12 + len(chunks)) + chunks


class Parsed:
    """A GLB that was read: its JSON and its buffer.

    Raises:
        BadInput: the container is broken.
    """

    def __init__(self, content: bytes) -> None:
        if content[:4] != _MAGIC:
            raise BadInput(f"this is no GLB: it must begin with {_MAGIC!r}, and begins with {content[:4]!r}")
        try:
            version, length = struct.unpack_from("<II", content, 4)
            (text_length,) = struct.unpack_from("<I", content, 12)
            self.tree: dict[str, Any] = json.loads(content[20 : 20 + text_length])
            (binary_length,) = struct.unpack_from("<I", content, 20 + text_length)
        except (struct.error, ValueError) as error:
            raise BadInput(f"this GLB is broken: {error}") from error
        start = 28 + text_length
        if version != 2 or length != len(content) or start + binary_length > len(content):
            raise BadInput(f"this GLB is broken: version {version}, {length} bytes announced, {len(content)} there")
        self.binary = content[start : start + binary_length]

    def view(self, index: int) -> bytes:
        """The bytes of a buffer view."""
        view = self.tree["bufferViews"][index]
        start = view.get("byteOffset", 0)
        return self.binary[start : start + view["byteLength"]]

    def accessor(self, index: int) -> NDArray[Any]:
        """Rows of numbers, "n k"."""
        accessor = self.tree["accessors"][index]
        dtype, width = _COMPONENTS[accessor["componentType"]], _WIDTHS[accessor["type"]]
        stride = self.tree["bufferViews"][accessor["bufferView"]].get("byteStride", width * dtype.itemsize)
        return np.ndarray(
            (accessor["count"], width),
            dtype,
            self.view(accessor["bufferView"]),
            accessor.get("byteOffset", 0),
            (stride, dtype.itemsize),
        )
