"""Self-contained HTML viewer of an asset: the built template `viewer/page.html` with embedded data.

Data is deflated and base64-encoded. Parts of the mesh that the page does not show are set to zero: normals, since the
viewer is unlit, and the lowest 8 of the 23 mantissa bits of floats, a few hundredths of a millimeter. The page loads
nothing from the network, and its content security policy forbids it. Its sources are beside the template; run
`npm run build` there to rebuild it. This module imports neither torch nor numpy.
"""

import base64
import html
import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

FLOAT = 5126  # glTF component type of float32

_TITLE, _DATA = "@title@", "@data@"


def build_viewer_page(
    title: str,
    glb: bytes | None,
    splats: bytes | None,
    picture: bytes | None,
    video: bytes | None,
    facts: Mapping[str, Any],
    camera: Mapping[str, Any] = MappingProxyType({}),
) -> str:
    """Build the page of one asset; equal arguments give equal text.

    Args:
        title: title of the page.
        glb: the animated mesh; its first animation plays; without it the page shows the splats only. Supported are
            morph targets, node animations, animated texture transforms (KHR_animation_pointer), KHR_mesh_quantization,
            EXT_meshopt_compression, PNG, JPEG and WebP.
        splats: output of `write_web_splats`; without it the page shows the mesh only.
        picture: the input picture as PNG, JPEG or WebP.
        video: the driving video as MP4, played in sync with the asset.
        facts: provenance as nested mappings and lists of strings, numbers and None. Every entry becomes a section; the
            first one is expanded.
        camera: `radius` and `target` of the input camera, and `whole_fov_y_deg`, as in `asset.json`; 2, the origin and
            the field of view of the input if missing.

    Raises:
        TypeError, ValueError: the facts cannot be represented as JSON.
    """
    blocks = [
        _block(name, "application/octet-stream", base64.b64encode(zlib.compress(content)).decode())
        for name, content in (
            ("glb", glb and _zero_unused(glb)),
            ("splats", splats),
            ("picture", picture),
            ("video", video),
        )
        if content is not None
    ]
    view = {name: camera[name] for name in ("radius", "target", "whole_fov_y_deg") if camera.get(name) is not None}
    for name, values in (("facts", facts), ("camera", view)):
        text = json.dumps(values, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
        blocks.append(_block(name, "application/json", text.replace("<", r"\u003c")))
    before, data, after = _template().partition(_DATA)
    if not data:
        raise AssertionError(f"viewer/page.html lacks the placeholder {_DATA}; run `npm run build` in viewer/")
    return before.replace(_TITLE, html.escape(title)) + "\n".join(blocks) + after


def _zero_unused(glb: bytes) -> bytes:
    """Set normals and the lowest byte of every float to zero, so that the file compresses better."""
    try:
        magic, length = struct.unpack_from("<4s8xI", glb)
        tree = json.loads(glb[20 : 20 + length]) if magic == b"glTF" else {}
    except (struct.error, ValueError):
        return glb  # not a GLB; the page shows an error
    content = bytearray(glb)
    for name, number in _vertex_accessors(tree):
        accessor = tree["accessors"][number]
        view = tree["bufferViews"][accessor["bufferView"]]
        if accessor["componentType"] == FLOAT and not {"byteStride", "extensions"} & view.keys():
            start = 28 + length + view.get("byteOffset", 0)  # after the headers of the file and of both chunks
            unused = slice(start, start + view["byteLength"], 1 if name == "NORMAL" else 4)
            content[unused] = bytes(len(content[unused]))
    return bytes(content)


def _vertex_accessors(tree: Mapping[str, Any]) -> Iterator[tuple[str, int]]:
    """Yield names and accessors of all vertex attributes and morph targets."""
    for mesh in tree.get("meshes", ()):
        for primitive in mesh["primitives"]:
            for columns in (primitive["attributes"], *primitive.get("targets", ())):
                yield from columns.items()


@cache
def _template() -> str:
    return (files("dg4d_lib.assets") / "viewer" / "page.html").read_text(encoding="utf-8")


def _block(name: str, kind: str, content: str) -> str:
    """Return a data element, which browsers neither run nor show."""
    return f'<script type="{kind}" id="data-{name}">{content}</script>'
