"""Pictures of docs/inputs.md: one animal by every way of input, and the files that its commands name.

    python -m docs.make_inputs [--only views asset] [--files]

The files go to out/inputs, the pictures to docs/images. With --files, only the files are written, in a minute or two.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from benchmarks.backdrops import procedural
from benchmarks.inputs import known_bank
from benchmarks.objects.drawing import Painted
from benchmarks.own_asset import OwnModel, animate, render_model
from benchmarks.true_views import Subject, fit
from dg4d_lib.assets.formats.model_glb import write_model_glb
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import over_white, resize
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.subject import prepare_subject
from examples.newt import Newt
from flows.inputs.given_views import ViewFile, ViewsRequest
from steps.artifacts.media import write_png
from steps.fitting.priors import subject_shapes
from steps.profiles import PREVIEW, revise
from steps.sources.depth import read_depth, read_layers
from steps.sources.reader import read_source
from steps.store.artifact_store import ArtifactStore

ROOT = Path(__file__).parents[1]
FILES, IMAGES = ROOT / "out" / "inputs", ROOT / "docs" / "images"
FRAMES, SIZE = 16, 256
TURNTABLE = 24  # frames
VIEWS_DEG = (90, 180, 270)
CAMERAS_DEG = ((60, 20), (170, -10), (280, 30))  # azimuth, elevation
SHOWN_DEG = (45.0, 135.0, 225.0)  # azimuths of the sheets, which no way is given
SHOWN_FRAMES = (0, 4, 8, 12)
TURN_DEG = 20.0  # of the newt, whose head is nearer
TILE = 96  # pixels
QUALITY = 80  # of WebP
Tile = Float[Tensor, "s s 3"]
Way = tuple[list[Tile], Callable[[], Tensor]]  # what was given, and the fit that returns the rows of renders


def main() -> None:
    """Write the files and the pictures of all ways, or of some."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=(*WAYS, *ROWS), default=(*WAYS, *ROWS))
    parser.add_argument("--files", action="store_true", help="write the files, without a fit or a picture")
    given = parser.parse_args()
    painted = Painted(Newt())
    FILES.mkdir(parents=True, exist_ok=True)
    for name in given.only:
        if name in ROWS:
            picture = ROWS[name](painted)
        else:
            shown, fitted = WAYS[name](painted)
            if given.files:
                continue
            picture = torch.cat([row(shown), fitted()])
        if not given.files:
            save(name, picture)


def photograph(painted: Painted, frame: int, azimuth: float = 0.0, elevation: float = 0.0) -> Float[Tensor, "s s 4"]:
    """Draw the animal as a cut-out."""
    return painted.draw(frame / FRAMES, [OrbitCamera(elevation, azimuth, width=SIZE, height=SIZE)])[0]


def subject_of(painted: Painted) -> Subject:
    """Draw the video that all ways share."""
    return Subject("newt", torch.stack([photograph(painted, frame) for frame in range(FRAMES)]))


def video_alone(painted: Painted) -> Way:
    """Fit the video without anything else."""
    subject = subject_of(painted)
    return [tile(subject.footage[frame]) for frame in SHOWN_FRAMES], lambda: sheet_of(fit(subject, PREVIEW))


def views(painted: Painted) -> Way:
    """Fit the video and pictures of three other sides."""
    files = []
    for azimuth in VIEWS_DEG:
        write_png(FILES / f"newt_{azimuth:03d}.png", photograph(painted, 0, azimuth))
        files.append(ViewFile(azimuth=azimuth, path=FILES / f"newt_{azimuth:03d}.png"))
    shown = [tile(photograph(painted, 0, azimuth)) for azimuth in (0, *VIEWS_DEG)]
    return shown, partial(with_sides, painted, ViewsRequest(views=tuple(files)))


