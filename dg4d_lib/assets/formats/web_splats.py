"""Animated splats for the web viewer: one small file, decoded by `viewer/src/splats.js`.

Layout: the four bytes "D4WS"; the length of the header as little-endian uint32; the header as JSON; one zlib stream.
Colors are static and come first: red, green, blue and opacity as planes of n bytes in 1/255. They are followed, for
every frame and axis, by three fields of n 16-bit integers each:

    position    `corner` of the bounding box of all frames + `position_step` * integer; 4,096 steps on its longest side
    rotation    `rotation_step` radians * integer: the rotation vector, axis times angle
    scale       `scale_step` * integer: its natural logarithm

The integers of a field are stored as differences from the previous frame, and these as differences from the previous
Gaussian, modulo 2^16, in zigzag encoding (0, -1, 1, -2, ... become 0, 1, 2, 3, ...), low bytes of the field first, then
its high bytes. Gaussians are in Morton order of their first frame, so that neighbors, which move alike, are adjacent.
"""

import json
import struct
import zlib

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians

MAGIC = b"D4WS"
VERSION = 2
POSITION_STEPS = 4096  # on the longest side of the box; error at most 1/8192 of it, 0.2 mm of 1.6 m
ROTATION_STEP = 1 / 32  # radians; error at most 1.6 degrees, 0.9 on average
SCALE_STEP = 1 / 16  # of the logarithm; error of a scale at most 3 %
MORTON_BITS = POSITION_STEPS.bit_length()  # bits per axis


def write_web_splats(states: Gaussians, fps: float) -> bytes:
    """Encode a batch of states, one per frame; equal states give equal bytes.

    The size is typically 3 to 5 bytes per splat and frame. Scales below e^-2048 and the order of the Gaussians are
    lost.

    Args:
        states: fields "t n 3", color of degree 0.
        fps: frames per second of the loop.

    Raises:
        BadInput: no frames, no Gaussians, an fps that is not positive, or numbers that are not finite.
    """
    if states.means.dim() != 3 or 0 in states.means.shape:
        raise BadInput(
            f"web splats need at least one frame and one Gaussian, means of shape (t, n, 3); "
            f"given {tuple(states.means.shape)}"
        )
    if not 0 < fps < float("inf"):
        raise BadInput(f"frames per second must be positive; given {fps}")
    if not all(values.isfinite().all() for values in vars(states).values()):
        raise BadInput("the splats hold numbers that are not finite; fit the model again")
    means = states.means.detach().cpu().double()
    low, high = means.amin((0, 1)), means.amax((0, 1))
    step = max(float((high - low).max()), 1e-9) / POSITION_STEPS
    positions = _quantize((means - low) / step)
    order = _morton_order(positions[0])
    fields = (
        positions,
        _quantize(_rotation_vectors(states.quats.detach().cpu().double()) / ROTATION_STEP),
        _quantize(states.log_scales.detach().cpu().double() / SCALE_STEP),
    )
    rgba = torch.cat([states.colors, states.opacities[:, None]], 1).detach().cpu().mul(255).round()
    header = {
        "version": VERSION,
        "count": len(order),
        "frames": len(means),
        "fps": float(fps),
        "corner": low.tolist(),
        "position_step": step,
        "rotation_step": ROTATION_STEP,
        "scale_step": SCALE_STEP,
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    planes = [rgba.numpy().astype("u1")[order].T.tobytes(), *(_pack(field[:, order]) for field in fields)]
    compressor = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_RLE)
    return MAGIC + struct.pack("<I", len(text)) + text + compressor.compress(b"".join(planes)) + compressor.flush()


def _quantize(values: Float[Tensor, "t n 3"]) -> Int[NDArray[np.int16], "t n 3"]:
    limits = np.iinfo(np.int16)
    return values.round().clamp(limits.min, limits.max).numpy().astype("<i2")


def _rotation_vectors(quats: Float[Tensor, "t n 4"]) -> Float[Tensor, "t n 3"]:
    """Convert quaternions to axis times angle, with the sign nearest to the previous frame to avoid jumps."""
    quats = quats / quats.norm(dim=-1, keepdim=True)
    cosines = torch.cat([quats[:1, :, 0], (quats[1:] * quats[:-1]).sum(-1)])
    quats = quats * torch.where(cosines < 0, -1.0, 1.0).cumprod(0)[..., None]
    axes, sines = quats[..., 1:], quats[..., 1:].norm(dim=-1, keepdim=True)
    angles = 2 * torch.atan2(sines, quats[..., :1])
    return axes * torch.where(sines > 0, angles / sines.clamp_min(torch.finfo(sines.dtype).tiny), 2.0)


def _morton_order(positions: Int[NDArray[np.int16], "n 3"]) -> Int[NDArray[np.int64], " n"]:
    """Sort positions along the Morton curve (by interleaved bits of the coordinates) and return the order."""
    cells = positions.astype(np.int64)
    codes = sum((cells[:, axis] >> bit & 1) << (3 * bit + axis) for bit in range(MORTON_BITS) for axis in range(3))
    return np.argsort(codes, kind="stable")


def _pack(field: Int[NDArray[np.int16], "t n 3"]) -> bytes:
    """Encode a field as differences over frames and Gaussians in zigzag, low bytes before high bytes."""
    values = field.transpose(0, 2, 1)
    values = np.diff(values, axis=0, prepend=np.zeros_like(values[:1]))
    values = np.diff(values, axis=2, prepend=np.zeros_like(values[..., :1]))
    zigzag = ((values << 1) ^ (values >> 15)).astype("<u2")
    return (zigzag & 255).astype("u1").tobytes() + (zigzag >> 8).astype("u1").tobytes()
