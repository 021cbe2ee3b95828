"""Reader of users' models: GLB, glTF, OBJ, USDZ and PLY meshes become one GLB; splats (PLY, SPZ) become Gaussians.

A model arrives as a zip: `model.SUFFIX` and the files that it refers to, beside it or in folders below.
"""

import base64
import binascii
import json
import os.path
import struct
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.assets.formats.foreign_glb import ForeignGlb, read_foreign_glb
from dg4d_lib.assets.formats.foreign_splats import read_foreign_ply, read_spz
from dg4d_lib.assets.formats.model_glb import write_model_glb
from dg4d_lib.assets.formats.model_pictures import decode_picture, picture_type
from dg4d_lib.assets.formats.obj import read_obj
from dg4d_lib.assets.formats.ply_mesh import declared_faces, read_ply_mesh
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.merging import merge_gaussians
from dg4d_lib.mesh.models.model import Model
from steps.artifacts.archives import stays_inside, unpack
from steps.sources.decode_limit import DecodeLimit
from steps.sources.media_types import MODEL_SUFFIXES

MODEL = "model"  # name of the main file, before its suffix
DATA_URI = "data:"


@dataclass(frozen=True)
class OwnModel:
    """A model of the user's: a mesh or splats.

    Attributes:
        content: GLB of a mesh; empty for splats.
        glb: the same, read.
        splats: Gaussians; None for a mesh.
        ups: axes that may point up in its format.
        notes: sentences for the report.
    """

    content: bytes = b""
    glb: ForeignGlb | None = None
    splats: Gaussians | None = None
    ups: tuple[str, ...] = ("y",)
    notes: tuple[str, ...] = ()


def read_model(path: Path, scratch: Path, settings: AssetSettings, max_decode_gb: float) -> OwnModel:
    """Read the model in a zip.

    Args:
        path: the zip.
        scratch: empty folder.
        settings: limits.
        max_decode_gb: memory for decoding.

    Raises:
        BadInput: it cannot be used; says why and what to do.
    """
    limit = DecodeLimit(max_decode_gb)
    limit.require_file(path, "the model")
    names = unpack(path, scratch, "the model", lambda name: True)
    main = [name for name in names if Path(name).parent == Path() and Path(name).stem == MODEL]
    if len(main) != 1 or Path(main[0]).suffix not in MODEL_SUFFIXES:
        raise BadInput(
            f"the model must be one of {', '.join(MODEL_SUFFIXES)}; given {', '.join(names[:5]) or 'nothing'}"
        )
    file = scratch / main[0]
    with limit.enforced("the model"):
        own = _read(file, settings)
    return _merged(own, settings.max_splats)


def _read(file: Path, settings: AssetSettings) -> OwnModel:
    match file.suffix:
        case ".ply":
            return _ply(file.read_bytes(), file.parent, settings)
        case ".spz":
            splats, notes = read_spz(file.read_bytes())
            return OwnModel(splats=splats, ups=("y", "-y"), notes=notes)
        case ".glb" | ".gltf":
            return _mesh(embed_files(file), settings)
        case ".obj":
            text = file.read_bytes().decode("utf-8-sig", "replace")
            model = read_obj(text, lambda name: _read_sibling(file.parent, name), decode_picture, settings.max_faces)
            return _converted(model, settings, ("y", "z"))
        case _:
            usd: Any = import_module("dg4d_lib.assets.formats.usd_model")  # the USD library starts slowly
            usd.check_usdz(file)
            return _converted(usd.read_usd(file, decode_picture, settings.max_faces), settings)


def _merged(own: OwnModel, most: int) -> OwnModel:
    """Return the model with at most so many splats."""
    if own.splats is None or len(own.splats) <= most:
        return own
    note = f"{len(own.splats)} splats were merged to {most} that look the same (asset.max_splats)"
    return replace(own, splats=merge_gaussians(own.splats, most), notes=(*own.notes, note))


def _ply(content: bytes, folder: Path, settings: AssetSettings) -> OwnModel:
    """Return a mesh where the file has faces, and splats where it has none."""
    if declared_faces(content):
        model = read_ply_mesh(content, lambda name: _read_sibling(folder, name), decode_picture, settings.max_faces)
        return _converted(model, settings, ("y", "z"))
    splats, notes = read_foreign_ply(content)
    return OwnModel(splats=splats, ups=("-y", "y", "z"), notes=notes)  # 3DGS has y down


def _converted(model: Model, settings: AssetSettings, ups: tuple[str, ...] = ("y",)) -> OwnModel:
    """Return a model of another format as GLB."""
    own = _mesh(write_model_glb(model), settings, ups)
    return replace(own, notes=(*model.notes, *own.notes))


