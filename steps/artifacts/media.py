"""Files that steps hand to each other: pictures, frames, motions, curves. Equal content gives equal bytes."""

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.archives import unpack

EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip can hold; every entry has it
CURVES_POINTS = 200  # a curve is thinned to about this many points


def write_png(path: Path, picture: Float[Tensor, "h w c"]) -> None:
    """Write a picture in [0, 1] with 1, 3 or 4 channels as 8-bit PNG, straight alpha.

    Raises:
        OSError: the file could not be written.
    """
    pixels = (picture.detach().cpu().clamp(0, 1) * 255).round().to(torch.uint8).contiguous().numpy()
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
        BadInput: it cannot be read.
    """
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), config)
    if file is None:
        raise BadInput(f"{path.name} cannot be read as a picture: {oiio.geterror()}")
    pixels = file.read_image("float")
    if pixels is None:
        raise BadInput(f"{path.name} cannot be read as a picture: {file.geterror()}")
    file.close()
    return torch.from_numpy(np.ascontiguousarray(pixels))


def write_zip(path: Path, entries: Sequence[tuple[str, bytes]]) -> None:
    """A stored zip with fixed dates: equal entries give equal bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in entries:
            info = zipfile.ZipInfo(name, EPOCH)
            info.external_attr = 0o644 << 16
            archive.writestr(info, content)


def write_frames(path: Path, video: DrivingVideo) -> None:
    """A driving video as RGBA pictures in a zip."""
    scratch = path.with_suffix(".png")
    entries = []
    for i, cutout in enumerate(torch.cat([video.frames, video.alpha], -1)):
        write_png(scratch, cutout)
        entries.append((f"{i:03d}.png", scratch.read_bytes()))
    scratch.unlink()
    entries.append(("video.json", json.dumps({"fps": video.fps}).encode()))
    write_zip(path, entries)


def read_frames(path: Path, scratch: Path) -> DrivingVideo:
    """Read what `write_frames` wrote; `scratch` is a folder for the unpacked pictures."""
    names = unpack(path, scratch, "the zip of frames", lambda name: name.endswith(".png"))
    stack = torch.stack([read_png(scratch / name) for name in names])
    with zipfile.ZipFile(path) as archive:
        fps = float(json.loads(archive.read("video.json"))["fps"])
    return DrivingVideo(stack[..., :3].contiguous(), stack[..., 3:].contiguous(), fps)


def write_curves(
    path: Path, title: str, x: Sequence[int], series: Mapping[str, Sequence[float]], notes: Sequence[str] = ()
) -> None:
    """Losses over iterations as JSON, thinned."""
    step = max(1, len(x) // CURVES_POINTS)
    thin = {name: [round(float(v), 6) for v in values[::step]] for name, values in series.items()}
    text = json.dumps({"title": title, "x": list(x[::step]), "series": thin, "notes": list(notes)})
    path.write_bytes(text.encode())
