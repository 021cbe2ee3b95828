"""One self-contained page that plays an asset: the built template `viewer/page.html` with the data inside.

The page asks no network for anything, and its content policy forbids it to. Its sources are beside the template;
`npm run build` there makes it anew. Imports neither torch nor numpy.
"""

import base64
import html
import json
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

_TITLE, _DATA = "@title@", "@data@"


def viewer_page(
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
        _block(name, "application/octet-stream", base64.b64encode(content).decode())
        for name, content in (("glb", glb), ("splats", splats), ("picture", picture), ("video", video))
        if content is not None
    ]
    text = json.dumps(facts, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    blocks.append(_block("facts", "application/json", text.replace("<", r"\u003c")))
    before, data, after = _template().partition(_DATA)
    if not data:
        raise AssertionError("viewer/page.html has no place for data; build it again")
    return before.replace(_TITLE, html.escape(title)) + "\n".join(blocks) + after


@cache
def _template() -> str:
    return (files("dg4d_lib.assets") / "viewer" / "page.html").read_text(encoding="utf-8")


def _block(name: str, kind: str, content: str) -> str:
    """An element that browsers neither run nor show."""
    return f'<script type="{kind}" id="data-{name}">{content}</script>'