def turntable(painted: Painted) -> Way:
    """Fit the video and a turntable of its first frame."""
    folder = FILES / "turntable"
    folder.mkdir(exist_ok=True)
    turned = [photograph(painted, 0, 360 * frame / TURNTABLE) for frame in range(TURNTABLE)]
    for frame, picture in enumerate(turned):
        write_png(folder / f"{frame:03d}.png", picture)
    shown = [tile(picture) for picture in turned[:: TURNTABLE // 4]]
    return shown, partial(with_sides, painted, ViewsRequest(turntable=folder))


def cameras(painted: Painted) -> Way:
    """Fit the video and pictures from measured cameras."""
    frames, shown = [], []
    for number, (azimuth, elevation) in enumerate([(0, 0), *CAMERAS_DEG]):
        write_png(FILES / f"camera_{number}.png", photograph(painted, 0, azimuth, elevation))
        shown.append(tile(photograph(painted, 0, azimuth, elevation)))
        pose = torch.linalg.inv(OrbitCamera(elevation, azimuth).viewmat())
        pose[:, 1:3] *= -1  # from OpenCV's axes to OpenGL's
        frames.append({"file_path": f"camera_{number}.png", "transform_matrix": pose.tolist()})
    angle = float(2 * np.arctan(OrbitCamera().tan_half_fov[0]))
    (FILES / "transforms.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}, indent=1))
    return shown, partial(with_sides, painted, ViewsRequest(cameras=FILES / "transforms.json"))


def asset(painted: Painted) -> Way:
    """Set a mesh of the animal in motion as the video shows it."""
    vertices, colors = painted.vertices(0.0), np.power(painted.colors.numpy(), 2.2)
    model = Model((ModelPart("newt", vertices.numpy(), painted.faces.numpy(), colors=colors),))
    (FILES / "newt.glb").write_bytes(write_model_glb(model))
    own = OwnModel(subject_of(painted), model, vertices[None], painted.faces, torch.ones(len(painted.faces)))
    shown = [tile(photograph(painted, 0, azimuth, 20)) for azimuth in (30, 120, 210, 300)]

    def sheet() -> Tensor:
        moved = animate(own, PREVIEW.asset)[0][torch.tensor(SHOWN_FRAMES)]
        cameras = [OrbitCamera(0, azimuth, width=SIZE, height=SIZE) for azimuth in SHOWN_DEG]
        return torch.cat([row([tile(one) for one in render_model(model, moved, camera)]) for camera in cameras])

    return shown, sheet


def truth(painted: Painted) -> Way:
    """Draw the animal itself."""
    drawn = [[tile(photograph(painted, frame, azimuth)) for frame in SHOWN_FRAMES] for azimuth in SHOWN_DEG]
    shown = [tile(photograph(painted, frame)) for frame in SHOWN_FRAMES]
    return shown, lambda: torch.cat([row(tiles) for tiles in drawn])


WAYS: dict[str, Callable[[Painted], Way]] = {
    "video": video_alone,
    "views": views,
    "turntable": turntable,
    "cameras": cameras,
    "asset": asset,
    "truth": truth,
}


def with_sides(painted: Painted, request: ViewsRequest) -> Tensor:
    """Fit the video and views beside it; return the sheet."""
    subject = subject_of(painted)
    request.check(None)
    with TemporaryDirectory() as folder:
        store = ArtifactStore(Path(folder))
        stored = request.put(store, None)
        assert stored is not None, "the request has views"
        sides = known_bank(subject, store.path(stored), PREVIEW)
    return sheet_of(fit(subject, PREVIEW, sides=sides))


def cutout_row(painted: Painted) -> Tensor:
    """Show the animal before a busy backdrop, its mask, and the cut-outs without and with the mask."""
    animal = photograph(painted, 0)
    backdrop = torch.from_numpy(procedural(SIZE)["colored clouds"]).float().clamp(0, 1)
    color = animal[..., :3] * animal[..., 3:] + backdrop * (1 - animal[..., 3:])
    opaque, mask = torch.cat([color, torch.ones_like(color[..., :1])], -1), animal[..., 3]
    write_png(FILES / "newt_outside.png", color)
    write_png(FILES / "newt_mask.png", mask[..., None].expand(-1, -1, 3).contiguous())
    settings = revise(PREVIEW, {"subject.framing": "keep"}).subject
    found = [prepare_subject(opaque[None], False, settings, given).frames[0] for given in (None, mask[None])]
    shown = [opaque, torch.cat([mask[..., None].expand(-1, -1, 3), torch.ones_like(mask[..., None])], -1), *found]
    return row([tile(picture) for picture in shown])


def depth_rows(painted: Painted) -> Tensor:
    """Show the guessed surface without a hint, with a turn, layers and a depth picture, and the animal itself."""
    animal = photograph(painted, 0)
    write_png(FILES / "newt.png", animal)
    cameras = [OrbitCamera(0, azimuth, width=SIZE, height=SIZE) for azimuth in (0.0, *SHOWN_DEG)]
    shown = rasterize_mesh(painted.vertices(0.0), painted.faces, cameras[:1])
    inside, distance = shown.faces[0] >= 0, shown.depth[0]
    near, far = float(distance[inside].min()), float(distance[inside].max())
    share = torch.where(inside, (1 / distance.clamp(min=near) - 1 / far) / (1 / near - 1 / far), 0.0).clamp(0, 1)
    Image.fromarray((65535 * share).round().to(torch.int32).numpy().astype(np.uint16)).save(FILES / "newt_depth.png")
    low, high = share[inside].quantile(torch.tensor([1 / 3, 2 / 3])).tolist()
    levels = torch.where(inside, 0.5 * ((share > low).float() + (share > high)), 0.5)[..., None].expand(-1, -1, 3)
    write_png(FILES / "newt_layers.png", torch.cat([levels, inside[..., None].float()], -1))
    given = {name: read_picture(FILES / f"newt_{name}.png", animal) for name in ("layers", "depth")}
    blank = torch.ones(SIZE, SIZE, 3)
    drawn = [(animal, DepthHint()), (blank, DepthHint(TURN_DEG)), *given.values()]
    rows = []
    for picture, hint in drawn:
        color, alpha = render_surface(subject_shapes(PREVIEW.prior, [animal], hint).surface(0), cameras[1:])
        rows.append([picture, *(color * alpha + 1 - alpha)])
    rows.append([blank, *painted.draw(0.0, cameras[1:])])
    return torch.cat([row([tile(picture) for picture in pictures]) for pictures in rows])


ROWS: dict[str, Callable[[Painted], Tensor]] = {"cutout": cutout_row, "depth": depth_rows}  # pictures without a fit


def read_picture(path: Path, animal: Float[Tensor, "s s 4"]) -> tuple[Tensor, DepthHint]:
    """Return a picture of the animal's depth, and what it says, read as the pipeline reads it."""
    with TemporaryDirectory() as folder:
        source = read_source(FILES / "newt.png", Path(folder), 2)
        settings = revise(PREVIEW, {"subject.framing": "keep"}).subject
        prepared = prepare_subject(animal[None], True, settings)
        read = read_layers if "layers" in path.name else read_depth
        field, _ = read(path, source, prepared, settings, Path(folder))
    with Image.open(path) as picture:
        pixels = np.asarray(picture).astype(np.float32)
    gray = torch.from_numpy(pixels / 65535 if pixels.ndim == 2 else pixels[..., 0] / 255)
    over = torch.where(animal[..., 3] > 0.5, gray, 1.0)[..., None].expand(-1, -1, 3)
    return over, DepthHint(0.0, field)


def sheet_of(states: Gaussians) -> Tensor:
    """Render some frames from azimuths that nobody gave, a row each."""
    rasterize, frames = get_rasterizer("auto"), torch.tensor(SHOWN_FRAMES)
    rows = []
    for azimuth in SHOWN_DEG:
        camera = OrbitCamera(0, azimuth, width=SIZE, height=SIZE)
        with torch.no_grad():
            drawn = rasterize(states.states(frames), [camera] * len(frames), torch.ones(3))
        rows.append(row([resize(picture[None], (TILE, TILE))[0] for picture in drawn.color]))
    return torch.cat(rows)


def tile(cutout: Float[Tensor, "s s c"]) -> Tile:
    """Return a small picture, over white if it has alpha."""
    if cutout.shape[-1] == 3:
        return resize(cutout[None], (TILE, TILE))[0]
    return resize(over_white(cutout[None]), (TILE, TILE))[0]


def row(tiles: Sequence[Tile]) -> Tensor:
    """Put tiles beside each other."""
    return torch.cat(list(tiles), 1)


def save(name: str, picture: Tensor) -> None:
    """Write a picture of the page."""
    pixels = (picture.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).save(IMAGES / f"inputs_{name}.webp", quality=QUALITY, method=6)


if __name__ == "__main__":
    main()
