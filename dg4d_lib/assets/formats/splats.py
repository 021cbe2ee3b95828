"""Splat sequences with one file per frame: standard PLY, SPZ or glTF."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from dg4d_lib.assets.formats.splat_glb import SplatGlbVersion, write_splat_glb
from dg4d_lib.assets.formats.spz import SpzVersion, write_spz
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import read_ply, write_ply


def write_splats(folder: Path, states: Gaussians) -> list[Path]:
    """Write every state of a batch as FOLDER/NNN.ply, in the axes of other programs; the folder must exist.

    Raises:
        BadInput: numbers that are not finite.
        OSError: a file could not be written.
    """
    return _write(folder, states, "ply", partial(write_ply, y_down=True))


def write_spz_frames(folder: Path, states: Gaussians, version: SpzVersion = 3) -> list[Path]:
    """Write every state of a batch as FOLDER/NNN.spz; the folder must exist.

    Raises:
        BadInput: numbers that are not finite, or means outside the range of SPZ (see `write_spz`).
        OSError: a file could not be written.
    """
    return _write(folder, states, "spz", partial(write_spz, version=version))


def write_splat_glb_frames(folder: Path, states: Gaussians, version: SplatGlbVersion = "ratified") -> list[Path]:
    """Write every state of a batch as a splat GLB, FOLDER/NNN.glb; the folder must exist.

    Raises:
        BadInput: no Gaussians, or numbers that are not finite.
        OSError: a file could not be written.
    """
    return _write(folder, states, "glb", lambda path, state: path.write_bytes(write_splat_glb(state, version)))


def read_splats(folder: Path, *, y_down: bool = True) -> Gaussians:
    """Read the output of `write_splats` as a batch with one state per frame.

    Args:
        folder: folder of the files.
        y_down: False for files of earlier versions, which had y up.

    Raises:
        BadInput: no frames, a gap in the numbering, a corrupt file, or frames that are not states of one cloud.
    """
    paths = sorted(folder.glob("*.ply"))
    if not paths or [path.name for path in paths] != [f"{frame:03d}.ply" for frame in range(len(paths))]:
        given = f"{paths[0].name} to {paths[-1].name}, {len(paths)} files" if paths else "none"
        raise BadInput(f"{folder.name}/ must contain 000.ply, 001.ply, ... without gaps; given {given}")
    if others := [path.name for path in paths if not path.is_file()]:  # reading a FIFO may never end
        raise BadInput(f"{folder.name}/{others[0]} is not a file; pack the asset again")
    clouds = [read_ply(path, y_down=y_down) for path in paths]
    first = clouds[0]
    for path, cloud in zip(paths, clouds, strict=True):
        same = torch.equal(cloud.opacity_logits, first.opacity_logits) and torch.equal(cloud.harmonics, first.harmonics)
        if not same:
            raise BadInput(
                f"{path.name} and {paths[0].name} are not frames of one sequence: opacity or color differ; "
                "write the sequence again"
            )
    return Gaussians(
        torch.stack([cloud.means for cloud in clouds]),
        torch.stack([cloud.log_scales for cloud in clouds]),
        torch.stack([cloud.quats for cloud in clouds]),
        first.opacity_logits,
        first.harmonics,
    )


def _write(folder: Path, states: Gaussians, suffix: str, write: Callable[[Path, Gaussians], object]) -> list[Path]:
    paths = [folder / f"{frame:03d}.{suffix}" for frame in range(len(states.means))]
    for frame, path in enumerate(paths):
        write(path, states.at(frame))
    return paths
