"""Texture refinement with diffusion models: noise levels, and whole videos against single pictures.

Run with `python -m benchmarks.refinement ASSET.glb FRAMES` where the weights svd and zero123-xl are (`dg4d weights
pull`), best on a GPU; FRAMES is the folder of cut-outs of the asset's driving video. Every variant is the pipeline's
own step with a texture per frame. Flicker is the mean change of a texel from frame to frame, in levels of 255, over the
texels that were refined; sharpness is the mean step between neighboring texels there, in units of what it was before.
The paper says: whole videos flicker less than single pictures; with .6 of the noise levels skipped textures come out
too smooth, with .8 too noisy, .7 is best. What such models paint no stand-in knows; what the loop makes of pictures
that are as consistent, or as inconsistent, as theirs is measured by `benchmarks.oracle_refinement`.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.measure import machine, new_console, parser_of, write_rows  # before torch: how its threads wait

import torch  # isort: skip
from jaxtyping import Float
from rich.table import Column, Table
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.glb import read_glb
from dg4d_lib.images import resize
from dg4d_lib.settings import (
    ImageToImageSettings,
    RefinerSettings,
    TextureSettings,
    VideoModelSettings,
    VideoToVideoSettings,
    Zero123PriorSettings,
)
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import read_png, write_frames
from steps.artifacts.meshes import read_tracked, write_tracked
from steps.profiles import RefineTextureSettings
from steps.refine_texture import run
from steps.runtime.job import Job

SKIPPED = (0.6, 0.7, 0.75, 0.8)  # shares of the noise levels; the paper's "noise level" is .7
FRAME_TEXELS = 512  # of a side of the textures per frame
NOTICEABLE = 0.5 / 255  # a texel that changed by less was not refined


@dataclass(frozen=True)
class Row:
    """One way to refine one asset."""

    variant: str
    flicker: float
    sharpness: float


def variants(texture: TextureSettings, svd: str, zero123: str) -> dict[str, RefinerSettings]:
    """Whole videos with several noise levels, and picture by picture."""
    model = VideoModelSettings(weights=svd)
    videos: dict[str, RefinerSettings] = {
        f"video to video, {skipped:g} skipped": VideoToVideoSettings(texture=texture, model=model, skipped=skipped)
        for skipped in SKIPPED
    }
    return {
        **videos,
        "image to image": ImageToImageSettings(texture=texture, prior=Zero123PriorSettings(weights=zero123)),
    }


def refined(asset: Asset4D, video: DrivingVideo, settings: RefinerSettings, seed: int) -> Asset4D:
    """What the step makes of it.

    Raises:
        BackendUnavailable: the weights are not here; says what gets them.
    """
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        write_tracked(folder / "before", replace(asset, textures=None))
        write_frames(folder / "video", video)
        inputs = {"tracked": folder / "before", "driving_video": folder / "video"}
        outputs = {"tracked": folder / "after"}
        run(Job(inputs, outputs, RefineTextureSettings(refiner=settings), seed, lambda *_: None, folder))
        return read_tracked(folder / "after")


def measured(variant: str, before: Float[Tensor, "h w 3"], textures: Float[Tensor, "t i j 3"]) -> Row:
    """Flicker and sharpness of textures per frame."""
    start = resize(before[None], textures.shape[1:3])[0]
    touched = ((textures - start).abs() > NOTICEABLE).any(-1).any(0)
    changes = textures.diff(dim=0).abs().mean((0, -1))[touched]
    steps = [_steps(picture)[touched].mean() for picture in (textures, start[None])]
    return Row(variant, 255 * float(changes.mean()), float(steps[0] / steps[1]))


def _steps(pictures: Float[Tensor, "t i j 3"]) -> Float[Tensor, "i j"]:
    """Mean difference to the texels below and to the right."""
    down, right = (pictures - pictures.roll(-1, axis) for axis in (1, 2))
    return (down.abs() + right.abs()).mean((0, -1))


def main() -> None:
    parser = parser_of(__doc__, "one iteration, 64 pixels")
    parser.add_argument("asset", type=Path, metavar="ASSET.glb", help="with a tracked mesh")
    parser.add_argument("frames", type=Path, metavar="FRAMES", help="folder of cut-outs, one per frame of the asset")
    parser.add_argument("--svd", default="svd", help="weights of Stable Video Diffusion: a name or a folder")
    parser.add_argument("--zero123", default="zero123-xl", help="weights of Zero-1-to-3: a name or a folder")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    asset = read_glb(options.asset.read_bytes())
    cutouts = torch.stack([read_png(path) for path in sorted(options.frames.glob("*.png"))])
    video = DrivingVideo(cutouts[..., :3], cutouts[..., 3:], asset.fps)
    quick = {"iterations": 1, "size": 64} if options.quick else {}
    texture = TextureSettings(frame_size=FRAME_TEXELS, **quick)
    rows = []
    for name, settings in variants(texture, options.svd, options.zero123).items():
        after = refined(asset, video, settings, options.seed)
        assert after.textures is not None, "frame_size gives every frame a texture"
        rows.append(measured(name, asset.mesh.texture, after.textures))
    table = Table(Column("variant", no_wrap=True), "flicker", "sharpness", title=machine())
    for row in rows:
        table.add_row(row.variant, f"{row.flicker:.2f}", f"{row.sharpness:.2f}")
    new_console().print(table)
    if options.json:
        write_rows(options.json, rows)


if __name__ == "__main__":
    main()
