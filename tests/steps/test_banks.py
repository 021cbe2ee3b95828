"""bank.json: what is refused is named by its field, with what was given and what is allowed."""

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from dg4d_lib.errors import BadInput
from steps.sources.banks import MOST_PIXELS, check_sheet, read_index

VIEW = {"file": "0.png", "azimuth": 0.0, "elevation": -20, "radius": 2}
SOUND: dict[str, Any] = {"frames": [0, 2], "tile": [1, 2], "tile_size": 8, "views": [VIEW]}


def written(path: Path, **changes: Any) -> Path:
    path.write_text(json.dumps(SOUND | changes))
    return path


def test_whole_numbers_and_further_keys_are_read(tmp_path: Path) -> None:
    index = read_index(written(tmp_path / "bank.json", fovy=49.1, views=[VIEW | {"c2w": [[1.0]]}]))
    assert index.sheet_size == (16, 8) and index.frames == (0, 2)
    assert (index.views[0].elevation, index.views[0].radius) == (-20.0, 2.0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"frames": "ab"}, "frames is 'ab', and should be a valid array"),
        ({"frames": [0, "1"]}, r"frames\.1 is '1', and should be a valid integer"),
        ({"frames": [0, True]}, r"frames\.1 is True, and should be a valid integer"),
        ({"frames": [0, -1]}, r"frames\.1 is -1, and should be greater than or equal to 0"),
        ({"frames": [1, 1]}, "names a frame twice"),
        ({"frames": [0, 1, 2]}, r"frames has 3 entries and tile = \[1, 2\] has room for 2"),
        ({"tile": [1]}, r"tile\.1 is missing"),
        ({"tile": [10**9, 1]}, r"tile\.0 is 1000000000, and should be less than or equal to 10000"),
        ({"tile": [100, 100], "tile_size": 100}, "sheets of 10000 x 10000 pixels; at most 67 million"),
        ({"tile_size": 0.5}, r"tile_size is 0\.5, and should be a valid integer"),
        ({"views": [VIEW | {"azimuth": float("nan")}]}, r"views\.0\.azimuth is nan, and should be a finite number"),
        ({"views": [VIEW | {"azimuth": "left"}]}, r"views\.0\.azimuth is 'left', and should be a valid number"),
        ({"views": [VIEW | {"elevation": 91}]}, r"views\.0\.elevation is 91.*less than or equal to 90"),
        ({"views": [VIEW | {"radius": 0}]}, r"views\.0\.radius is 0.*greater than 0"),
        ({"views": [VIEW, VIEW | {"file": "../0.png"}]}, r"outside of the bank: views\.1\.file is '\.\./0\.png'"),
        ({"views": [VIEW | {"file": "9" * 5000 + ".png"}]}, r"views\.0\.file is .*too long"),
        ({"views": [VIEW | {"file": "0.null"}]}, r"views\.0\.file is '0\.null'.*end in \.png"),
        ({"views": [VIEW] * 10_000, "tile_size": 1024}, f"at most {MOST_PIXELS // 1_000_000} million are allowed"),
    ],
)
def test_a_wrong_field_is_named_with_its_value_and_what_is_allowed(
    tmp_path: Path, changes: dict[str, Any], says: str
) -> None:
    with pytest.raises(BadInput, match=says) as refusal:
        read_index(written(tmp_path / "bank.json", **changes))
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 500 + len(str(tmp_path))


def test_a_bank_without_its_description_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="cannot be read: No such file"):
        read_index(tmp_path / "bank.json")


def header(width: int, height: int) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII5B", 13, b"IHDR", width, height, 8, 6, 0, 0, 0)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (header(8, 16), r"is 8 x 16 pixels; tile = \[1, 2\] and tile_size = 8 ask for 16 x 8"),
        (header(16, 8)[:20], "cut off or broken"),
        (b"\xff\xd8\xff\xe0", "is not a PNG"),
        (b"words", "text file"),
    ],
)
def test_a_sheet_is_a_png_of_the_size_that_its_tiles_ask_for(tmp_path: Path, content: bytes, says: str) -> None:
    index = read_index(written(tmp_path / "bank.json"))
    sheet = tmp_path / "0.png"
    sheet.write_bytes(header(16, 8))
    check_sheet(sheet, index)
    sheet.write_bytes(content)
    with pytest.raises(BadInput, match=says):
        check_sheet(sheet, index)
