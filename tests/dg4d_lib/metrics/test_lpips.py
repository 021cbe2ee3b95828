"""LPIPS with a narrow random network in the published formats, against a twin in NumPy."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.signal import correlate
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.metrics.lpips import STAGES, load_lpips

WIDTHS = (2, 3, 4, 3, 2)  # channels of the stages; VGG16 has 64, 128, 256, 512, 512
CPU = torch.device("cpu")


def network(seed: int = 0) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    generator = torch.Generator().manual_seed(seed)
    vgg, heads, before = {}, {}, 3
    for number, (stage, width) in enumerate(zip(STAGES, WIDTHS, strict=True)):
        for k in stage:
            vgg[f"features.{k}.weight"] = torch.randn(width, before, 3, 3, generator=generator) / 3
            vgg[f"features.{k}.bias"] = torch.randn(width, generator=generator) / 5
            before = width
        heads[f"lin{number}.model.1.weight"] = torch.rand(1, width, 1, 1, generator=generator)
    return {**vgg, "classifier.0.weight": torch.zeros(2, 2)}, heads


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """As timm and the authors publish them: a folder with safetensors, and a pickle of tensors."""
    vgg, heads = network()
    (tmp_path / "vgg16").mkdir()
    save_file(vgg, tmp_path / "vgg16" / "model.safetensors")
    torch.save(heads, tmp_path / "vgg.pth")
    return tmp_path / "vgg16", tmp_path / "vgg.pth"


def pictures(count: int = 2, seed: int = 5) -> Tensor:
    return torch.rand(count, 32, 32, 3, generator=torch.Generator().manual_seed(seed))


def twin(a: np.ndarray, b: np.ndarray, vgg: dict[str, Tensor], heads: dict[str, Tensor]) -> float:
    """The distance of two pictures [h w 3], channel by channel."""
    features = []
    for picture in (a, b):
        shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
        planes = ((2 * picture.astype(np.float64) - 1 - shift) / scale).transpose(2, 0, 1)
        found = []
        for number, stage in enumerate(STAGES):
            if number:
                c, h, w = planes.shape
                planes = planes.reshape(c, h // 2, 2, w // 2, 2).max((2, 4))
            for k in stage:
                weight, bias = (vgg[f"features.{k}.{name}"].double().numpy() for name in ("weight", "bias"))
                padded = np.pad(planes, ((0, 0), (1, 1), (1, 1)))
                planes = np.stack([correlate(padded, one, "valid")[0] for one in weight]) + bias[:, None, None]
                planes = np.maximum(planes, 0)
            found.append(planes / (np.sqrt((planes**2).sum(0)) + 1e-10))
        features.append(found)
    heads_of = [heads[f"lin{k}.model.1.weight"].double().numpy().reshape(-1, 1, 1) for k in range(5)]
    return float(sum((h * (x - y) ** 2).sum(0).mean() for h, x, y in zip(heads_of, *features, strict=True)))


def test_the_distance_is_the_twins(files: tuple[Path, Path]) -> None:
    images, truth = pictures(), pictures(seed=6)
    found = load_lpips(*files, CPU)(images, truth)
    expected = [twin(a, b, *network()) for a, b in zip(images.numpy(), truth.numpy(), strict=True)]
    assert found.tolist() == pytest.approx(expected, rel=1e-4)
    assert min(expected) > 0.01


def test_equal_pictures_are_not_apart(files: tuple[Path, Path]) -> None:
    assert load_lpips(*files, CPU)(pictures(), pictures()).tolist() == [0, 0]


def test_pictures_are_judged_one_by_one(files: tuple[Path, Path]) -> None:
    lpips = load_lpips(*files, CPU)
    images, truth = pictures(9), pictures(9, seed=6)
    whole = lpips(images, truth)
    alone = torch.cat([lpips(images[i : i + 1], truth[i : i + 1]) for i in range(9)])
    torch.testing.assert_close(whole, alone)


def test_torchvisions_own_file_is_read_too(files: tuple[Path, Path], tmp_path: Path) -> None:
    torch.save(network()[0], tmp_path / "vgg16-397923af.pth")
    images, truth = pictures(), pictures(seed=6)
    found = load_lpips(tmp_path / "vgg16-397923af.pth", files[1], CPU)(images, truth)
    torch.testing.assert_close(found, load_lpips(*files, CPU)(images, truth), rtol=0, atol=0)


def test_files_that_hold_something_else_are_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"tensor 'lin0"):
        load_lpips(files[0], files[0], CPU)
    (tmp_path / "broken.pth").write_bytes(b"no pickle")
    with pytest.raises(BadInput, match=r"broken\.pth cannot be read"):
        load_lpips(files[0], tmp_path / "broken.pth", CPU)
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match="has no tensors"):
        load_lpips(tmp_path / "empty", files[1], CPU)
