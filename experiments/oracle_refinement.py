"""Texture refinement on objects with a known texture, with an oracle instead of diffusion models.

Kept as evidence for the noise level of the refinement. Run with `python -m experiments.oracle_refinement`. Our own
objects are unwrapped, with their paint as the texture and a blurred copy as the texture to refine; shape and motion are
exact. Loop (`dg4d_lib.texture.refine`) and noise levels are those of the pipeline. The oracle denoises an image x as a
network would that models images as a normal distribution around an image b of the object: with noise n of strength s,

    b + trust / sqrt(trust^2 + s^2) (x + s n - b).

b is the ground truth with random color stains, which model hallucinations and change in every iteration. In whole
videos the stains stay on the surface from frame to frame, and little noise remains where t frames agree (n / sqrt(t));
single images have separate stains and noise in every frame. The consistency of whole videos is thus an assumption; the
result is how much of either error the texture keeps, and which noise level restores most. PSNR is on the object, in the
views that ablations score; flicker is the mean change of a texel from frame to frame, in levels of 255, and 0 for the
ground truth. With trained models: `benchmarks.refinement`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.ablations import Ablation, Claim, Row, Variant, table, verdict
from benchmarks.measure import new_console, parser_of, write_rows  # before torch: how its threads wait

import torch  # isort: skip
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import interpolate

from benchmarks.objects.drawing import Painted
from benchmarks.objects.specimens import FPS, OBJECTS, SCORED_AZIMUTHS_DEG
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import Texels, locate_texels
from dg4d_lib.mesh.texturing.unwrap import unwrap
from dg4d_lib.mesh_rasterizer.texture import build_lookup, sample_texture
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.metrics.image import psnr
from dg4d_lib.refiner_settings import TextureSettings, VideoToVideoSettings
from dg4d_lib.texture.refine import MeshClip, RefinedTextures, refine_textures
from dg4d_lib.texture.refiner import noise_levels
from dg4d_lib.video.driving import DrivingVideo

STRENGTHS = (0.4, 0.3, 0.25, 0.2)  # fractions of the noise levels, 1 - T in the paper's words; 0.3 is the paper's
UNIT = 0.25  # color units per latent standard deviation
VAE_SCALE_FACTOR = 8  # pixels per latent and side
TRUST = 0.5  # standard deviation of the oracle's distribution, latents
STAINS = 0.1  # standard deviation of the color errors
WAVES, WAVELENGTH = 8, 0.3  # number and length (world units) of the waves of a stain
BLURRED_OVER = 0.02  # neighbors averaged by the blur, fraction of all vertices

VARIANTS = {
    "before": Variant(),
    **{f"video to video, {strength:g}": Variant({"strength": strength}) for strength in STRENGTHS},
    "video to video, 0.3 to 0.05": Variant({"strength": 0.3, "strength_end": 0.05}),  # over the iterations
    "image to image, 0.3": Variant({"strength": 0.3}, per_frame=True),
}
FLICKER = Ablation(
    "whole videos flicker less than single images",
    VARIANTS,
    (Claim("video to video, 0.3", "image to image, 0.3", "flicker"),),
    caveat="the consistency of videos is an assumption of the oracle",
)
NOISE = Ablation(
    "textures with a strength of 0.4 or 0.2, or annealed from 0.3 to 0.05, are worse than with 0.3",
    VARIANTS,
    tuple(
        Claim("video to video, 0.3", f"video to video, {other}", "psnr_obj") for other in ("0.4", "0.2", "0.3 to 0.05")
    ),
    caveat="the accuracy of the oracle is an assumption",
)


@dataclass(frozen=True)
class Figures:
    """Metrics of a refined mesh."""

    psnr_obj: float
    flicker: float


@dataclass(frozen=True)
class Model:
    """Deforming mesh with a known texture.

    Attributes:
        mesh: in the reference pose, with its true texture.
        offsets: of its vertices in every frame.
        texels: positions of the texels.
        blurred: texture to refine.
    """

    mesh: TexturedMesh
    offsets: Float[Tensor, "t v 3"]
    texels: Texels
    blurred: Float[Tensor, "n n 3"]

    def draw(
        self, textures: Sequence[Float[Tensor, "_ _ 3"]], cameras: Sequence[OrbitCamera]
    ) -> Float[Tensor, "t h w 4"]:
        """Render every frame with its texture and camera; return color over white and alpha."""
        states = self.mesh.vertices + self.offsets
        pictures = []
        for state, texture, camera in zip(states, textures, cameras, strict=True):
            fragments = rasterize_mesh(state, self.mesh.faces, [camera])
            look = build_lookup(state, self.mesh.faces, self.mesh.uvs, texture.shape[:2], [camera], fragments)
            picture = torch.ones(*look.covered.shape[1:], 4)
            picture[..., 3] = look.covered[0].float()
            picture[look.covered[0]] = torch.cat(
                [sample_texture(texture, look), torch.ones(int(look.covered.sum()), 1)], -1
            )
            pictures.append(picture)
        return torch.stack(pictures)

    def stained(self, generator: torch.Generator) -> Float[Tensor, "n n 3"]:
        """Return the true texture with smooth color errors of `STAINS`."""
        direction = torch.randn(3, 3, WAVES, generator=generator) * (2 * torch.pi / WAVELENGTH / 3**0.5)
        phase = 2 * torch.pi * torch.rand(3, 1, WAVES, generator=generator)
        waves = (self.texels.positions @ direction + phase).sin().sum(-1) * (2 / WAVES) ** 0.5  # by color and texel
        texture = self.mesh.texture.clone()
        texture[self.texels.rows, self.texels.columns] += STAINS * waves.T
        return texture.clamp(0, 1)


def unwrapped_model(name: str, frames: int, texels: int) -> Model:
    """Return one of our own objects with a texture of this many texels per side."""
    painted = Painted(OBJECTS[name]())
    rest = painted.vertices(0.0)
    copied, corners, uvs = (torch.from_numpy(part) for part in unwrap(rest.numpy(), painted.faces.numpy(), texels))
    vertices = rest[copied.long()]
    places = locate_texels(vertices, vertex_normals(vertices, corners), corners, uvs, texels)
    tree = cKDTree(rest.numpy())

    def texture(neighbors: int) -> Float[Tensor, "n n 3"]:
        _, nearest = tree.query(places.positions.numpy(), neighbors)
        colors = painted.colors[torch.from_numpy(np.reshape(nearest, (-1, neighbors)))].mean(1)
        return _fill_gaps(places, colors, texels)

    moved = torch.stack([painted.vertices(frame / frames)[copied.long()] for frame in range(frames)])
    mesh = TexturedMesh(vertices, corners, uvs, texture(1))
    return Model(mesh, moved - vertices, places, texture(max(2, round(BLURRED_OVER * len(rest)))))


def _fill_gaps(places: Texels, colors: Float[Tensor, "p 3"], size: int) -> Float[Tensor, "n n 3"]:
    """Fill the gaps of a texture with the color of the nearest texel on the surface."""
    picture, empty = torch.zeros(size, size, 3), np.ones((size, size), bool)
    picture[places.rows, places.columns] = colors
    empty[places.rows.numpy(), places.columns.numpy()] = False
    nearest = torch.from_numpy(distance_transform_edt(empty, return_distances=False, return_indices=True))
    return picture[nearest[0].long(), nearest[1].long()]


class Oracle:
    """Refiner with knowledge of the ground truth, plus random stains."""

    def __init__(self, model: Model, sigma_at: Callable[[float], float], whole_videos: bool) -> None:
        """Store the model and the noise level as a function of the progress of the iterations in [0, 1]."""
        self.model, self.sigma_at, self.whole_videos = model, sigma_at, whole_videos

    def refine(
        self,
        video: Float[Tensor, "t h w 3"],
        cameras: Sequence[OrbitCamera],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, "t h w 3"]:
        """Denoise as described in the module docstring."""
        sigma = self.sigma_at(progress)
        frames, height, width = video.shape[:3]
        stains = [self.model.stained(generator) for _ in range(1 if self.whole_videos else frames)]
        believed = self.model.draw(stains * (frames // len(stains)), cameras)[..., :3]
        latents = torch.randn(frames, 3, height // VAE_SCALE_FACTOR, width // VAE_SCALE_FACTOR, generator=generator)
        noise = interpolate(latents, (height, width), mode="bilinear").movedim(1, -1)
        left = 1 / frames**0.5 if self.whole_videos else 1.0
        keep = TRUST / (TRUST**2 + sigma**2) ** 0.5
        return (believed + keep * (video + sigma * UNIT * left * noise - believed)).clamp(0, 1)


def refine_model(model: Model, variant: Variant, settings: TextureSettings, seed: int) -> RefinedTextures:
    """Refine the blurred texture with the pipeline's loop; return it unchanged without a noise level."""
    if not variant.changes:
        return RefinedTextures(model.blurred)
    levels = VideoToVideoSettings(**variant.changes)
    front = [OrbitCamera(width=settings.size, height=settings.size)] * len(model.offsets)
    seen = model.draw([model.mesh.texture] * len(front), front)
    video = DrivingVideo(seen[..., :3], seen[..., 3:], FPS)
    clip = MeshClip(replace(model.mesh, texture=model.blurred), model.offsets)
    oracle = Oracle(model, lambda progress: noise_levels(levels, progress)[0], whole_videos=not variant.per_frame)
    return refine_textures([clip], video, oracle, settings, torch.Generator().manual_seed(seed))[0]


