"""Pictures of the documentation: an animated WebP of a package, and a screenshot of its run in the Prefect UI.

    dg4d make examples/newt.png -o out/demo
    python docs/make_pictures.py out/demo [--screenshot]

The screenshot needs the server of that run, Node.js and Chromium; with --screenshot nothing else is made.
"""

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from dg4d_lib.cameras.orbit import FOV_Y_DEG, OrbitCamera
from dg4d_lib.images import over_white
from dg4d_lib.mesh.render import LitRenderer
from dg4d_lib.rasterizer.interface import get_rasterizer
from flows.convert import connect
from flows.serving import background
from steps.artifacts.packages import read_manifest
from steps.artifacts.rendering import mesh_at, read_states, read_surface

IMAGES = Path(__file__).parent / "images"
SIZE = 256  # pixels of a panel: input picture, lit mesh, splats
FPS, SWAY_DEG, LOOPS = 12, 35.0, 2
QUALITY = 72


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the animation of a package, then the screenshot."""
    parser = argparse.ArgumentParser(prog="python docs/make_pictures.py", description=main.__doc__)
    parser.add_argument("package", type=Path, help="folder of an asset whose run the background server knows")
    parser.add_argument("--screenshot", action="store_true", help="the screenshot only")
    options = parser.parse_args(arguments)
    IMAGES.mkdir(exist_ok=True)
    if not options.screenshot:
        write_animation(options.package, IMAGES / "demo.webp")
    write_screenshot(options.package, IMAGES / "prefect.png")


def write_animation(package: Path, path: Path) -> None:
    """Write input picture, lit mesh and splats side by side while the camera sways."""
    manifest = read_manifest(package)
    states, surface = read_states(package, manifest), read_surface(package, manifest)
    draw = get_rasterizer("auto")
    renderer = LitRenderer()
    fov_y_deg = manifest.camera.whole_fov_y_deg or FOV_Y_DEG
    subject = _subject(package, math.tan(math.radians(FOV_Y_DEG / 2)) / math.tan(math.radians(fov_y_deg / 2)))
    count = round(LOOPS * manifest.frames / manifest.fps * FPS)
    pictures = []
    for k in range(count):
        position = torch.tensor([k * LOOPS * manifest.frames / count % manifest.frames], dtype=torch.float64)
        sway_deg = SWAY_DEG * math.sin(2 * math.pi * k / count)
        camera = OrbitCamera(8.0, sway_deg, fov_y_deg=fov_y_deg, width=SIZE, height=SIZE)
        splats = draw(states(position), [camera], torch.ones(3)).color[0]
        mesh = over_white(torch.cat(renderer.render(mesh_at(surface, position[0]), camera), -1))
        panels = [np.asarray(subject), _bytes(mesh), _bytes(splats)]
        pictures.append(Image.fromarray(np.concatenate(panels, axis=1)))
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=round(1000 / FPS), loop=0, quality=QUALITY, method=6
    )


def write_screenshot(package: Path, path: Path) -> None:
    """Photograph the page of the flow run that made a package."""
    server = background.background_server()
    if (address := server.address()) is None:
        sys.exit("the server of the run has ended; start it with `dg4d up --no-worker` and run this again")
    connect()
    from prefect import get_client
    from prefect.client.schemas.sorting import FlowRunSort

    item = json.loads((package / "provenance.json").read_text(encoding="utf-8"))["item"]
    with get_client(sync_client=True) as client:
        runs = client.read_flow_runs(sort=FlowRunSort.START_TIME_DESC, limit=50)
    run = next(one for one in runs if one.state_type == "COMPLETED" and item in one.name)
    script = Path(__file__).with_name("photograph.mjs")
    wanted = {
        "login": server.login_address(address),
        "address": f"/v2/runs/flow-run/{run.id}",
        "text": run.name,
        "tab": "Task Runs",
        "screenshot": str(path),
    }
    subprocess.run(["node", str(script), json.dumps(wanted)], check=True)


def _subject(package: Path, scale: float) -> Image.Image:
    """Return the cut-out of the input, its frame at a share of the panel's side, on white."""
    side = round(scale * SIZE)
    panel = Image.new("RGB", (SIZE, SIZE), "white")
    cutout = Image.open(package / "input" / "subject.png").resize((side, side), Image.Resampling.LANCZOS)
    panel.paste(_over_white(cutout), ((SIZE - side) // 2, (SIZE - side) // 2))
    return panel


def _over_white(picture: Image.Image) -> Image.Image:
    return Image.alpha_composite(Image.new("RGBA", picture.size, "white"), picture.convert("RGBA")).convert("RGB")


def _bytes(picture: Float[Tensor, "h w 3"]) -> np.ndarray:
    return (picture.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


if __name__ == "__main__":
    main()
