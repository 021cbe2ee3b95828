"""Admission of users' models to the store: the file, and the files that it refers to, as one zip."""

import itertools
import json
import os.path
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from dg4d_lib.assets.formats.mtl import library_names, read_mtl
from dg4d_lib.errors import BadInput
from flows.inputs import json_text
from flows.inputs.sources import LARGEST_FILE_BYTES, put_zip, resolve_inside
from steps.catalog import ASSET
from steps.contract import ArtifactRef
from steps.sources.media_types import MODEL_SUFFIXES
from steps.store.artifact_store import ArtifactStore

MAGIC = {".glb": (b"glTF",), ".usdz": (b"PK",), ".ply": (b"ply",), ".spz": (b"\x1f\x8b", b"NGSP")}
MOST_REFERENCES = 256  # files that a model may refer to
LARGEST_TEXT_BYTES = 256 * 2**20  # of a glTF or MTL, which is searched for references
PLY_HEADER_BYTES = 65536
_PLY_TEXTURE = re.compile(r"^comment TextureFile\s+(.+?)\s*$", re.MULTILINE)
_PLY_FACES = re.compile(r"^element face 0*[1-9]", re.MULTILINE)
_MATERIALS = re.compile(r"^\s*mtllib\s+(.+?)\s*$", re.MULTILINE)


def check_model(path: Path) -> None:
    """Refuse files that are not a model, by name and first bytes.

    Raises:
        BadInput: says what the file is and what to give.
    """
    allowed = ", ".join(MODEL_SUFFIXES)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "does not exist"
        raise BadInput(f"--asset: {path} {what}; give a file with one of {allowed}")
    suffix, size = path.suffix.lower(), path.stat().st_size
    if suffix not in MODEL_SUFFIXES:
        raise BadInput(
            f"--asset: {path} has an unsupported format; give one of {allowed}: export the model as GLB, or splats "
            "as PLY"
        )
    if not 0 < size <= LARGEST_FILE_BYTES:
        raise BadInput(f"--asset: {path} has {size} bytes; 1 to {LARGEST_FILE_BYTES} are read")
    with path.open("rb") as file:
        beginning = file.read(8)
    if not beginning.startswith(MAGIC.get(suffix, (b"",))):
        raise BadInput(f"--asset: {path} does not start as a {suffix} file does ({beginning!r}); export it again")


def put_model(path: Path, store: ArtifactStore) -> ArtifactRef:
    """Store a model as a zip of `model.SUFFIX` and of the files that it refers to, which lie in or below its folder.

    Files that are missing are left out: the reader of the model says which it needs.

    Raises:
        BadInput: the model cannot be read, or refers to files outside of its folder.
        DiskFull: the disk is full.
    """
    check_model(path)
    suffix = path.suffix.lower()
    files = {f"model{suffix}": path}
    for name in dict.fromkeys(itertools.islice(_references(path, suffix), MOST_REFERENCES)):
        cleaned = name.replace("\\", "/").removeprefix("./")
        file = resolve_inside(path.parent, cleaned, "the file of the model")
        if os.path.isfile(file):  # noqa: PTH113 (Path.is_file raises OSError if the name is too long)
            files.setdefault(cleaned, file)
    size = sum(file.stat().st_size for file in files.values())
    if size > LARGEST_FILE_BYTES:
        raise BadInput(f"--asset: the files of {path} have {size} bytes; at most {LARGEST_FILE_BYTES} are read")
    return put_zip(files, ASSET.media_type, store)


def holds_splats(path: Path) -> bool:
    """Return true for splats, false for a mesh: of PLY files, those that declare no faces are splats."""
    suffix = path.suffix.lower()
    return suffix == ".spz" or (suffix == ".ply" and not _PLY_FACES.search(_ply_header(path)))


def _references(path: Path, suffix: str) -> Iterator[str]:
    """List the files that a glTF, an OBJ or a PLY refers to."""
    if suffix == ".gltf":
        yield from _uris(_parsed(path))
    elif suffix == ".obj":
        for name in itertools.chain.from_iterable(map(library_names, _MATERIALS.findall(_text(path)))):
            yield name
            materials = path.parent / name
            if os.path.isfile(materials):  # noqa: PTH113 (any length of the name)
                resolve_inside(path.parent, name, "the file of the model")
                yield from _textures(materials)
    elif suffix == ".ply":
        yield from _PLY_TEXTURE.findall(_ply_header(path))


def _ply_header(path: Path) -> str:
    with path.open("rb") as file:
        return file.read(PLY_HEADER_BYTES).decode("utf-8", "replace")


def _textures(file: Path) -> Iterator[str]:
    try:
        for material in read_mtl(_text(file)).values():
            yield from material.textures
    except ValueError as error:
        raise BadInput(f"--asset: {file} is not an MTL file: {error}; export the model again") from error


def _uris(tree: Any) -> Iterator[str]:
    for collection in ("buffers", "images"):
        items = tree.get(collection) if isinstance(tree, dict) else None
        for item in items if isinstance(items, list) else ():
            uri = item.get("uri") if isinstance(item, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:"):
                yield unquote(uri)


def _parsed(path: Path) -> Any:
    try:
        return json_text.loads(_text(path))
    except (json_text.UnfitJSON, json.JSONDecodeError, ValueError) as error:
        raise BadInput(f"--asset: {path} is not a glTF file: {error}; export it again") from error


def _text(path: Path) -> str:
    if path.stat().st_size > LARGEST_TEXT_BYTES:
        raise BadInput(f"--asset: {path} has more than {LARGEST_TEXT_BYTES} bytes of text; export it as GLB")
    return path.read_bytes().decode("utf-8-sig", "replace")