def score_model(model: Model, made: RefinedTextures, size: int) -> Figures:
    """Compare with the true texture."""
    count = len(model.offsets)
    textures = [made.texture] * count if made.frame_textures is None else list(made.frame_textures)
    colors = torch.stack(textures)[:, model.texels.rows, model.texels.columns]
    marks = []
    for azimuth in SCORED_AZIMUTHS_DEG:
        cameras = [OrbitCamera(azimuth_deg=azimuth, width=size, height=size)] * count
        ground_truth, ours = (model.draw(looks, cameras) for looks in ([model.mesh.texture] * count, textures))
        marks.append(psnr(ours[..., :3], ground_truth[..., :3], ground_truth[..., 3:]).mean())
    return Figures(float(torch.stack(marks).mean()), 255 * float(colors.diff(dim=0).abs().mean()))


def main() -> None:
    parser = parser_of(__doc__, "one object, three frames, two iterations, 64 pixels")
    parser.add_argument("--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--size", type=int, default=128, help="pixels of the refined and scored images")
    parser.add_argument("--texels", type=int, default=256, help="texels per side of the texture")
    parser.add_argument("--iterations", type=int, default=TextureSettings().iterations)
    options = parser.parse_args()
    if options.quick:
        options.objects, options.frames, options.size, options.texels, options.iterations = ["parrot"], 3, 64, 128, 2
    console, rows = new_console(), list[Row]()
    kinds = {  # texels of a side of what frames add, and what is asked
        "a texture per frame": (options.texels, (FLICKER, NOISE)),
        "one texture": (0, (NOISE,)),  # which cannot flicker
    }
    models = {name: unwrapped_model(name, options.frames, options.texels) for name in options.objects}
    for kind, (added, ablations) in kinds.items():
        settings = TextureSettings(size=options.size, iterations=options.iterations, frame_size=added)
        mine = list[Row]()
        for name, model in models.items():
            for seed in range(options.seeds):
                for title, variant in VARIANTS.items():
                    made = refine_model(model, variant, settings, seed)
                    mine.append(Row(kind, title, name, seed, score_model(model, made, options.size)))
        scale = f"{options.seeds} seeds, {options.frames} frames, {options.size} px, {options.iterations} iterations"
        console.print(table(f"refinement, {kind}: {', '.join(models)}; {scale}", mine))
        for ablation in ablations:
            console.print(verdict(ablation, mine), soft_wrap=True)
        rows += mine
    if options.json:
        write_rows(options.json, rows)


if __name__ == "__main__":
    main()
