"""A package so small that it is packed in a second: nine Gaussians and a gem that slide along x for three frames."""

import zipfile
from pathlib import Path
from typing import Any

import torch
import trimesh

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.mesh.textured import TexturedMesh, TrackedMesh
from dg4d_lib.settings import FramewiseSettings
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import write_frames, write_png
from steps.artifacts.meshes import write_meshes, write_tracked
from steps.artifacts.motions import write_motion
from steps.pack_asset import run
from steps.profiles import PREVIEW, step_settings
from steps.runtime.job import Job

FRAMES, FPS, REACH = 3, 24.0, 0.4
BLUE = torch.tensor([0.2, 0.4, 0.8])
NOTE = "Made without a learned model."


def cloud() -> Gaussians:
    """A blue ball of radius 0.2 or so, and eight small ones around it."""
    corners = torch.cartesian_prod(*[torch.tensor([-0.15, 0.15])] * 3)
    means = torch.cat([torch.zeros(1, 3), corners])
    log_scales = torch.tensor([[0.1] * 3, *[[0.05] * 3] * 8]).log()
    quats = torch.tensor([1.0, 0, 0, 0]).expand(9, 4)
    return Gaussians(means, log_scales, quats, torch.full((9,), 4.0), rgb_to_sh(BLUE.expand(9, 3)))


def motion() -> Framewise:
    table = Framewise(FRAMES, 9)
    table.requires_grad_(False)
    table.table[:, :, 0] = torch.linspace(0, REACH, FRAMES)[:, None]
    return table


def gem(radius: float = 0.3) -> TexturedMesh:
    shape = trimesh.creation.icosphere(subdivisions=0, radius=radius)
    vertices = torch.tensor(shape.vertices, dtype=torch.float32)
    faces = torch.tensor(shape.faces, dtype=torch.int64)
    return TexturedMesh(
        vertices, faces, torch.full((len(vertices), 2), 0.5), BLUE.expand(8, 8, 3).mul(255).round() / 255
    )


def tracked(frames: int = FRAMES) -> Asset4D:
    mesh = gem()
    offsets = torch.zeros(frames, len(mesh.vertices), 3)
    offsets[..., 0] = torch.linspace(0, REACH, frames)[:, None]
    return Asset4D(mesh, offsets, FPS)


def extracted(frames: int = FRAMES) -> TrackedMesh:
    """The same as an artifact, which has no frame rate."""
    asset = tracked(frames)
    return TrackedMesh(asset.mesh, asset.offsets)


def inputs(folder: Path, mode: str = "tracked") -> dict[str, Path]:
    """Files as the steps before would have written them."""
    folder.mkdir(parents=True, exist_ok=True)
    names = {"subject": "s.png", "driving_video": "v.zip", "gaussians": "g.ply", "motion": "m.safetensors"}
    paths = {port: folder / name for port, name in names.items()}
    write_png(paths["subject"], torch.full((16, 16, 4), 0.5))
    write_frames(
        paths["driving_video"], DrivingVideo(BLUE.expand(FRAMES, 16, 16, 3), torch.ones(FRAMES, 16, 16, 1), FPS)
    )
    write_ply(paths["gaussians"], cloud())
    write_motion(paths["motion"], motion(), FramewiseSettings(), FRAMES, 9)
    if mode == "tracked":
        paths["tracked"] = folder / "t.safetensors"
        write_tracked(paths["tracked"], extracted())
    else:
        paths["meshes"] = folder / "meshes.zip"
        write_meshes(paths["meshes"], {frame: gem(0.2 + 0.1 * frame) for frame in range(FRAMES)})
    return paths


def job(given: dict[str, Path], out: Path, **wanted: Any) -> Job:
    out.mkdir(parents=True, exist_ok=True)
    pack = PackSettings(preview_size=64, preview_turns=1, sheet_size=32, sheet_frames=2, **wanted)
    settings = PREVIEW.model_copy(update={"rasterizer": "reference", "pack": pack})
    return Job(
        inputs=given,
        outputs={"package": out / "package.zip", "sheet": out / "sheet.png"},
        settings=step_settings("pack_asset", settings, notes=(NOTE,)),
        seed=0,
        progress=lambda done, total, values: None,
        pictures=out,
    )


def packed(folder: Path, mode: str = "tracked", **wanted: Any) -> Path:
    """An unpacked package, with these settings of what it holds."""
    given = job(inputs(folder / "inputs", mode), folder / "out", **wanted)
    run(given)
    with zipfile.ZipFile(given.outputs["package"]) as archive:
        archive.extractall(folder / "asset")
    return folder / "asset"
