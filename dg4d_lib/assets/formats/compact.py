"""Lossless compact format: canonical Gaussians and their deformation in one safetensors file.

The metadata key `asset4d` holds JSON: `format` and `version`; `settings` of the deformation, of which `kind` selects
the model; `frames`, `fps`, `gaussians`; `last_time`, the time of the last frame on the deformation's axis from 0 to
1; `tensors`, a description of each. Tensors of the Gaussians are stored under `gaussians.`, those of the deformation
under `deformation.`. The output of a deformation is added to means, log scales and quaternions as stored; after the
last frame they are interpolated linearly to the first. `examples/load_compact.py` reads the file without this library.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from dg4d_lib.deformation.factory import AnyDeformation, deformation_tensors, from_state_dict, last_time
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import check_storable
from dg4d_lib.settings import DeformationSettings

KEY = "asset4d"
FORMAT = {"format": "dg4d-compact", "version": 1}
GAUSSIANS, DEFORMATION = "gaussians.", "deformation."
TENSORS = {
    "gaussians.means": "n 3; at rest, world units: right-handed, y up, the front looks along +z",
    "gaussians.log_scales": "n 3; natural logarithms of the standard deviations",
    "gaussians.quats": "n 4; rotations, wxyz, any length but zero",
    "gaussians.opacity_logits": "n; logits of the opacities",
    "gaussians.harmonics": "n 1 3; sRGB color = 0.28209479 * harmonics + 0.5",
    "deformation.bounds": "2 3; the box that maps to the planes' ends, or to [-1, 1]",
    "deformation.space.i": "3 c r r; planes xy, xz, yz of level i: the first axis along columns, ends on the box",
    "deformation.time.i": "3 c t r; planes xt, yt, zt of level i: time along rows, from 0 to 1",
    "deformation.trunk": "linear, of the products of the six samples of all levels; then relu: h",
    "deformation.first, deformation.second": "linear, relu after each; in: place, time in [-1, 1]; sines, cosines",
    "deformation.heads.NAME": "what is added to gaussians.NAME: outer(h + inner(h)), both linear",
    "deformation.field.NAME": "with parts: the tensors above and below, of what is added to the motion of the parts",
    "deformation.owners": "n; rigid part of every Gaussian",
    "deformation.rest": "n 4; rotations of the Gaussians that the parts turn, wxyz",
    "deformation.centers": "k 3; of the parts at rest",
    "deformation.quats, deformation.places": "t k 4, t k 3; rotations and centers of the parts at every frame",
    "deformation.table": "t n 10; what is added at every frame: 3 to means, 3 to log_scales, 4 to quats",
}


@dataclass(frozen=True)
class CompactAsset:
    """Content of a compact file.

    Attributes:
        gaussians: the canonical cloud.
        deformation: its motion.
        settings: kind and sizes of the deformation.
        frames: number of frames of the animation.
        fps: frames per second.
    """

    gaussians: Gaussians
    deformation: AnyDeformation
    settings: DeformationSettings
    frames: int
    fps: float


def write_compact(path: Path, asset: CompactAsset) -> None:
    """Write a compact file; equal assets give equal bytes.

    Raises:
        BadInput: the Gaussians carry a batch, color of a higher degree, or numbers that are not finite.
        OSError: the file could not be written.
    """
    check_storable(asset.gaussians, "a compact asset")
    tensors = {GAUSSIANS + name: value.detach().cpu().contiguous() for name, value in vars(asset.gaussians).items()}
    tensors |= {DEFORMATION + name: value for name, value in deformation_tensors(asset.deformation).items()}
    about = {
        **FORMAT,
        "settings": asset.settings.model_dump(mode="json"),
        "frames": asset.frames,
        "fps": asset.fps,
        "gaussians": len(asset.gaussians),
        "last_time": last_time(asset.settings, asset.frames),
        "tensors": TENSORS,
    }
    path.write_bytes(save(tensors, {KEY: json.dumps(about, sort_keys=True)}))


def read_compact(path: Path) -> CompactAsset:
    """Read the output of `write_compact`, losslessly.

    Raises:
        BadInput: the file is missing, corrupt or of another format.
    """
    if not path.is_file():  # reading a FIFO may never end
        raise BadInput(f"{path.name} is not a compact asset (no such file); pack the asset again")
    try:
        with safe_open(path, "pt") as file:
            about: dict[str, Any] = json.loads((file.metadata() or {})[KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no dict)
        found = {name: about[name] for name in FORMAT}
        if found != FORMAT:
            raise BadInput(
                f"{path.name} has the format {found['format']} version {found['version']}; this program reads "
                f"{FORMAT['format']} version {FORMAT['version']}: pack the asset again"
            )
        settings: DeformationSettings = TypeAdapter(DeformationSettings).validate_python(about["settings"])
        parts = {
            prefix: {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
            for prefix in (GAUSSIANS, DEFORMATION)
        }
        gaussians = Gaussians(**parts[GAUSSIANS])
        deformation = from_state_dict(settings, parts[DEFORMATION], about["frames"], len(gaussians))
        return CompactAsset(gaussians, deformation, settings, about["frames"], about["fps"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, ValidationError, RuntimeError) as error:
        raise BadInput(f"{path.name} is not a compact asset ({error}); pack the asset again") from error
