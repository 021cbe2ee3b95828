"""Does Blender show what we show?

Imports a package's `asset.glb` and `asset.usdz` into Blender, renders moments of both with Cycles from the input's
camera and from another, and compares them with our own render of the GLB.

Usage: python tests/clients/blender_check.py PACKAGE [PICTURES]

Needs Python 3.11 and, the first time, a package index: Blender's module `bpy` (1 GB) is put into an environment of its
own, $DG4D_BLENDER or dg4d-blender in the folder for temporary files. PICTURES is a folder for what was rendered.
Prints a line per shot; the exit status is 1 where outlines agree less than LEAST_IOU.
"""

import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import read_glb, read_mesh_glb
from dg4d_lib.assets.placement import Placement
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh

BPY = "bpy==5.0.1"
PYTHON = (3, 11)  # bpy's wheel is for this version alone
LEAST_IOU = 0.95
SIZE, SAMPLES = 256, 16
CAMERAS = {"input": OrbitCamera(width=SIZE, height=SIZE), "side": OrbitCamera(20.0, 60.0, width=SIZE, height=SIZE)}
MOMENTS = (0.0, 1 / 3, 2 / 3)  # of the animation


@dataclass(frozen=True)
class Shot:
    """A picture by Blender against ours.

    Attributes:
        file: what Blender imported.
        camera: name of the viewpoint.
        frame: of the asset.
        iou: of the outlines.
        psnr_db: of the colors where both show the subject.
    """

    file: str
    camera: str
    frame: int
    iou: float
    psnr_db: float


def home() -> Path:
    """Where the environment with Blender is, or would be."""
    return Path(os.environ.get("DG4D_BLENDER", Path(tempfile.gettempdir()) / "dg4d-blender"))


def installed() -> bool:
    return (home() / "bin" / "python").exists() and any(home().glob("lib/python*/site-packages/bpy"))


def install() -> None:
    """Make the environment and put Blender into it."""
    if sys.version_info[:2] != PYTHON:
        raise SystemExit(f"{BPY} needs Python {'.'.join(map(str, PYTHON))}; this is {sys.version.split()[0]}")
    venv.create(home(), with_pip=True)
    subprocess.run([home() / "bin" / "python", "-m", "pip", "install", "--quiet", BPY], check=True)


def compare(package: Path, pictures: Path) -> list[Shot]:
    """Render every animated file of a package in Blender, and compare with our render of its GLB."""
    states, fps = _our_meshes(package)
    manifest = json.loads((package / "asset.json").read_text())
    placement = Placement(**manifest.get("placement", {}))
    shots = []
    for file in ("asset.glb", "asset.usdz"):
        if (package / file).exists():
            shots += _compare_file(package / file, states, fps, pictures, placement)
    return shots


def _our_meshes(package: Path) -> tuple[list[tuple[TexturedMesh, Any]], float]:
    """The mesh and its offsets at every frame, in the coordinates of the files, and frames per second."""
    fps = json.loads((package / "asset.json").read_text())["fps"]
    singles = sorted((package / "meshes").glob("*.glb"))
    if singles:
        return [(read_mesh_glb(path.read_bytes()), None) for path in singles], fps
    asset: Asset4D = read_glb((package / "asset.glb").read_bytes())
    return [(asset.mesh, offsets) for offsets in asset.offsets], asset.fps


def _compare_file(
    file: Path, states: Sequence[tuple[TexturedMesh, Any]], fps: float, pictures: Path, placement: Placement
) -> list[Shot]:
    """Compare one file; a USDZ plays in a scene of 24 frames per second, a GLB in one of its own rate."""
    rate = 24.0 if file.suffix == ".usdz" else fps
    wanted = [
        (
            name,
            camera,
            int(moment * len(states)),
            pictures / f"{file.suffix[1:]}_{name}_{int(moment * len(states)):03d}.png",
        )
        for name, camera in CAMERAS.items()
        for moment in MOMENTS
    ]
    job = {
        "file": str(file.resolve()),
        "fps": rate,
        "size": SIZE,
        "samples": SAMPLES,
        "shots": [
            {
                "frame": frame * rate / fps,
                "camera_to_world": _camera_to_world(camera, placement),
                "fov_y_deg": camera.fov_y_deg,
                "picture": str(picture.resolve()),
            }
            for _, camera, frame, picture in wanted
        ],
    }
    with tempfile.TemporaryDirectory() as scratch:
        description = Path(scratch) / "job.json"
        description.write_text(json.dumps(job))
        script = Path(__file__).with_name("blender.py")
        subprocess.run([home() / "bin" / "python", script, description], check=True, stdout=subprocess.DEVNULL)
    shots = []
    for name, camera, frame, picture in wanted:
        mesh, offsets = states[frame]
        moved = mesh.vertices if offsets is None else mesh.vertices + offsets
        placed = replace(mesh, vertices=placement.inverse.points(moved))
        color, coverage = render_mesh(placed, [camera], None)
        ours = torch.cat((color, coverage), -1)[0].numpy()
        theirs = np.asarray(Image.open(picture)).astype(np.float32) / 255
        shots.append(Shot(file.name, name, frame, *_agreement(ours, theirs)))
        Image.fromarray((np.hstack((ours, theirs)) * 255).round().astype(np.uint8)).save(picture)
    return shots


def _camera_to_world(camera: OrbitCamera, placement: Placement) -> list[list[float]]:
    """Of a camera that looks along its -z with +y up, in the coordinates of the files."""
    matrix = torch.linalg.inv(camera.viewmat()) @ torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
    matrix[:3, 3] = placement.points(matrix[:3, 3])
    return matrix.tolist()


def _agreement(ours: NDArray[Any], theirs: NDArray[Any]) -> tuple[float, float]:
    """Intersection over union of the outlines, and PSNR of the colors inside both."""
    inside = [picture[..., 3] > 0.5 for picture in (ours, theirs)]
    both = inside[0] & inside[1]
    iou = both.sum() / max(1, (inside[0] | inside[1]).sum())
    error = np.square(ours[both, :3] - theirs[both, :3]).mean() if both.any() else 1.0
    return float(iou), float(-10 * np.log10(max(error, 1e-12)))


def main(arguments: Sequence[str]) -> int:
    """Compare, and say how it went."""
    package = Path(arguments[0])
    pictures = Path(arguments[1]) if len(arguments) > 1 else Path(tempfile.mkdtemp(prefix="dg4d-blender-pictures-"))
    pictures.mkdir(parents=True, exist_ok=True)
    if not installed():
        install()
    shots = compare(package, pictures)
    for shot in shots:
        numbers = f"IoU {shot.iou:.4f}  PSNR {shot.psnr_db:.1f} dB"
        sys.stdout.write(f"{shot.file:12} {shot.camera:6} frame {shot.frame:3}  {numbers}\n")
    sys.stdout.write(f"pictures, ours left and Blender's right: {pictures}\n")
    return int(not shots or min(shot.iou for shot in shots) < LEAST_IOU)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        raise SystemExit(__doc__)
    raise SystemExit(main(sys.argv[1:]))
