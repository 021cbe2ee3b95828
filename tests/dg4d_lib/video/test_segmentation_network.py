import hashlib
import json
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
import torch
from tiny_onnx import tiny_model, write_network

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.video import u2netp
from dg4d_lib.video.segmentation_network import Preprocessing, load_folder, load_network, read_preprocessing

WEIGHTS, BIAS = (1.5, -2.0, 0.5), 0.25


def picture(side: int = 16) -> torch.Tensor:
    return torch.rand(side, side, 3, generator=torch.Generator().manual_seed(0))


def expected(mean: float, std: float) -> torch.Tensor:
    return torch.sigmoid(((picture() - mean) / std * torch.tensor(WEIGHTS)).sum(-1) + BIAS)


@pytest.mark.parametrize("sigmoid", [True, False], ids=["probabilities", "logits"])
def test_a_folder_in_the_layout_of_the_hub_answers_with_probabilities(tmp_path: Path, sigmoid: bool) -> None:
    folder = write_network(tmp_path / "net", mean=0.4, std=0.1, weights=WEIGHTS, bias=BIAS, sigmoid=sigmoid)
    assert torch.allclose(load_folder(folder).probability(picture()), expected(0.4, 0.1), atol=1e-5)


def test_the_answer_has_the_size_of_the_picture(tmp_path: Path) -> None:
    network = load_folder(write_network(tmp_path / "net", weights=WEIGHTS))
    assert network.probability(torch.rand(40, 23, 3)).shape == (40, 23)


def test_a_configuration_without_rescaling_counts_colors_up_to_255(tmp_path: Path) -> None:
    path = tmp_path / "preprocessor_config.json"
    config = {"do_rescale": False, "image_mean": [128] * 3, "image_std": [256] * 3, "size": {"width": 64, "height": 64}}
    path.write_text(json.dumps(config))
    assert read_preprocessing(path) == Preprocessing((128.0,) * 3, (256.0,) * 3, 1.0, 64)


@pytest.mark.parametrize(
    "text",
    ["[", "[]", '{"image_mean": [1, 2]}', '{"image_std": [0, 1, 1]}', '{"image_mean": ["a", 1, 1]}', '{"size": "big"}'],
)
def test_a_configuration_that_cannot_be_used_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "preprocessor_config.json"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"preprocessor_config\.json"):
        read_preprocessing(path)


@pytest.mark.parametrize("content", [b"", b"no model", tiny_model()[:-40]])
def test_a_file_that_is_no_model_is_refused(content: bytes) -> None:
    with pytest.raises(BadInput, match="not an ONNX model"):
        load_network(content, "net")


def test_a_model_of_other_inputs_is_refused() -> None:
    with pytest.raises(BadInput, match="not a segmentation network"):
        load_network(tiny_model(weights=(1.0,) * 4, channels=4), "net")


def test_a_model_that_answers_with_nan_is_refused() -> None:
    with pytest.raises(BadInput, match="not finite"):
        load_network(tiny_model(bias=float("nan")), "net").probability(picture())


def test_a_folder_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"no onnx/model\.onnx"):
        load_folder(tmp_path)


def test_the_packaged_file_has_the_pinned_digest() -> None:
    assert hashlib.sha256(u2netp.weights_file().read_bytes()).hexdigest() == u2netp.SHA256
    assert u2netp.digests() == {"u2netp/u2netp.onnx": f"sha256:{u2netp.SHA256}"}


def test_another_file_in_the_wheel_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = tmp_path / "u2netp.onnx"
    other.write_bytes(tiny_model())
    monkeypatch.setattr(u2netp, "weights_file", lambda: other)
    with pytest.raises(BadInput, match=r"Digest mismatch.*make setup.*--mask"):
        u2netp.packaged_network.__wrapped__()


def test_a_missing_wheel_says_how_to_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> Path:
        raise PackageNotFoundError

    monkeypatch.setattr(u2netp, "weights_file", missing)
    with pytest.raises(BackendUnavailable, match=r"missing.*make setup.*--mask"):
        u2netp.packaged_network.__wrapped__()
