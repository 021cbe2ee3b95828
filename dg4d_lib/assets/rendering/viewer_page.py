"""One self-contained page that plays an asset: the built template `viewer/page.html` with the data inside.

Data go in deflated, as base64. The mesh goes in without what the page does not show: normals, since it draws colors
without light, and the last eight of the 23 bits behind the point of a float, a few hundredths of a millimeter. The page
asks no network for anything, and its content policy forbids it to. Its sources are beside the template; `npm run build`
there makes it anew. Imports neither torch nor numpy.
"""

import base64
import html
import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

FLOAT = 5126  # of 32 bits, the type of an accessor

_TITLE, _DATA = "@title@", "@data@"


def build_viewer_page(
    title: str,
    glb: bytes,
    splats: bytes | None,
    picture: bytes | None,
    video: bytes | None,
    facts: Mapping[str, Any],
) -> str:
    """The page of one asset; equal arguments give equal text.

    Args:
        title: what people call the asset.
        glb: the animated mesh; its first animation plays. Read are morph targets, node animations, animated texture
            transforms (KHR_animation_pointer), KHR_mesh_quantization, EXT_meshopt_compression, PNG, JPEG and WebP.
        splats: what `write_web_splats` wrote; without them the page shows the mesh only.
        picture: the input as PNG, JPEG or WebP.
        video: the driving video as MP4; it follows the clock of the page.
        facts: provenance: nested mappings and lists of strings, numbers and None. Every entry becomes a section, the
            first one open.

    Raises:
        TypeError, ValueError: the facts are no JSON.
    """
    blocks = [
        _block(name, "application/octet-stream", base64.b64encode(zlib.compress(content)).decode())
        for name, content in (("glb", _lighter(glb)), ("splats", splats), ("picture", picture), ("video", video))
        if content is not None
    ]
    text = json.dumps(facts, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    blocks.append(_block("facts", "application/json", text.replace("<", r"\u003c")))
    before, data, after = _template().partition(_DATA)
    if not data:
        raise AssertionError("viewer/page.html has no place for data; build it again")
    return before.replace(_TITLE, html.escape(title)) + "\n".join(blocks) + after


def _lighter(glb: bytes) -> bytes:
    """The same mesh with zeros that deflate to nothing: for normals, and for the last byte of every float."""
    try:
        magic, length = struct.unpack_from("<4s8xI", glb)
        tree = json.loads(glb[20 : 20 + length]) if magic == b"glTF" else {}
    except (struct.error, ValueError):
        return glb  # no GLB: the page will say so
    content = bytearray(glb)
    for name, number in _columns(tree):
        accessor = tree["accessors"][number]
        view = tree["bufferViews"][accessor["bufferView"]]
        if accessor["componentType"] == FLOAT and not {"byteStride", "extensions"} & view.keys():
            start = 28 + length + view.get("byteOffset", 0)  # behind the headers of the file and of both chunks
            place = slice(start, start + view["byteLength"], 1 if name == "NORMAL" else 4)
            content[place] = bytes(len(content[place]))
    return bytes(content)


def _columns(tree: Mapping[str, Any]) -> Iterator[tuple[str, int]]:
    """What the vertices of a GLB have, at rest and in its morph targets: names and accessors."""
    for mesh in tree.get("meshes", ()):
        for primitive in mesh["primitives"]:
            for columns in (primitive["attributes"], *primitive.get("targets", ())):
                yield from columns.items()


@cache
def _template() -> str:
    return (files("dg4d_lib.assets") / "viewer" / "page.html").read_text(encoding="utf-8")


def _block(name: str, kind: str, content: str) -> str:
    """An element that browsers neither run nor show."""
    return f'<script type="{kind}" id="data-{name}">{content}</script>'
