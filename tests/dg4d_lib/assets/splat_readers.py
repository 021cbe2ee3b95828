"""Readers of the splat formats that the project only writes."""

import json
import struct
import zlib

import numpy as np
import torch
from torch import Tensor

from dg4d_lib.assets.formats.gltf import GlbReader
from dg4d_lib.assets.formats.splat_glb import EXTENSION, KERNEL, POINTS, SplatGlbVersion
from dg4d_lib.assets.formats.web_splats import MAGIC, VERSION
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh


def read_splat_glb(content: bytes, version: SplatGlbVersion = "ratified") -> Gaussians:
    """Read the splats of a GLB with floats and colors of degree 0."""
    parsed = GlbReader(content)
    primitive = parsed.tree["meshes"][0]["primitives"][0]
    assert primitive["mode"] == POINTS and primitive["extensions"][EXTENSION]["kernel"] == KERNEL["kernel"]

    def column(name: str) -> Tensor:
        return torch.from_numpy(parsed.accessor(primitive["attributes"][name]).astype(np.float32))

    scales = column(f"{EXTENSION}:SCALE")
    return Gaussians(
        column("POSITION"),
        scales.log() if version == "ratified" else scales,
        column(f"{EXTENSION}:ROTATION").roll(1, -1),
        column(f"{EXTENSION}:OPACITY")[:, 0].double().logit().float(),
        column(f"{EXTENSION}:SH_DEGREE_0_COEF_0")[:, None],
    )


def read_web_splats(content: bytes) -> tuple[Gaussians, float]:
    """Read states and frames per second, in the order and precision of the file."""
    assert content[:4] == MAGIC
    (length,) = struct.unpack_from("<I", content, 4)
    header = json.loads(content[8 : 8 + length])
    assert header["version"] == VERSION
    planes = np.frombuffer(zlib.decompress(content[8 + length :]), "u1")
    count, frames = header["count"], header["frames"]
    paint, moving = np.split(planes, [4 * count])
    places, turns, sizes = (_unpacked(part, frames, count) for part in np.split(moving, 3))
    colors = torch.from_numpy(paint.reshape(4, count).T / 255).float()
    states = Gaussians(
        (torch.tensor(header["corner"]).double() + header["position_step"] * places).float(),
        (header["scale_step"] * sizes).float(),
        _quats(header["rotation_step"] * turns).float(),
        colors[:, 3].clamp(0.5 / 255, 1 - 0.5 / 255).logit(),
        rgb_to_sh(colors[:, :3]),
    )
    return states, float(header["fps"])


def _quats(vectors: Tensor) -> Tensor:
    half = vectors.norm(dim=-1, keepdim=True) / 2
    return torch.cat([half.cos(), torch.sinc(half / torch.pi) * vectors / 2], -1)


def _unpacked(part: np.ndarray, frames: int, count: int) -> Tensor:
    low, high = part.astype(np.uint16).reshape(2, frames, 3, count)
    zigzag = low | high << 8
    values = ((zigzag >> 1) ^ -(zigzag & 1)).astype(np.int16)
    field = values.cumsum(2, dtype=np.int16).cumsum(0, dtype=np.int16)
    return torch.from_numpy(field.transpose(0, 2, 1).astype(np.float64))
