"""The prior of a stage, from settings and files."""

import json
import zipfile
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.analytic import AnalyticPrior
from dg4d_lib.guidance.geometric import InflatedSurfaces
from dg4d_lib.guidance.interface import GuidancePrior
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.settings import GeometricPriorSettings, OraclePriorSettings, PriorSettings
from steps.media import read_png

GEOMETRIC_NOTE = "prior: inflation of the silhouette (no model); sides the picture does not show are guesses"
ORACLE_NOTE = "prior: the true views of a bank; for tests and benchmarks only"


def make_prior(
    settings: PriorSettings,
    cutouts: Sequence[Float[Tensor, "h w 4"]],
    noise_start: float,
    bank: Path | None,
    scratch: Path,
) -> tuple[GuidancePrior, str]:
    """The prior, and the sentence about it that the report shows.

    Args:
        settings: which one.
        cutouts: the subject at every frame (one in the static stage).
        noise_start: where the stage's annealing begins.
        bank: file of true views, for the oracle.
        scratch: a folder for unpacking.

    Raises:
        BadInput: the oracle without a bank.
    """
    match settings:
        case GeometricPriorSettings():
            surfaces = InflatedSurfaces(cutouts, settings)
            return AnalyticPrior(surfaces.clean, noise_start, settings.coverage_weight), GEOMETRIC_NOTE
        case OraclePriorSettings():
            if bank is None:
                raise BadInput("prior.kind = oracle needs true views: give --bank FOLDER (with a bank.json)")
            views = read_bank(bank, scratch)
            prior = AnalyticPrior(views.clean, noise_start, settings.coverage_weight, views.cameras, views.frames)
            return prior, ORACLE_NOTE


def read_bank(path: Path, scratch: Path) -> Bank:
    """A zip of bank.json and one sheet of tiles per view.

    bank.json: {"frames": [...], "tile": [rows, columns], "tile_size": px, "views": [{"file", "azimuth", "elevation",
    "radius"}]}, angles in degrees, positive elevation above.

    Raises:
        BadInput: no bank.json in it.
    """
    with zipfile.ZipFile(path) as archive:
        if "bank.json" not in archive.namelist():
            raise BadInput("the bank has no bank.json")
        archive.extractall(scratch)
    about = json.loads((scratch / "bank.json").read_text())
    (rows, columns), size, frames = about["tile"], about["tile_size"], about["frames"]
    cameras, sheets = [], []
    for view in about["views"]:
        cameras.append(OrbitCamera(view["elevation"], view["azimuth"], view["radius"], width=size, height=size))
        sheet = (read_png(scratch / view["file"]) * 255).round().to(torch.uint8)
        tiles = sheet.reshape(rows, size, columns, size, 4).transpose(1, 2).reshape(rows * columns, size, size, 4)
        sheets.append(tiles[: len(frames)])
    return Bank(tuple(cameras), tuple(frames), torch.stack(sheets))
