"""GLB container: the glTF 2.0 JSON tree and its binary buffer, written and read."""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.assets.formats import meshopt
from dg4d_lib.errors import BadInput

VERTEX_DATA = 34962  # buffer view targets
INDEX_DATA = 34963
MAX_LENGTH = 2**32 - 1  # maximum size of a GLB, bytes
MAX_POSES = 128  # morph targets of a node; players keep weights in uniforms, of which every GPU has at least 256

_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_ALIGNMENT = 4  # of vertices and buffer views, bytes
COMPONENTS: dict[int, np.dtype[Any]] = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
COMPONENT_OF = {dtype: number for number, dtype in COMPONENTS.items()}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPE_OF = {width: kind for kind, width in _WIDTHS.items()}


class GltfDocument:
    """glTF document under construction; items refer to earlier items by index.

    Attributes:
        tree: the JSON tree.
        binary: the buffer; every view starts at a multiple of four bytes.
        compressed: True if vertices and triangles are compressed with EXT_meshopt_compression.
    """

    def __init__(self, extras: dict[str, Any], *, compressed: bool = False) -> None:
        """Create an empty document.

        Args:
            extras: additional JSON about the asset.
            compressed: True to compress vertices and triangles with EXT_meshopt_compression.
        """
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "dg4d"}}
        if extras:
            self.tree["asset"]["extras"] = extras
        self.binary = bytearray()
        self.compressed = compressed
        self._unpacked = 0  # decompressed size of the compressed views, bytes

    def add(self, collection: str, **item: Any) -> int:
        """Append an item to `nodes`, `meshes`, ... and return its index; properties that are None are omitted."""
        items = self.tree.setdefault(collection, [])
        items.append({key: value for key, value in item.items() if value is not None})
        return len(items) - 1

    def use_extension(self, extension: str, *, required: bool = False) -> None:
        """Declare an extension as used, and as required if readers without it must reject the file."""
        for collection in ("extensionsUsed", "extensionsRequired") if required else ("extensionsUsed",):
            names = self.tree.setdefault(collection, [])
            if extension not in names:
                names.append(extension)

    def add_view(self, name: str, content: bytes, target: int | None = None, stride: int | None = None) -> int:
        """Append bytes to the buffer; return the index of their view."""
        start = len(self.binary)
        self.binary += content + bytes(-len(content) % _ALIGNMENT)
        location = {"buffer": 0, "byteOffset": start, "byteLength": len(content)}
        return self.add("bufferViews", name=name, **location, byteStride=stride, target=target)

    def add_view_of(self, other: "GlbReader", index: int) -> int:
        """Append a view of another file without decompressing it; return its index."""
        view: dict[str, Any] = {**other.tree["bufferViews"][index]}
        packed = view.get("extensions", {}).get(meshopt.EXTENSION)
        content = other.raw_view(index)
        location = {"buffer": 0, "byteOffset": len(self.binary)}
        self.binary += content + bytes(-len(content) % _ALIGNMENT)
        if packed is None:
            return self.add("bufferViews", **{**view, **location})
        view |= {"buffer": 1, "byteOffset": self._unpacked, "extensions": {meshopt.EXTENSION: {**packed, **location}}}
        self._unpacked += view["byteLength"] + -view["byteLength"] % _ALIGNMENT
        return self.add("bufferViews", **view)

    def add_accessor(
        self, name: str, values: NDArray[Any], target: int | None = None, *, normalized: bool = False
    ) -> int:
        """Append rows of numbers ("n" or "n k") with their bounds; return the accessor's index.

        Args:
            name: of the accessor and its view.
            values: of a type that glTF supports.
            target: buffer view target; vertex data is padded to whole words.
            normalized: True if integers stand for fractions of the largest integer.
        """
        rows = values.reshape(len(values), -1)
        add = self._add_packed_view if self.compressed and target is not None else self._add_plain_view
        return self.add(
            "accessors",
            name=name,
            bufferView=add(name, rows, target),
            componentType=COMPONENT_OF[rows.dtype],
            normalized=normalized or None,
            count=len(rows),
            type=_TYPE_OF[rows.shape[1]],
            min=rows.min(0).tolist(),
            max=rows.max(0).tolist(),
        )

    def to_bytes(self) -> bytes:
        """Encode the document as GLB.

        Raises:
            BadInput: the file would exceed the maximum size of a GLB.
        """
        buffers: list[dict[str, Any]] = [{"byteLength": len(self.binary)}]
        if self._unpacked:
            buffers.append({"byteLength": self._unpacked, "extensions": {meshopt.EXTENSION: {"fallback": True}}})
        text = json.dumps({**self.tree, "buffers": buffers}, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % _ALIGNMENT)
        chunks = b"".join(
            struct.pack("<I", len(content)) + kind + content
            for kind, content in ((_JSON, text), (_BINARY, bytes(self.binary)))
        )
        length = 12 + len(chunks)
        if length > MAX_LENGTH:
            raise BadInput(
                f"this GLB would have {length / 2**30:.1f} GiB, at most 4 GiB are allowed; use fewer frames or "
                "vertices or smaller textures, or set pack.gltf.quantized or pack.gltf.meshopt to true"
            )
        return _MAGIC + struct.pack("<II", 2, length) + chunks

    def _add_plain_view(self, name: str, rows: NDArray[Any], target: int | None) -> int:
        padded = padded_rows(rows) if target == VERTEX_DATA else rows
        stride = padded[0].nbytes if padded.shape != rows.shape else None
        return self.add_view(name, padded.tobytes(), target, stride)

    def _add_packed_view(self, name: str, rows: NDArray[Any], target: int | None) -> int:
        """Append a compressed view: a view of the fallback buffer, and the location of the compressed bytes."""
        self.use_extension(meshopt.EXTENSION, required=True)
        vertices = target == VERTEX_DATA
        padded = padded_rows(rows) if vertices else rows
        content = meshopt.pack_vertices(padded) if vertices else meshopt.pack_triangles(padded)
        number = self.add_view(name, content)
        view = self.tree["bufferViews"][number]
        packed = {key: view[key] for key in ("buffer", "byteOffset", "byteLength")}
        stride = padded[0].nbytes
        packed |= {"byteStride": stride, "count": len(padded), "mode": "ATTRIBUTES" if vertices else "TRIANGLES"}
        view |= {"buffer": 1, "byteOffset": self._unpacked, "byteLength": padded.nbytes, "target": target}
        if vertices:
            view["byteStride"] = stride
        view["extensions"] = {meshopt.EXTENSION: packed}
        self._unpacked += padded.nbytes + -padded.nbytes % _ALIGNMENT
        return number