def _mesh(content: bytes, settings: AssetSettings, ups: tuple[str, ...] = ("y",)) -> OwnModel:
    glb = read_foreign_glb(content, settings.max_faces)
    return OwnModel(content=content, glb=glb, ups=ups, notes=glb.notes)


def _read_sibling(folder: Path, name: str) -> bytes | None:
    """Return the content of a file beside the model; None if there is none."""
    cleaned = name.replace("\\", "/").removeprefix("./")
    if not stays_inside(cleaned) or not os.path.isfile(folder / cleaned):  # noqa: PTH113 (any length of the name)
        return None
    return (folder / cleaned).read_bytes()


def embed_files(file: Path) -> bytes:
    """Return a GLB or glTF as a GLB whose buffers and images, also of files beside it, are in its one binary chunk.

    Raises:
        BadInput: the file is corrupt, or a file that it names is missing.
    """
    content, is_glb = file.read_bytes(), file.suffix == ".glb"
    try:
        tree, binary = _chunks(content) if is_glb else (_tree(content), b"")
    except (ValueError, struct.error, RecursionError) as error:
        kind = "GLB" if is_glb else "glTF"
        raise BadInput(f"the model is not a {kind} 2.0 file ({error}); export it again as GLB") from error
    try:
        return _embedded(tree, binary, file.parent)
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise BadInput(f"the model is a broken glTF ({error!r}); export it again") from error


def _embedded(tree: dict[str, Any], binary: bytes, folder: Path) -> bytes:
    parts, starts, total = [], [], 0
    for number, buffer in enumerate(tree.get("buffers", [])):
        fallback = (buffer.get("extensions") or {}).get("EXT_meshopt_compression", {}).get("fallback")
        data = b"" if fallback else _content(buffer["uri"], folder, "buffer") if "uri" in buffer else binary
        if "uri" not in buffer and number and not fallback:
            raise ValueError("two buffers without a file")
        starts.append(-1 if fallback else total)
        parts.append(data + bytes(-len(data) % 4))
        total += len(parts[-1])
    for view in tree.get("bufferViews", []):
        packed = (view.get("extensions") or {}).get("EXT_meshopt_compression")
        for place in (view, packed) if packed else (view,):
            if starts[place["buffer"]] >= 0:
                place["byteOffset"] = place.get("byteOffset", 0) + starts[place["buffer"]]
                place["buffer"] = 0
    for image in tree.get("images", []):
        if "uri" in image:
            uri = image.pop("uri")
            data = _content(uri, folder, "texture")
            view = {"buffer": 0, "byteOffset": total, "byteLength": len(data)}
            image["bufferView"] = len(tree.setdefault("bufferViews", []))
            image.setdefault("name", Path(uri).stem if not uri.startswith(DATA_URI) else "texture")
            image["mimeType"] = picture_type(data)
            tree["bufferViews"].append(view)
            parts.append(data + bytes(-len(data) % 4))
            total += len(parts[-1])
    joined = b"".join(parts)
    tree["buffers"] = [{"byteLength": len(joined)}]
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(joined), b"BIN\0") + joined
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the tree and the binary chunk of a GLB, which may be missing."""
    if content[:4] != b"glTF":
        raise ValueError(f"it starts with {content[:4]!r}")
    _, version, length = struct.unpack_from("<4sII", content)
    size, kind = struct.unpack_from("<I4s", content, 12)
    if version != 2 or kind != b"JSON" or 20 + size > len(content) or length > len(content):
        raise ValueError(f"version {version}, {length} bytes declared, {len(content)} found")
    tree = _tree(content[20 : 20 + size])
    binary = b""
    if len(content) >= 28 + size:
        count, _ = struct.unpack_from("<I4s", content, 20 + size)
        binary = content[28 + size : 28 + size + count]
    return tree, binary


def _tree(text: bytes) -> dict[str, Any]:
    tree = json.loads(text)
    if not isinstance(tree, dict):
        raise ValueError("its JSON is not an object")
    return tree


def _content(uri: str, folder: Path, what: str) -> bytes:
    """Return the content of a data URI, or of a file beside the model."""
    if uri.startswith(DATA_URI):
        header, _, text = uri.partition(",")
        try:
            return base64.b64decode(text, validate=True) if header.endswith(";base64") else unquote(text).encode()
        except binascii.Error as error:
            raise ValueError(f"a data URI cannot be decoded: {error}") from error
    data = _read_sibling(folder, unquote(uri))
    if data is None:
        raise BadInput(f"the {what} {uri[:80]!r} of the model is missing; put it beside the model, or export it as GLB")
    return data
