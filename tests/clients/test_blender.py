"""Blender shows what we show; with a small asset, where Blender is installed."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import trimesh

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import write_frames_glb, write_glb, write_mesh_glb
from dg4d_lib.assets.formats.usd import write_usdz
from dg4d_lib.mesh.textured import TexturedMesh
from tests.clients.blender_check import LEAST_IOU, compare, home, installed

FPS = 7.0
LEAST_PSNR_DB = 40.0  # measured 52 and more; a texture upside down gives 15
FRAMES = 6


def bean(frame: int) -> TexturedMesh:
    """An egg that leans and grows, no side like another, with colors that name the places."""
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    directions = torch.tensor(sphere.vertices, dtype=torch.float32) / 0.3
    x, y, z = (directions * torch.tensor([0.45, 0.3, 0.2]) * (1 + frame / 20)).T
    vertices = torch.stack((x + 0.5 * (y - 0.1 * frame).square(), y + 0.3 * x, z + 0.2 * x * y), dim=-1)
    ramp = torch.linspace(0, 1, 64)
    texture = torch.stack((ramp.expand(64, 64), ramp[:, None].expand(64, 64), torch.full((64, 64), frame / 10)), dim=-1)
    return TexturedMesh(vertices, torch.tensor(sphere.faces).long(), directions[:, :2] / 2 + 0.5, texture)


def tracked(folder: Path) -> None:
    states = torch.stack([bean(frame).vertices for frame in range(FRAMES)])
    asset = Asset4D(bean(0), states - bean(0).vertices, FPS)
    (folder / "asset.glb").write_bytes(write_glb(asset))
    write_usdz(folder / "asset.usdz", asset, FPS)


def per_frame(folder: Path) -> None:
    meshes = [bean(frame) for frame in range(FRAMES)]
    (folder / "asset.glb").write_bytes(write_frames_glb(meshes, FPS))
    write_usdz(folder / "asset.usdz", meshes, FPS)
    (folder / "meshes").mkdir()
    for frame, mesh in enumerate(meshes):
        (folder / "meshes" / f"{frame:03d}.glb").write_bytes(write_mesh_glb(mesh))


@pytest.mark.slow
@pytest.mark.skipif(not installed(), reason=f"no Blender in {home()}; `python tests/clients/blender_check.py PACKAGE`")
@pytest.mark.parametrize("write", [tracked, per_frame])
def test_blender_shows_what_we_show(write: Callable[[Path], None], tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "asset.json").write_text(json.dumps({"fps": FPS}))
    shots = compare(tmp_path, tmp_path)
    assert len(shots) == 12
    assert min(shot.iou for shot in shots) >= LEAST_IOU
    assert min(shot.psnr_db for shot in shots) >= LEAST_PSNR_DB