class GlbReader:
    """GLB in memory: its JSON tree and its buffer.

    Raises:
        BadInput: the container is corrupt.
    """

    def __init__(self, content: bytes) -> None:
        if content[:4] != _MAGIC:
            raise BadInput(f"this is not a GLB: it starts with {content[:4]!r} instead of {_MAGIC!r}")
        try:
            version, length = struct.unpack_from("<II", content, 4)
            (text_length,) = struct.unpack_from("<I", content, 12)
            self.tree: dict[str, Any] = json.loads(content[20 : 20 + text_length])
            (binary_length,) = struct.unpack_from("<I", content, 20 + text_length)
        except (struct.error, ValueError, RecursionError) as error:
            raise BadInput(f"this GLB is corrupt ({error}); export it again") from error
        start = 28 + text_length
        if version != 2 or length != len(content) or start + binary_length > len(content):
            raise BadInput(
                f"this GLB is corrupt: version {version} (2 expected), {length} bytes declared, {len(content)} found; "
                "export it again"
            )
        self.binary = content[start : start + binary_length]

    def view(self, index: int) -> bytes:
        """Return the bytes of a buffer view, decompressed.

        Raises:
            BackendUnavailable: the view is compressed and meshoptimizer is missing.
            BadInput: it cannot be decompressed.
        """
        view = self.tree["bufferViews"][index]
        packed = view.get("extensions", {}).get(meshopt.EXTENSION)
        if packed is None:
            return self._bytes(view)
        return meshopt.unpack(self._bytes(packed), packed)

    def raw_view(self, index: int) -> bytes:
        """Return the bytes of a buffer view as stored, compressed or not."""
        view = self.tree["bufferViews"][index]
        return self._bytes(view.get("extensions", {}).get(meshopt.EXTENSION, view))

    def accessor(self, index: int) -> NDArray[Any]:
        """Return rows of numbers, "n k"; normalized integers are converted to float32."""
        accessor = self.tree["accessors"][index]
        dtype, width = COMPONENTS[accessor["componentType"]], _WIDTHS[accessor["type"]]
        stride = self.tree["bufferViews"][accessor["bufferView"]].get("byteStride", width * dtype.itemsize)
        rows: NDArray[Any] = np.ndarray(
            (accessor["count"], width),
            dtype,
            self.view(accessor["bufferView"]),
            accessor.get("byteOffset", 0),
            (stride, dtype.itemsize),
        )
        if not accessor.get("normalized"):
            return rows
        return np.maximum(rows / np.float32(np.iinfo(dtype).max), np.float32(-1))

    def _bytes(self, location: dict[str, Any]) -> bytes:
        start = location.get("byteOffset", 0)
        return self.binary[start : start + location["byteLength"]]


