"""Reader and writer of 3DGS PLY files (layout of Kerbl et al. 2023) with color of degree 0.

Binary little endian, one float32 row per Gaussian: x y z, nx ny nz (zeros), f_dc_0..2, opacity (logit), scale_0..2
(natural logarithm), rot_0..3 (wxyz). These are the raw parameters, so the round trip is exact.

3DGS trains on cameras of COLMAP, so other programs expect its files in OpenCV axes: x right, y down, z away from the
viewer. Files for them are written in these axes, half a turn around x from ours. Nothing in a file names its axes:
Niantic's reader refuses a header with a comment.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")  # unused; viewers expect them
COLORS = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY = ("opacity",)
SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
COLUMNS = (*MEANS, *NORMALS, *COLORS, *OPACITY, *SCALES, *QUATS)

MAX_HEADER = 65536  # bytes; bounds the search for `end_header`
_HEADER = re.compile(rb"ply\r?\n(.*?)end_header\r?\n", re.DOTALL)
_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
_TYPES |= {"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "char": "i1", "int8": "i1"}
_TYPES |= {"short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2"}


def write_ply(path: Path, gaussians: Gaussians, *, y_down: bool = False) -> None:
    """Write one cloud (no batch axis, color of degree 0); equal clouds give equal bytes.

    Args:
        path: output file.
        gaussians: the cloud, y up.
        y_down: write it in the axes that other programs expect of 3DGS.

    Raises:
        BadInput: the cloud has a batch axis, color of a higher degree or non-finite numbers.
        OSError: the file could not be written.
    """
    check_storable(gaussians, "a PLY")
    if y_down:
        gaussians = _turn(gaussians, 1)
    columns = (
        gaussians.means,
        torch.zeros_like(gaussians.means),
        gaussians.harmonics[:, 0],
        gaussians.opacity_logits[:, None],
        gaussians.log_scales,
        gaussians.quats,
    )
    rows = torch.cat(columns, 1).detach().cpu().numpy().astype("<f4")
    properties = "".join(f"property float {name}\n" for name in COLUMNS)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode("ascii") + rows.tobytes())


def read_ply(path: Path, *, y_down: bool = False) -> Gaussians:
    """Read a cloud, y up; columns may be in any order, unknown ones are ignored.

    Args:
        path: input file.
        y_down: the file is in the axes that other programs expect of 3DGS.

    Raises:
        BadInput: the file is missing, damaged, no splat PLY, or has view-dependent color or non-finite numbers.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BadInput(f"{path.name} cannot be read: {error.strerror}") from error
    count, dtype, start = parse_header(path.name, content[:MAX_HEADER])
    names = dtype.names or ()
    missing = [name for name in COLUMNS if name not in names and name not in NORMALS]
    if missing:
        raise BadInput(
            f"{path.name} is not a splat PLY: it lacks {', '.join(missing)}; required are {', '.join(COLUMNS)}"
        )
    if any(name.startswith("f_rest_") for name in names):
        raise BadInput(f"{path.name} holds color of a higher degree (f_rest_*); save it with degree 0")
    if len(content) < start + count * dtype.itemsize:
        present = max(0, len(content) - start) // dtype.itemsize
        raise BadInput(f"{path.name} is truncated: {count} Gaussians declared, {present} found; export it again")
    rows = np.frombuffer(content, dtype, count, start)

    def columns(names: tuple[str, ...]) -> torch.Tensor:
        return torch.from_numpy(np.stack([rows[name] for name in names], 1).astype(np.float32))

    parts = [columns(names) for names in (MEANS, SCALES, QUATS, OPACITY, COLORS)]
    if not all(part.isfinite().all() for part in parts):
        raise BadInput(f"{path.name} has non-finite numbers; export it again")
    means, log_scales, quats, opacity, colors = parts
    cloud = Gaussians(means, log_scales, quats, opacity[:, 0], colors[:, None])
    return _turn(cloud, -1) if y_down else cloud


def _turn(gaussians: Gaussians, sign: int) -> Gaussians:
    """Turn a cloud with view-independent color around x by `sign` times 180 degrees; the two signs cancel exactly.

    The quaternion of the turn, (0, sign, 0, 0), times (w, x, y, z) is sign times (-x, w, -z, y).
    """
    w, x, y, z = gaussians.quats.unbind(-1)
    means = gaussians.means * gaussians.means.new_tensor((1, -1, -1))
    return replace(gaussians, means=means, quats=sign * torch.stack((-x, w, -z, y), -1))


def check_storable(gaussians: Gaussians, form: str) -> None:
    """Refuse a cloud that a file of one state with view-independent color cannot hold.

    Args:
        gaussians: the cloud to write.
        form: name of the file format in messages.

    Raises:
        BadInput: the cloud has a batch axis, color of a higher degree or non-finite numbers.
    """
    if gaussians.means.dim() != 2 or gaussians.harmonics.shape[1] != 1:
        shapes = f"means {tuple(gaussians.means.shape)}, harmonics {tuple(gaussians.harmonics.shape)}"
        raise BadInput(f"{form} holds one state with color of degree 0: means n 3, harmonics n 1 3; given {shapes}")
    broken = [name for name, values in vars(gaussians).items() if not bool(values.isfinite().all())]
    if broken:
        raise BadInput(
            f"{form} cannot hold non-finite numbers; given some in {', '.join(broken)}; fit the Gaussians again"
        )


def header_text(content: bytes) -> bytes:
    """Return the header of a PLY before `end_header`; empty without one."""
    beginning = content[:MAX_HEADER]
    return beginning[: max(0, beginning.find(b"end_header"))]


def parse_header(name: str, beginning: bytes) -> tuple[int, np.dtype[np.void], int]:
    """Return the number of vertices, the type of their rows, and the offset of the first.

    Args:
        name: of the file, for messages.
        beginning: first bytes of the file.

    Raises:
        BadInput: it is not a binary PLY that begins with the element `vertex`.
    """
    elements, start = parse_elements(name, beginning)
    if not elements or elements[0][0] != "vertex":
        raise BadInput(
            f"{name} must begin with the element 'vertex'; given {[(kind, count) for kind, count, _ in elements]}"
        )
    _, count, dtype = elements[0]
    return count, dtype, start


def parse_elements(name: str, beginning: bytes) -> tuple[list[tuple[str, int, np.dtype[np.void]]], int]:
    """Return name, number of rows and row type of the elements, in order, and the offset of the first row.

    Elements after the first one are returned up to one that has rows of varying length.

    Args:
        name: of the file, for messages.
        beginning: first bytes of the file.

    Raises:
        BadInput: it is not a binary PLY, or its first element has rows of varying length.
    """
    header = _HEADER.match(beginning)
    if header is None:
        raise BadInput(f"{name} is not a PLY: it must start with 'ply' and have an 'end_header' line")
    lines = [line.split() for line in header[1].decode("ascii", "replace").splitlines()]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise BadInput(f"{name} must be 'format binary_little_endian 1.0'; export it in that format")
    found: list[tuple[str, int, list[tuple[str, str]]]] = []
    try:
        for words in lines:
            if words[0] == "element":
                found.append((words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"] and len(found) > 1:
                found.pop()
                break
            elif words[0] == "property":
                found[-1][2].append((words[2], _TYPES[words[1]]))
        elements = [(kind, count, np.dtype(properties)) for kind, count, properties in found]
    except (IndexError, KeyError, ValueError) as error:
        raise BadInput(f"{name} has a header that cannot be read: {error!r}") from error
    if any(count < 0 for _, count, _ in elements):
        raise BadInput(f"{name} has a header that cannot be read: a negative number of rows")
    return elements, header.end()
