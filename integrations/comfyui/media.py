"""Conversions between ComfyUI's tensors and files."""

import hashlib
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

DIGEST_LENGTH = 12  # hexadecimal digits in the name of a folder


def write_picture(image: torch.Tensor, mask: torch.Tensor | None, path: Path) -> None:
    """Write a picture "1 h w 3 or 4" as PNG, transparent where the mask "1 h w" or "h w" is 1.

    An empty mask, which Load Image returns for an opaque picture, counts as none.

    Raises:
        ValueError: the mask has another size.
    """
    pixels = _bytes(image[0])
    if mask is not None and bool(mask.any()):
        alpha = _bytes(1 - mask.reshape(-1, *mask.shape[-2:])[0])
        _check_size(alpha.shape, pixels.shape)
        pixels = np.concatenate([pixels[..., :3], alpha[..., None]], axis=-1)
    Image.fromarray(pixels).save(path, compress_level=1)


def write_frames(frames: torch.Tensor, folder: Path) -> None:
    """Write frames "t h w 3" as numbered PNG files."""
    folder.mkdir()
    for number, frame in enumerate(frames):
        Image.fromarray(_bytes(frame[..., :3])).save(folder / f"{number:05}.png", compress_level=1)


def write_masks(masks: torch.Tensor, count: int, folder: Path) -> None:
    """Write inverted masks "t h w", white where the subject is, as numbered PNG files.

    Raises:
        ValueError: their number differs from that of the frames.
    """
    if len(masks) != count:
        raise ValueError(f"{len(masks)} masks for {count} frames; give one mask per frame, or none")
    folder.mkdir()
    for number, mask in enumerate(masks):
        Image.fromarray(_bytes(1 - mask)).save(folder / f"{number:05}.png", compress_level=1)


def over(pictures: torch.Tensor, background: float) -> torch.Tensor:
    """Return RGBA pictures "b h w 4" with straight alpha over a gray, "b h w 3"."""
    color, alpha = pictures[..., :3], pictures[..., 3:]
    return color * alpha + background * (1 - alpha)


def clean_name(name: str) -> str:
    """Return a name that is safe as one of a folder; empty if nothing of it is."""
    return re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-_")[:64]


def digest(arguments: Mapping[str, Any], folder: Path) -> str:
    """Return a digest of a request and of the files in its folder."""
    total = hashlib.sha256(json.dumps(arguments, sort_keys=True).encode())
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        total.update(path.relative_to(folder).as_posix().encode())
        total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()[:DIGEST_LENGTH]


def copy_numbered(sources: Sequence[Path], folder: Path, stem: str, suffix: str, many: bool) -> list[Path]:
    """Copy files as STEM.suffix, or, if they are many, by their names into a folder STEM; return the copies."""
    if many:
        (folder / stem).mkdir(parents=True)
        copies = [folder / stem / source.name for source in sources]
    else:
        copies = [folder / f"{stem}{suffix}"]
    for source, copy in zip(sources, copies, strict=True):
        shutil.copyfile(source, copy)
    return copies


def _bytes(values: torch.Tensor) -> "np.ndarray[Any, np.dtype[np.uint8]]":
    return (values.detach().float().cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _check_size(mask: tuple[int, ...], picture: tuple[int, ...]) -> None:
    if mask[:2] != picture[:2]:
        raise ValueError(
            f"the mask has {mask[1]} x {mask[0]} pixels, the picture {picture[1]} x {picture[0]}; give them one size"
        )
