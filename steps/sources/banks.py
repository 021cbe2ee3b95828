"""Format of view banks: `bank.json` and the headers of its sheets. Imports no torch.

A bank holds ground-truth views: a folder, or a zip, with `bank.json` and one PNG sheet per view, whose tiles are the
frames, row by row.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dg4d_lib.errors import BadInput, quoted
from steps.artifacts.archives import can_exist, stays_inside
from steps.sources.media_types import check_still
from steps.sources.still_headers import read_header

BANK_JSON = "bank.json"
LARGEST_BANK_JSON = 16 * 2**20  # bytes; 10,000 views take 1 MB
MOST_VIEWS = 10_000
MOST_SHEET_PIXELS = 2**26  # 8,192 x 8,192: 1 GiB while a sheet is decoded to floats
MOST_PIXELS = 2**30  # of all frames of all views, kept as 8-bit RGBA: 4 GiB
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


class _Strict(BaseModel):
    """Frozen model without type conversions; unknown keys are ignored, as banks describe more than is read."""

    model_config = ConfigDict(extra="ignore", frozen=True, strict=True, allow_inf_nan=False)


class BankView(_Strict):
    """Camera and sheet of one view.

    Attributes:
        file: name of the sheet within the bank.
        azimuth: degrees, 0 is the input view.
        elevation: degrees, positive above.
        radius: distance from the origin, world units.
        weight: reliability of the pictures; below 1 for generated ones that disagree with others.
    """

    file: str = Field(min_length=1)
    azimuth: float = Field(ge=-360, le=360)
    elevation: float = Field(ge=-90, le=90)
    radius: float = Field(gt=0, le=1000)
    weight: float = Field(1.0, ge=0, le=1)


class BankIndex(_Strict):
    """Content of `bank.json`.

    Attributes:
        frames: indices into the driving video, one per tile.
        tile: rows and columns of tiles in a sheet.
        tile_size: side of a tile, pixels.
        views: one per sheet.
    """

    frames: tuple[Annotated[int, Field(ge=0, le=1_000_000)], ...] = Field(min_length=1)
    tile: tuple[Annotated[int, Field(ge=1, le=10_000)], Annotated[int, Field(ge=1, le=10_000)]]
    tile_size: int = Field(ge=1, le=8192)
    views: tuple[BankView, ...] = Field(min_length=1, max_length=MOST_VIEWS)

    @property
    def sheet_size(self) -> tuple[int, int]:
        """Width and height of every sheet, pixels."""
        rows, columns = self.tile
        return columns * self.tile_size, rows * self.tile_size

    @model_validator(mode="after")
    def _fits(self) -> Self:
        rows, columns = self.tile
        width, height = self.sheet_size
        if len(set(self.frames)) < len(self.frames):
            raise ValueError("frames names a frame twice; every frame may be named once")
        if len(self.frames) > rows * columns:
            raise ValueError(
                f"frames has {len(self.frames)} entries and tile = [{rows}, {columns}] has room for {rows * columns}; "
                "at most one per tile is allowed"
            )
        if width * height > MOST_SHEET_PIXELS:
            raise ValueError(
                f"tile and tile_size make sheets of {width} x {height} pixels; at most "
                f"{MOST_SHEET_PIXELS // 1_000_000} million are allowed"
            )
        if (pixels := len(self.views) * len(self.frames) * self.tile_size**2) > MOST_PIXELS:
            raise ValueError(
                f"views, frames and tile_size make {pixels // 1_000_000} million pixels; at most "
                f"{MOST_PIXELS // 1_000_000} million are allowed"
            )
        return self


def read_index(path: Path) -> BankIndex:
    """Read a `bank.json`.

    Raises:
        BadInput: it is too large, no JSON or of another form, or names a sheet that cannot lie in the bank.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_BANK_JSON:
            raise BadInput(f"{path} has {size} bytes; at most {LARGEST_BANK_JSON} are read")
        index = BankIndex.model_validate_json(path.read_bytes())
    except OSError as error:
        raise BadInput(f"{path} cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise BadInput(f"{path} does not describe the views of a bank: {_sentence(first)}") from error
    for number, view in enumerate(index.views):
        _check_name(path, f"views.{number}.file", view.file)
    return index


def check_sheet(path: Path, index: BankIndex) -> None:
    """Refuse a sheet that is not a PNG of the size that `bank.json` gives; only the header is read.

    Raises:
        BadInput: says what it is and what is allowed.
    """
    check_still(path)
    with path.open("rb") as file:
        if file.read(len(PNG_SIGNATURE)) != PNG_SIGNATURE:
            raise BadInput(f"the sheet {path.name} of the bank is not a PNG; export it as PNG with alpha")
    header = read_header(path, ".png")
    if header is None:
        raise BadInput(f"the sheet {path.name} of the bank is cut off or broken; export it again")
    if (header.width, header.height) != index.sheet_size:
        rows, columns = index.tile
        raise BadInput(
            f"the sheet {path.name} of the bank is {header.width} x {header.height} pixels; tile = [{rows}, {columns}] "
            f"and tile_size = {index.tile_size} ask for {index.sheet_size[0]} x {index.sheet_size[1]}"
        )


def _check_name(path: Path, field: str, name: str) -> None:
    """Refuse names that lead out of the bank, and suffixes that would select another decoder than that of PNG."""
    if not stays_inside(name):
        raise BadInput(f"{path} names a picture outside of the bank: {field} is {quoted(name)}; name one in the bank")
    if not can_exist(name):
        raise BadInput(f"{path}: {field} is {quoted(name)}, which is too long for the name of a file")
    if not name.lower().endswith(".png"):
        raise BadInput(f"{path}: {field} is {quoted(name)}; sheets of a bank are PNG files, whose names end in .png")


def _sentence(error: Mapping[str, Any]) -> str:
    """Return the field that is wrong, its value and the allowed values as a sentence."""
    where, reason = ".".join(map(str, error["loc"])), str(error["msg"])
    if error["type"] in ("json_invalid", "value_error"):
        return reason.removeprefix("Value error, ")
    if error["type"] == "missing":
        return f"{where} is missing"
    return f"{where or 'the whole'} is {quoted(error['input'])}, and {reason.removeprefix('Input ')}"
