"""Moving splats for the web: one small file with everything that `viewer/src/splats.js` needs to play them.

Layout: the four bytes "D4WS"; the length of the header as little-endian uint32; the header as JSON; one zlib stream.
Color does not move and comes first: red, green, blue and opacity as planes of n bytes in 1/255. Then, for every frame
and axis, come three fields of n 16-bit whole numbers each:

    position    `corner` of the box of all frames + `position_step` * number; its longest side has 4,096 steps
    rotation    `rotation_step` radians * number: the rotation vector, axis times angle
    scale       `scale_step` * number: its natural logarithm

The numbers of a field are stored as differences from the frame before, and these as differences from the Gaussian
before, modulo 2^16, in zigzag (0, -1, 1, -2, ... become 0, 1, 2, 3, ...), low bytes of the field first, then its high
bytes. Gaussians stand in Morton order of their first frame, so that neighbors, which move alike, follow each other.
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
POSITION_STEPS = 4096  # along the longest side of the box; a place is off by 1/8192 of it at most, .2 mm of 1.6 m
ROTATION_STEP = 1 / 32  # radians; a rotation is off by 1.6 degrees at most, .9 on average
SCALE_STEP = 1 / 16  # of the logarithm; a scale is off by 3 percent at most
MORTON_BITS = POSITION_STEPS.bit_length()  # per axis


def write_web_splats(states: Gaussians, fps: float) -> bytes:
    """The file of a batch of states, one per frame; equal states give equal bytes.

    Per splat and frame, 3 to 5 bytes are usual. Scales below e^-2048 and the order of the Gaussians are lost.

    Args:
        states: "t n 3", color of degree 0.
        fps: frames per second; after the last frame comes the first again.

    Raises:
        BadInput: no frames, no Gaussians, an fps that is not positive, or numbers that are not finite.
    """
    if states.means.dim() != 3 or 0 in states.means.shape:
        raise BadInput(f"splats for the web need states of shape t n 3, none empty; given {tuple(states.means.shape)}")
    if not 0 < fps < float("inf"):
        raise BadInput(f"frames per second must be positive; given {fps}")
    if not all(values.isfinite().all() for values in vars(states).values()):
        raise BadInput("the states of these splats hold numbers that are not finite")
    means = states.means.detach().cpu().double()
    low, high = means.amin((0, 1)), means.amax((0, 1))
    step = max(float((high - low).max()), 1e-9) / POSITION_STEPS
    places = _steps((means - low) / step)
    order = _morton(places[0])
    fields = (
        places,
        _steps(_rotation_vectors(states.quats.detach().cpu().double()) / ROTATION_STEP),
        _steps(states.log_scales.detach().cpu().double() / SCALE_STEP),
    )
    paint = torch.cat([states.colors, states.opacities[:, None]], 1).detach().cpu().mul(255).round()
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
    planes = [paint.numpy().astype("u1")[order].T.tobytes(), *(_packed(field[:, order]) for field in fields)]
    packer = zlib.compressobj(9, zlib.DEFLATED, zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_RLE)
    return MAGIC + struct.pack("<I", len(text)) + text + packer.compress(b"".join(planes)) + packer.flush()


def _steps(values: Float[Tensor, "t n 3"]) -> Int[NDArray[np.int16], "t n 3"]:
    limits = np.iinfo(np.int16)
    return values.round().clamp(limits.min, limits.max).numpy().astype("<i2")


def _rotation_vectors(quats: Float[Tensor, "t n 4"]) -> Float[Tensor, "t n 3"]:
    """Axis times angle; of the two signs of a quaternion the one nearer to the frame before, so that nothing jumps."""
    quats = quats / quats.norm(dim=-1, keepdim=True)
    same = torch.cat([quats[:1, :, 0], (quats[1:] * quats[:-1]).sum(-1)])
    quats = quats * torch.where(same < 0, -1.0, 1.0).cumprod(0)[..., None]
    axes, sines = quats[..., 1:], quats[..., 1:].norm(dim=-1, keepdim=True)
    angles = 2 * torch.atan2(sines, quats[..., :1])
    return axes * torch.where(sines > 0, angles / sines.clamp_min(torch.finfo(sines.dtype).tiny), 2.0)


def _morton(places: Int[NDArray[np.int16], "n 3"]) -> Int[NDArray[np.int64], " n"]:
    """The order along a curve that visits neighbors together: by interleaved bits of the coordinates."""
    cells = places.astype(np.int64)
    codes = sum((cells[:, axis] >> bit & 1) << (3 * bit + axis) for bit in range(MORTON_BITS) for axis in range(3))
    return np.argsort(codes, kind="stable")


def _packed(field: Int[NDArray[np.int16], "t n 3"]) -> bytes:
    """Low and high bytes of differences of differences."""
    values = field.transpose(0, 2, 1)
    values = np.diff(values, axis=0, prepend=np.zeros_like(values[:1]))
    values = np.diff(values, axis=2, prepend=np.zeros_like(values[..., :1]))
    zigzag = ((values << 1) ^ (values >> 15)).astype("<u2")
    return (zigzag & 255).astype("u1").tobytes() + (zigzag >> 8).astype("u1").tobytes()
