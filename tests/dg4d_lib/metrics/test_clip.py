"""CLIP with a tiny random model, against transformers and Pillow directly."""

import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_judges
import torch
from PIL import Image
from torch import Tensor

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.metrics.clip import ClipModel, cosine_similarity, load_clip

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_judges.write_clip(tmp_path_factory.mktemp("clip"))


@pytest.fixture(scope="module")
def clip(folder: Path) -> ClipModel:
    return load_clip(folder, CPU)


def pictures(size: int = 96, count: int = 3) -> Tensor:
    """Smooth ones, in whole levels of 255: rounding is not what is tested."""
    coarse = torch.rand(count, 3, 6, 6, generator=torch.Generator().manual_seed(2))
    smooth = torch.nn.functional.interpolate(coarse, (size, size), mode="bilinear")
    return (smooth * 255).round().movedim(1, -1) / 255


def test_embeddings_are_those_of_transformers(clip: ClipModel, folder: Path) -> None:
    from transformers import CLIPModel

    model = CLIPModel.from_pretrained(folder).eval()
    mean, deviation = np.array([0.48145466, 0.4578275, 0.40821073]), np.array([0.26862954, 0.26130258, 0.27577711])
    planes = []
    for picture in pictures():
        image = Image.fromarray((picture.numpy() * 255).round().astype(np.uint8)).resize((64, 64), Image.BICUBIC)
        planes.append(((np.asarray(image) / 255 - mean) / deviation).transpose(2, 0, 1))
    with torch.no_grad():
        vision = model.vision_model(pixel_values=torch.tensor(np.stack(planes), dtype=torch.float32))
        expected = torch.nn.functional.normalize(model.visual_projection(vision.pooler_output), dim=-1)
    torch.testing.assert_close(clip.embed(pictures()), expected, atol=2e-3, rtol=0)  # Pillow rounds to 8 bits


def test_a_picture_is_like_itself_and_less_like_others(clip: ClipModel) -> None:
    embedded = clip.embed(pictures())
    assert cosine_similarity(embedded, embedded).tolist() == pytest.approx([1, 1, 1])
    assert cosine_similarity(embedded[:1], embedded[1:2]).item() < 0.9999


def test_many_pictures_are_embedded_as_few_are(clip: ClipModel) -> None:
    many = pictures(count=20)
    torch.testing.assert_close(clip.embed(many)[17:18], clip.embed(many[17:18]), atol=1e-5, rtol=1e-4)


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="holds no CLIP model"):
        load_clip(tmp_path, CPU)


def test_without_transformers_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(BackendUnavailable, match="run `make setup`"):
        load_clip(tmp_path, CPU)