def padded_rows(rows: NDArray[Any]) -> NDArray[Any]:
    """Pad rows with zeros to whole words."""
    missing = -rows[0].nbytes % _ALIGNMENT // rows.itemsize
    return np.pad(rows, ((0, 0), (0, missing))) if missing else rows


def json_object(value: Any) -> dict[str, Any]:
    """Return a value of the tree if it is a JSON object, else an empty one."""
    return value if isinstance(value, dict) else {}


def read_accessor(reader: GlbReader, index: int, raw: bool = False) -> NDArray[Any]:
    """Return the rows of an accessor; floats, or with `raw` the stored integers.

    Raises:
        ValueError: it reaches beyond its view.
    """
    tree = reader.tree
    accessor = tree["accessors"][index]
    kind = COMPONENTS[accessor["componentType"]]
    width = (_WIDTHS | {"MAT4": 16})[accessor["type"]]
    count = int(accessor["count"])
    if not 0 <= count <= 50_000_000:
        raise ValueError(f"an accessor has {count} rows")
    if "bufferView" in accessor:
        view = tree["bufferViews"][accessor["bufferView"]]
        rows = _rows(
            reader, accessor["bufferView"], accessor.get("byteOffset", 0), kind, width, count, view.get("byteStride")
        )
    else:
        rows = np.zeros((count, width), kind)
    if "sparse" in accessor:
        sparse, rows = accessor["sparse"], rows.copy()
        where, what = sparse["indices"], sparse["values"]
        into = {5121: "u1", 5123: "<u2", 5125: "<u4"}[where["componentType"]]
        places = _rows(
            reader, where["bufferView"], where.get("byteOffset", 0), np.dtype(into), 1, sparse["count"], None
        )
        rows[places[:, 0]] = _rows(
            reader, what["bufferView"], what.get("byteOffset", 0), kind, width, sparse["count"], None
        )
    if raw or kind.kind == "f":
        return rows
    values = rows.astype(np.float32)
    return np.maximum(values / np.iinfo(kind).max, -1) if accessor.get("normalized") else values


def _rows(
    reader: GlbReader, view: int, offset: int, kind: np.dtype[Any], width: int, count: int, stride: int | None
) -> NDArray[Any]:
    content = reader.view(view)
    step = stride or width * kind.itemsize
    if offset < 0 or step < width * kind.itemsize:
        raise ValueError("an accessor has a negative offset or a stride that is too small")
    if count and offset + (count - 1) * step + width * kind.itemsize > len(content):
        raise ValueError("an accessor reaches beyond its view")
    return np.ndarray((count, width), kind, content, offset, (step, kind.itemsize))
