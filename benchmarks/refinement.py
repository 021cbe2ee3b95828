"""Texture refinement with diffusion models: noise levels, and whole videos against single images.

Run with `python -m benchmarks.refinement ASSET.glb FRAMES` with the weights svd and zero123-xl (`dg4d weights pull`),
preferably on a GPU; FRAMES is the folder of cut-outs of the asset's driving video. Every variant is the pipeline's own
step with a texture per frame. Flicker is the mean change of a texel from frame to frame, in levels of 255, over refined
texels; sharpness is their mean difference to neighboring texels, relative to the input. Claims of the paper, whose T is
1 - strength: whole videos flicker less than single images; a strength of 0.4 gives too smooth textures, 0.2 too noisy
ones, as does one that is annealed from 0.3 to 0.05 over the iterations; 0.3 is best.
`experiments.oracle_refinement` measures the loop without trained models.
"""

from dataclasses import dataclass
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
from dg4d_lib.mesh.textured import TrackedMesh
from dg4d_lib.refiner_settings import ImageToImageSettings, RefinerSettings, TextureSettings, VideoToVideoSettings
from dg4d_lib.settings import VideoModelSettings, Zero123PriorSettings
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import read_png, write_frames, write_png
from steps.artifacts.meshes import read_tracked, write_tracked
from steps.profiles import profile, step_settings
from steps.refine_texture import run
from steps.runtime.job import Job

STRENGTHS = (0.4, 0.3, 0.25, 0.2)  # fractions of the noise levels; 0.3 is the paper's
ANNEALED = (0.3, 0.05)  # in the first and the last iteration; the paper's T from 0.7 to 0.95
FRAME_TEXELS = 512  # texels per side of the per-frame textures
MIN_CHANGE = 0.5 / 255  # texels that changed by less count as not refined


@dataclass(frozen=True)
class Row:
    """Refinement of one asset by one variant."""

    variant: str
    flicker: float
    sharpness: float


def variants(texture: TextureSettings, svd: str, zero123: str) -> dict[str, RefinerSettings]:
    """Return whole videos at several noise levels, and single images."""
    model = VideoModelSettings(weights=svd)
    videos: dict[str, RefinerSettings] = {
        f"video to video, {strength:g}": VideoToVideoSettings(texture=texture, model=model, strength=strength)
        for strength in STRENGTHS
    }
    start, end = ANNEALED
    annealed = VideoToVideoSettings(texture=texture, model=model, strength=start, strength_end=end)
    return {
        **videos,
        f"video to video, {start:g} to {end:g}": annealed,
        "image to image": ImageToImageSettings(texture=texture, prior=Zero123PriorSettings(weights=zero123)),
    }


def run_refinement(asset: Asset4D, video: DrivingVideo, settings: RefinerSettings, seed: int) -> TrackedMesh:
    """Run the refinement step.

    Raises:
        BackendUnavailable: the weights are missing; the message names the remedy.
    """
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        write_tracked(folder / "before", TrackedMesh(asset.mesh, asset.offsets))
        write_png(folder / "subject.png", torch.cat([video.frames[0], video.alpha[0]], -1))
        write_frames(folder / "video", video)
        inputs = {"tracked": folder / "before", "subject": folder / "subject.png", "driving_video": folder / "video"}
        outputs = {"tracked": folder / "after"}
        pipeline = profile("paper").model_copy(update={"refiner": settings})
        run(Job(inputs, outputs, step_settings("refine_texture", pipeline), seed, lambda *_: None, folder))
        return read_tracked(folder / "after")


def measure_textures(variant: str, before: Float[Tensor, "h w 3"], textures: Float[Tensor, "t i j 3"]) -> Row:
    """Return flicker and sharpness of textures per frame."""
    start = resize(before[None], textures.shape[1:3])[0]
    touched = ((textures - start).abs() > MIN_CHANGE).any(-1).any(0)
    changes = textures.diff(dim=0).abs().mean((0, -1))[touched]
    steps = [_steps(picture)[touched].mean() for picture in (textures, start[None])]
    return Row(variant, 255 * float(changes.mean()), float(steps[0] / steps[1]))


def _steps(pictures: Float[Tensor, "t i j 3"]) -> Float[Tensor, "i j"]:
    """Return the mean difference to the texels below and to the right."""
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
        after = run_refinement(asset, video, settings, options.seed)
        assert after.textures is not None, "frame_size gives every frame a texture"
        rows.append(measure_textures(name, asset.mesh.texture, after.textures))
    table = Table(Column("variant", no_wrap=True), "flicker", "sharpness", title=machine())
    for row in rows:
        table.add_row(row.variant, f"{row.flicker:.2f}", f"{row.sharpness:.2f}")
    new_console().print(table)
    if options.json:
        write_rows(options.json, rows)


if __name__ == "__main__":
    main()
