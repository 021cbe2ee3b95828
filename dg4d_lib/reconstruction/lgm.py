"""LGM: feed-forward reconstruction of 65,536 Gaussians from four views of an object (Tang et al. 2024).

LGM uses our conventions (right-handed, y up, the first camera on +z, azimuth counter-clockwise from above, quaternions
wxyz), but its cameras are at radius 1.5. `decode_gaussians` scales everything by 2 / 1.5 once: a render from radius 2
then equals LGM's own from radius 1.5, because sizes and distances grow by the same factor.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.diffusion.checkpoints import load_checkpoint
from dg4d_lib.diffusion.components import Placement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.reconstruction.alignment import best_azimuth
from dg4d_lib.reconstruction.lgm_unet import VIEWS, Unet, UnetConfig

WEIGHTS_FILE = "model_fp16_fixrot.safetensors"
LGM_RADIUS = 1.5  # of LGM's cameras
WORLD_SCALE = RADIUS / LGM_RADIUS
INPUTS = 9  # color 3, Pluecker ray 6
OUTPUTS = 14  # position 3, opacity 1, scale 3, rotation 4, color 3
MIN_OPACITY = 0.005  # fainter Gaussians are dropped (public code)
MIN_SCALE = 1e-8  # LGM's units; avoids the logarithm of zero
COLOR_MEAN, COLOR_DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet


class Lgm(nn.Module):
    """LGM's network, with the tensor names of its published weights.

    Args:
        config: of the U-Net.
    """

    def __init__(self, config: UnetConfig) -> None:
        super().__init__()
        self.unet = Unet(INPUTS, OUTPUTS, config)
        self.conv = nn.Conv2d(OUTPUTS, OUTPUTS, 1)

    @torch.no_grad()
    def forward(self, images: Float[Tensor, "4 h w 3"]) -> Float[Tensor, "n 14"]:
        """Predict one raw Gaussian per output pixel of every view, with device and dtype of the images.

        Args:
            images: at azimuth 0, 90, 180, 270 and elevation 0, over white, in [0, 1], square.
        """
        parameter = next(self.parameters())
        size = images.shape[1]
        cameras = turntable(VIEWS, OrbitCamera(radius=LGM_RADIUS, width=size, height=size))
        mean, deviation = images.new_tensor(COLOR_MEAN), images.new_tensor(COLOR_DEVIATION)
        colors = ((images - mean) / deviation).permute(0, 3, 1, 2)
        features = torch.cat([colors.to(parameter), ray_embedding(cameras).to(parameter)], 1)
        return self.conv(self.unet(features)).permute(0, 2, 3, 1).reshape(-1, OUTPUTS).to(images)


def ray_embedding(cameras: list[OrbitCamera]) -> Float[Tensor, "v 6 h w"]:
    """Return the Pluecker coordinates of every pixel's ray: o x d, then the unit direction d; float64, world axes.

    Args:
        cameras: of one image size.
    """
    width, height = cameras[0].width, cameras[0].height
    rows, columns = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    right, down = (columns + 0.5 - width / 2) / cameras[0].focal, (rows + 0.5 - height / 2) / cameras[0].focal
    camera_rays = functional.normalize(torch.stack([right, down, torch.ones_like(right)], -1), dim=-1)
    embeddings = []
    for camera in cameras:
        directions = camera_rays @ camera.viewmat()[:3, :3]  # row vectors times R: the inverse rotation
        origins = camera.position().expand_as(directions)
        embeddings.append(torch.cat([torch.linalg.cross(origins, directions), directions], -1))
    return torch.stack(embeddings).permute(0, 3, 1, 2)


def decode_gaussians(raw: Float[Tensor, "n 14"]) -> Gaussians:
    """Apply LGM's activations and scale to our world: positions in +-4/3, scale 0.1 softplus, color 0.5 tanh + 0.5."""
    means, opacity_logits, scales, quats, colors = raw.split((3, 1, 3, 4, 3), -1)
    return Gaussians(
        means.clamp(-1, 1) * WORLD_SCALE,
        (0.1 * functional.softplus(scales)).clamp(min=MIN_SCALE).log() + math.log(WORLD_SCALE),
        functional.normalize(quats, dim=-1),
        opacity_logits[:, 0],
        rgb_to_sh(0.5 * colors.tanh() + 0.5),
    )


def reconstruct(
    model: Lgm, views: Float[Tensor, "4 h w 3"], image: Float[Tensor, "s t 3"], rasterize: Rasterizer
) -> Gaussians:
    """Reconstruct Gaussians that match an image at azimuth 0.

    A multi-view model may rotate the object relative to its input. The first reconstruction is therefore rendered from
    the azimuth that matches the image best, and 90, 180 and 270 degrees further; these views are reconstructed again.

    Args:
        model: the network.
        views: four images of the object, 90 degrees of azimuth apart, over white; the result is on their device.
        image: the subject over white, in the crop of the pipeline.
        rasterize: rasterizer for that device.
    """
    size = views.shape[1]
    first = drop_faint(decode_gaussians(model(views)))
    camera = OrbitCamera(azimuth_deg=best_azimuth(first, image, rasterize), width=size, height=size)
    aligned = rasterize(first, turntable(VIEWS, camera), torch.ones(3, device=first.means.device)).color
    return drop_faint(decode_gaussians(model(aligned)))


def drop_faint(gaussians: Gaussians) -> Gaussians:
    """Remove Gaussians with an opacity below 0.005."""
    keep = gaussians.opacities >= MIN_OPACITY
    return gaussians.subset(keep)


def load_lgm(path: Path, placement: Placement) -> Lgm:
    """Load the network with published weights, frozen; its size is inferred from the weights.

    Args:
        path: the file, or the folder of `model_fp16_fixrot.safetensors`.
        placement: device, precision and memory format; the weights are published in float16.

    Raises:
        BadInput: the file is missing, damaged, or has other tensors.
    """
    file = path / WEIGHTS_FILE if path.is_dir() else path
    return load_checkpoint(lambda tensors: Lgm(infer_unet_config(tensors)), file, placement)


def infer_unet_config(tensors: Mapping[str, Tensor]) -> UnetConfig:
    """Infer the configuration of the U-Net from its tensors.

    Raises:
        BadInput: the tensors are not LGM's.
    """
    channels: dict[str, tuple[int, ...]] = {}
    attention: dict[str, tuple[bool, ...]] = {}
    for way in ("down", "up"):
        levels = [f"unet.{way}_blocks.{i}" for i in range(len(tensors))]
        levels = [level for level in levels if f"{level}.nets.0.conv1.weight" in tensors]
        channels[way] = tuple(len(tensors[f"{level}.nets.0.conv1.weight"]) for level in levels)
        attention[way] = tuple(f"{level}.attns.0.norm.weight" in tensors for level in levels)
    if not 1 <= len(channels["up"]) < len(channels["down"]):
        raise BadInput(f"these are not weights of LGM: found levels down {channels['down']}, up {channels['up']}")
    return UnetConfig(channels["down"], attention["down"], channels["up"], attention["up"])
