"""The Khronos validator finds nothing wrong with a GLB, whatever the settings."""

from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
import trimesh

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import write_frames_glb, write_glb, write_mesh_glb
from dg4d_lib.mesh.textured import TexturedMesh
from tests.clients.node import run_node

KNOWN_REMARKS = {  # what the validator says of extensions that it does not know, and of sizes that users choose
    "Cannot validate an extension as it is not supported by the validator: 'EXT_meshopt_compression'.",
    "Validation support for this extension is incomplete; the asset may have undetected issues.",
    "Image has non-power-of-two ",
}


def box() -> TexturedMesh:
    """With a side along every axis, and seams at every edge."""
    solid = trimesh.creation.box((0.4, 0.6, 0.8))
    vertices = torch.tensor(solid.triangles.reshape(-1, 3), dtype=torch.float32)
    generator = torch.Generator().manual_seed(0)
    uvs, texture = torch.rand(len(vertices), 2, generator=generator), torch.rand(8, 16, 3, generator=generator)
    return TexturedMesh(vertices, torch.arange(len(vertices)).reshape(-1, 3), uvs, texture)


def turning_box(frames: int = 4, textures: bool = False) -> Asset4D:
    mesh = box()
    angles = torch.arange(frames) / frames * 2 * torch.pi
    x, y, z = mesh.vertices.T
    poses = torch.stack([torch.stack((a.cos() * x + a.sin() * z, y, a.cos() * z - a.sin() * x), 1) for a in angles])
    changing = torch.rand(frames, 5, 7, 3, generator=torch.Generator().manual_seed(1)) if textures else None
    return Asset4D(mesh, poses - mesh.vertices, 12.0, {"name": "süßer Fuchs 🦊"}, changing)


def choices(name: str) -> tuple[Any, ...]:
    return get_args(GltfSettings.model_fields[name].annotation) or (False, True)


def combinations() -> list[GltfSettings]:
    names = ("image", "quantized", "meshopt", "interpolation", "moving_normals", "textures")
    return [
        GltfSettings(**dict(zip(names, values, strict=True))) for values in product(*(choices(name) for name in names))
    ]


WRITERS: dict[str, Callable[[GltfSettings], bytes]] = {
    "tracked": lambda settings: write_glb(turning_box(), settings),
    "changing textures": lambda settings: write_glb(turning_box(textures=True), settings),
    "per frame": lambda settings: write_frames_glb([box(), box()], 8.0, {}, settings),
    "still": lambda settings: write_mesh_glb(box(), settings),
    "one frame": lambda settings: write_glb(turning_box(1, textures=True), settings),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_nothing_is_wrong_with_any_combination_of_settings(kind: str, tmp_path: Path) -> None:
    settings = combinations()
    assert len(settings) == 96
    paths = [tmp_path / f"{number} ü 🦊.glb" for number in range(len(settings))]
    for path, wanted in zip(paths, settings, strict=True):
        path.write_bytes(WRITERS[kind](wanted))
    report = run_node("validate.mjs", *map(str, paths))
    assert (report["errors"], report["warnings"], report["hints"]) == (0, 0, 0)
    assert {message["message"].partition("dimensions: ")[0] for message in report["messages"]} <= KNOWN_REMARKS


def test_nothing_is_wrong_with_a_long_animation(tmp_path: Path) -> None:
    (tmp_path / "long.glb").write_bytes(write_glb(turning_box(1000)))
    report = run_node("validate.mjs", str(tmp_path / "long.glb"))
    assert (report["errors"], report["warnings"], report["infos"]) == (0, 0, 0)


def test_the_validator_would_notice_a_wrong_bound(tmp_path: Path) -> None:
    content = write_mesh_glb(replace(box(), vertices=box().vertices * 0.5 + 3.0))
    (tmp_path / "wrong.glb").write_bytes(content.replace(b'"max":[3.', b'"max":[4.', 1))
    assert run_node("validate.mjs", str(tmp_path / "wrong.glb"))["errors"] > 0
