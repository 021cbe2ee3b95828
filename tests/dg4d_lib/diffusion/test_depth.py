"""Depth networks in transformers' layout, with tiny random weights."""

import json
from pathlib import Path

import pytest
import torch

from dg4d_lib.diffusion.depth import DepthEstimator
from dg4d_lib.errors import BadInput

CPU = torch.device("cpu")


def save_tiny_depth(folder: Path) -> Path:
    """A DepthAnythingForDepthEstimation of a few thousand weights."""
    from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

    backbone = Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, image_size=28, patch_size=14,
        out_indices=[1, 2, 3, 4], apply_layernorm=True, reshape_hidden_states=False,
    )  # fmt: skip
    config = DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[4, 4, 4, 4], fusion_hidden_size=8,
        head_hidden_size=4, patch_size=14,
    )  # fmt: skip
    with torch.random.fork_rng():
        torch.manual_seed(0)
        DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps({"size": {"height": 60, "width": 60}}))
    return folder


def test_depth_has_the_size_of_the_picture_and_depends_on_it(tmp_path: Path) -> None:
    estimator = DepthEstimator.load(save_tiny_depth(tmp_path), CPU)
    picture = torch.rand(48, 48, 4, generator=torch.Generator().manual_seed(0))
    depth = estimator.disparity(picture)
    assert depth.shape == (48, 48) and bool(depth.isfinite().all())
    assert torch.equal(depth, estimator.disparity(picture))
    assert not torch.equal(depth, estimator.disparity(picture.flip(0)))


def test_a_preprocessor_without_a_size_is_refused(tmp_path: Path) -> None:
    save_tiny_depth(tmp_path)
    (tmp_path / "preprocessor_config.json").write_text("{}")
    with pytest.raises(BadInput, match="gives no size"):
        DepthEstimator.load(tmp_path, CPU)
