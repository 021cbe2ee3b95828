"""The PLY file every splat viewer reads (the layout of Kerbl et al. 2023), color of degree 0.

Binary little endian, one float32 row per Gaussian: x y z, nx ny nz (zeros), f_dc_0..2, opacity (logit), scale_0..2
(natural logarithm), rot_0..3 (wxyz). These are the raw parameters, so a file holds a cloud exactly.
"""

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

MAX_HEADER = 65536  # bytes; a longer one is not a header
_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1"}
_TYPES |= {"int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "short": "<i2", "ushort": "<u2", "char": "i1"}


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Write one cloud (no leading batch, color of degree 0); equal clouds give equal bytes.

    Raises:
        BadInput: the cloud carries a batch or color of a higher degree, which this layout would lose, or numbers that
            are not finite.
        OSError: the file could not be written.
    """
    check_storable(gaussians, "a PLY")
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


def read_ply(path: Path) -> Gaussians:
    """Read a cloud; the columns may stand in any order and others beside them are ignored.

    Raises:
        BadInput: it is missing or broken, no splat PLY, or holds view-dependent color or numbers that are not finite.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BadInput(f"{path.name} cannot be read: {error.strerror}") from error
    count, dtype, start = _header(path.name, content[:MAX_HEADER])
    names = dtype.names or ()
    missing = [name for name in COLUMNS if name not in names and name not in NORMALS]
    if missing:
        raise BadInput(f"{path.name} is no splat PLY: it lacks {', '.join(missing)}; needed are {', '.join(COLUMNS)}")
    if any(name.startswith("f_rest_") for name in names):
        raise BadInput(f"{path.name} holds color of a higher degree (f_rest_*); save it with degree 0")
    if len(content) < start + count * dtype.itemsize:
        rows_there = max(0, len(content) - start) // dtype.itemsize
        raise BadInput(f"{path.name} is cut off: {count} Gaussians announced, {rows_there} there; write it again")
    rows = np.frombuffer(content, dtype, count, start)

    def columns(wanted: tuple[str, ...]) -> torch.Tensor:
        return torch.from_numpy(np.stack([rows[name] for name in wanted], 1).astype(np.float32))

    parts = [columns(wanted) for wanted in (MEANS, SCALES, QUATS, OPACITY, COLORS)]
    if not all(part.isfinite().all() for part in parts):
        raise BadInput(f"{path.name} holds numbers that are not finite; make it again")
    means, log_scales, quats, opacity, colors = parts
    return Gaussians(means, log_scales, quats, opacity[:, 0], colors[:, None])


def check_storable(gaussians: Gaussians, form: str) -> None:
    """Whether a file of one state and constant colors can hold this cloud.

    Args:
        gaussians: what is to be written.
        form: what the file is called in the message.

    Raises:
        BadInput: the cloud carries a batch, color of a higher degree, or numbers that are not finite.
    """
    if gaussians.means.dim() != 2 or gaussians.harmonics.shape[1] != 1:
        shapes = f"means {tuple(gaussians.means.shape)}, harmonics {tuple(gaussians.harmonics.shape)}"
        raise BadInput(f"{form} holds one state with one harmonics base: means n 3, harmonics n 1 3; given {shapes}")
    broken = [name for name, values in vars(gaussians).items() if not bool(values.isfinite().all())]
    if broken:
        raise BadInput(f"{form} holds finite numbers; given others in {', '.join(broken)}; fit the Gaussians again")


def _header(name: str, beginning: bytes) -> tuple[int, np.dtype[np.void], int]:
    """Number of rows, type of a row, where the rows begin."""
    end = beginning.find(b"end_header\n")
    if not beginning.startswith(b"ply\n") or end < 0:
        raise BadInput(f"{name} is no PLY: it must begin with 'ply' and have an 'end_header' line")
    lines = [line.split() for line in beginning[:end].decode("ascii", "replace").splitlines()[1:]]
    lines = [words for words in lines if words and words[0] not in ("comment", "obj_info")]
    if ["format", "binary_little_endian", "1.0"] not in lines:
        raise BadInput(f"{name} must be 'format binary_little_endian 1.0'; save it in that form")
    try:
        elements = [(words[1], int(words[2])) for words in lines if words[0] == "element"]
        properties = [(words[2], _TYPES[words[1]]) for words in lines if words[0] == "property"]
        (kind, count), dtype = elements[0], np.dtype(properties)
    except (IndexError, KeyError, ValueError) as error:
        raise BadInput(f"{name} has a header that cannot be read: {error!r}") from error
    if len(elements) != 1 or kind != "vertex" or count < 0:
        raise BadInput(f"{name} must hold one element, 'vertex'; given {elements}")
    return count, dtype, end + len(b"end_header\n")
