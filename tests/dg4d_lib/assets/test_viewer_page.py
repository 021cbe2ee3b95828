"""Viewer page: embedded data can be read back, and nothing else is active."""

import base64
import json
import re
import subprocess
import sys
import zlib
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import write_glb
from dg4d_lib.assets.formats.gltf import GlbReader
from dg4d_lib.assets.rendering.viewer_page import build_viewer_page
from dg4d_lib.mesh.textured import TexturedMesh

NASTY = "</script><script>alert(1)</script><!-- @data@ @title@ & \"ümlaut\" 'π'"
GLB = bytes(range(256))


class Blocks(HTMLParser):
    """Title, heading, and the scripts of a page by id, as a browser cuts them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.scripts: dict[str | None, str] = {}
        self.texts: dict[str, str] = {}
        self.open: list[tuple[str, str | None]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append((tag, dict(attrs).get("id")))

    def handle_data(self, data: str) -> None:
        tag, name = self.open[-1] if self.open else ("", None)
        if tag == "script":
            self.scripts[name] = self.scripts.get(name, "") + data
        elif tag in ("title", "h1"):
            self.texts[tag] = self.texts.get(tag, "") + data

    def handle_endtag(self, tag: str) -> None:
        while self.open and self.open.pop()[0] != tag:
            pass


def page(title: str = "Fox", facts: dict[str, Any] | None = None) -> str:
    return build_viewer_page(title, GLB, b"splats", None, b"film", facts or {})


def test_the_data_can_be_read_out_again() -> None:
    scripts = Blocks(page()).scripts
    assert set(scripts) == {"data-glb", "data-splats", "data-video", "data-facts", "data-camera", None}
    for name, given in (("glb", GLB), ("splats", b"splats"), ("video", b"film")):
        assert zlib.decompress(base64.b64decode(scripts[f"data-{name}"])) == given


def moving_ball(settings: GltfSettings) -> bytes:
    """A GLB of a ball that changes its size."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    vertices = torch.tensor(ball.vertices, dtype=torch.float32)
    mesh = TexturedMesh(vertices, torch.tensor(ball.faces), vertices[:, :2] / 2 + 0.5, torch.rand(4, 4, 3))
    return write_glb(Asset4D(mesh, vertices * torch.linspace(0, 0.3, 5)[:, None, None], 7.0), settings)


def mesh_in(text: str) -> bytes:
    return zlib.decompress(base64.b64decode(Blocks(text).scripts["data-glb"]))


def test_the_mesh_of_a_page_has_the_bits_that_are_seen() -> None:
    content = moving_ball(GltfSettings(quantized=False))
    text = build_viewer_page("Ball", content, None, None, None, {})
    given, seen = GlbReader(content), GlbReader(mesh_in(text))
    assert seen.tree == given.tree
    kinds = {"positions": 2**-15, "coordinates": 2**-15, "normals": None}
    for number, accessor in enumerate(given.tree["accessors"]):
        error = kinds.get(accessor["name"].split()[-1], 0.0)
        wanted = np.zeros(3) if error is None else given.accessor(number)
        np.testing.assert_allclose(
            seen.accessor(number), np.broadcast_to(wanted, seen.accessor(number).shape), error or 0
        )
    picture = given.tree["images"][0]["bufferView"]
    assert seen.view(picture) == given.view(picture)
    empty = len(build_viewer_page("Ball", b"", None, None, None, {}))
    assert len(text) - empty < 0.6 * len(content)


def test_whole_numbers_of_a_mesh_go_into_a_page_as_they_are() -> None:
    content = moving_ball(GltfSettings(quantized=True))
    given, seen = GlbReader(content), GlbReader(mesh_in(build_viewer_page("Ball", content, None, None, None, {})))
    assert seen.tree == given.tree
    whole = [n for n, accessor in enumerate(given.tree["accessors"]) if accessor["componentType"] != 5126]  # FLOAT
    assert len(whole) > 4
    for number in whole:
        np.testing.assert_array_equal(seen.accessor(number), given.accessor(number))


def test_text_stays_text() -> None:
    facts = {NASTY: [1, None, {"deep": NASTY}]}
    read = Blocks(page(NASTY, facts))
    assert json.loads(read.scripts["data-facts"]) == facts
    assert read.texts == {"title": NASTY, "h1": NASTY}
    assert set(read.scripts) == {"data-glb", "data-splats", "data-video", "data-facts", "data-camera", None}
    assert read.scripts[None] == Blocks(page()).scripts[None]


def test_equal_arguments_give_equal_pages() -> None:
    assert page("Fox", {"a": 1}) == page("Fox", {"a": 1}) != page("Fox", {"a": 2})


def test_facts_that_are_no_json_are_refused() -> None:
    with pytest.raises(ValueError, match="JSON"):
        page(facts={"loss": float("nan")})


def test_the_policy_of_the_page_lets_nothing_in_from_outside() -> None:
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page())
    assert policy is not None
    rules = {rule.split()[0]: set(rule.split()[1:]) for rule in policy[1].split(";")}
    assert rules.pop("default-src") == {"'none'"}
    inside = {"blob:", "data:", "'unsafe-inline'", "'wasm-unsafe-eval'"}
    assert set.union(*rules.values()) <= inside


def test_the_licenses_of_what_is_bundled_are_in_the_page() -> None:
    text = page()
    for words in ("three.js authors", "Arseny Kapoulkine", "The above copyright notice and this permission notice"):
        assert words in text


def test_making_a_page_loads_no_tensors() -> None:
    code = "import dg4d_lib.assets.rendering.viewer_page, sys; sys.exit(bool({'torch', 'numpy'} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
