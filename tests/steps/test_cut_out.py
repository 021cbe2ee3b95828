"""The quick cut-out: matte in the pixels of the picture, a box, given alpha, and nothing found."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from dg4d_lib.input_settings import SubjectSettings
from steps.artifacts.media import read_png, write_png
from steps.catalog import STEPS
from steps.cut_out import LONGEST, run
from steps.profiles import settings_class
from steps.runtime.job import Job


@pytest.fixture
def disk() -> torch.Tensor:
    """A red disk of radius 30 at (100, 60) in a white picture of 200 x 120 pixels."""
    rows, columns = torch.meshgrid(torch.arange(120.0), torch.arange(200.0), indexing="ij")
    inside = ((rows - 60) ** 2 + (columns - 100) ** 2 < 900)[..., None]
    return torch.where(inside, torch.tensor([0.8, 0.1, 0.1]), torch.ones(3))


def cut(picture: torch.Tensor, folder: Path, **subject: Any) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Return picture, matte and facts of the step."""
    write_png(folder / "source.png", picture)
    spec = STEPS["cut_out"]
    outputs = {name: folder / f"{name}{port.suffix}" for name, port in spec.outputs.items()}
    settings = settings_class(spec)(subject=SubjectSettings(size=64, **subject))
    run(Job({"source": folder / "source.png"}, outputs, settings, 0, lambda *_: None, folder))
    return (
        read_png(outputs["picture"]),
        read_png(outputs["matte"]),
        json.loads(outputs["facts"].read_text(encoding="utf-8")),
    )


def overlap(matte: torch.Tensor, disk: torch.Tensor) -> float:
    expected = disk[..., 1] < 0.5
    height, width = matte.shape[:2]
    small = torch.nn.functional.interpolate(expected[None, None].float(), (height, width), mode="area")[0, 0] > 0.5
    found = matte[..., 0] > 0.5
    return float((found & small).sum() / (found | small).sum())


def test_the_matte_lies_over_the_subject(disk: torch.Tensor, tmp_path: Path) -> None:
    picture, matte, facts = cut(disk, tmp_path)
    assert picture.shape[:2] == (120, 200)
    assert overlap(matte, disk) > 0.9
    assert (facts["width"], facts["height"], facts["kind"], facts["problem"]) == (200, 120, "picture", "")
    assert facts["notes"]


def test_nothing_is_kept_outside_of_the_box(disk: torch.Tensor, tmp_path: Path) -> None:
    _, matte, _ = cut(disk, tmp_path, box=(60, 20, 40, 80))
    assert matte[..., 0].mean() > 0.02
    assert float(matte[:, matte.shape[1] // 2 + 1 :].max()) == 0


def test_a_large_picture_with_alpha_keeps_it_at_a_smaller_size(disk: torch.Tensor, tmp_path: Path) -> None:
    given = torch.cat([disk, (disk[..., 1:2] < 0.5).float()], -1).repeat_interleave(8, 0).repeat_interleave(8, 1)
    picture, matte, facts = cut(given, tmp_path)
    assert max(picture.shape) == LONGEST and picture.shape[:2] == matte.shape[:2]
    assert overlap(matte, disk) > 0.95
    assert facts["has_alpha"] and facts["width"] == 1600


def test_a_picture_without_a_subject_gives_an_empty_matte_and_a_sentence(tmp_path: Path) -> None:
    _, matte, facts = cut(torch.zeros(40, 40, 4), tmp_path)
    assert float(matte.max()) == 0 and facts["problem"]
