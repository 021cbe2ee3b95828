"""Readers and writers of pictures, frames and tensors; equal content gives equal bytes."""

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float
from safetensors import safe_open
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import to_bytes
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.archives import add_entry, unpack


def write_png(path: Path, picture: Float[Tensor, "h w c"]) -> None:
    """Write a picture in [0, 1] with 1, 3 or 4 channels as 8-bit PNG, straight alpha.

    Raises:
        OSError: the file could not be written.
    """
    pixels = to_bytes(picture).contiguous().numpy()
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("png:compressionLevel", 4)
    output = oiio.ImageOutput.create(str(path))
    if output is None or not output.open(str(path), spec) or not output.write_image(pixels) or not output.close():
        raise OSError(f"could not write {path}: {output.geterror() if output is not None else oiio.geterror()}")


def read_png(path: Path) -> Float[Tensor, "h w c"]:
    """Read a picture as straight color and alpha in [0, 1].

    Raises:
        BadInput: the file cannot be read.
    """
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), config)
    pixels = file.read_image("float") if file is not None else None
    if pixels is None:
        reason = file.geterror() if file is not None else oiio.geterror()
        raise BadInput(f"{path.name} cannot be read as a picture: {reason}")
    return torch.from_numpy(np.ascontiguousarray(pixels))


def write_zip(path: Path, entries: Sequence[tuple[str, bytes]]) -> None:
    """Write an uncompressed zip whose bytes depend on the entries alone."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in entries:
            add_entry(archive, name, content)


def write_frames(path: Path, video: DrivingVideo) -> None:
    """Write a driving video as RGBA pictures in a zip."""
    scratch = path.with_suffix(".png")
    entries = []
    for i, cutout in enumerate(torch.cat([video.frames, video.alpha], -1)):
        write_png(scratch, cutout)
        entries.append((f"{i:03d}.png", scratch.read_bytes()))
    scratch.unlink()
    entries.append(("video.json", json.dumps({"fps": video.fps}).encode()))
    write_zip(path, entries)


def read_frames(path: Path, scratch: Path) -> DrivingVideo:
    """Read a file of `write_frames`; `scratch` is a folder for the unpacked pictures."""
    names = unpack(path, scratch, "the zip of frames", lambda name: name.endswith(".png"))
    stack = torch.stack([read_png(scratch / name) for name in names])
    with zipfile.ZipFile(path) as archive:
        fps = float(json.loads(archive.read("video.json"))["fps"])
    return DrivingVideo(stack[..., :3].contiguous(), stack[..., 3:].contiguous(), fps)


def read_tensors(path: Path, key: str) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the JSON under a key of a safetensors file's metadata, and its tensors.

    Raises:
        SafetensorError: the file is not a safetensors file.
        KeyError: its metadata lack the key.
    """
    with safe_open(path, "pt") as file:
        about = json.loads((file.metadata() or {})[key])
        return about, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no dict)
