"""Views by an image-editing pipeline, with tiny random weights."""

from pathlib import Path

import pytest
import torch
from tiny_qwen_edit import save_tiny_lora, save_tiny_qwen_edit, shrink_inputs
from tiny_text_to_image import save_pipeline

from dg4d_lib.diffusion.view_generation import ViewDirection, ViewGenerator, directions_of
from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import ImageEditViewsSettings

CPU = torch.device("cpu")
SMALL = ImageEditViewsSettings(size=64, num_inference_steps=2)
PICTURE = torch.linspace(0, 1, 48 * 48 * 3).reshape(48, 48, 3)
BACK = ViewDirection(180, 0)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_tiny_qwen_edit(tmp_path_factory.mktemp("models") / "qwen")


@pytest.fixture(autouse=True)
def few_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_inputs(monkeypatch)


def test_eight_azimuths_and_two_elevations_are_fifteen_views_beside_the_input() -> None:
    found = directions_of(ImageEditViewsSettings())
    assert len(found) == len(set(found)) == 15 and ViewDirection(0, 0) not in found
    assert ViewDirection(0, 30) in found


def test_the_prompt_has_the_words_of_the_lora() -> None:
    assert ViewDirection(135, 30).prompt(", white") == "<sks> back-right quarter view elevated shot medium shot, white"


def test_views_are_drawn_and_the_prompt_the_lora_and_the_seed_count(model: Path, tmp_path: Path) -> None:
    plain = ViewGenerator.load(model, None, SMALL, CPU)
    steps: list[tuple[int, int]] = []
    first, side = plain.generate(PICTURE, [BACK, ViewDirection(90, 30)], 0, lambda *each: steps.append(each))
    assert first.shape == (64, 64, 3) and 0 <= float(first.min()) <= float(first.max()) <= 1
    assert steps == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert not torch.equal(first, side)
    assert torch.equal(plain.generate(PICTURE, [BACK], 0)[0], first)
    assert not torch.equal(plain.generate(PICTURE, [BACK], 1)[0], first)
    tuned = ViewGenerator.load(model, save_tiny_lora(tmp_path / "lora"), SMALL, CPU)
    assert not torch.equal(tuned.generate(PICTURE, [BACK], 0)[0], first)


def test_a_pipeline_of_words_alone_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"StableDiffusionPipeline .* is not an image-editing pipeline"):
        ViewGenerator.load(save_pipeline(tmp_path / "words"), None, SMALL, CPU)
