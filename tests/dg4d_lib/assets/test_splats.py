"""Splat sequences: standard PLY per frame, round trip."""

import os
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
from splat_readers import read_splat_glb

from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.assets.formats.splats import read_splats, write_splat_glb_frames, write_splats, write_spz_frames
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import read_ply, write_ply


@pytest.fixture
def states(red_dot: Gaussians, slide: Framewise) -> Gaussians:
    return pose_gaussians(red_dot, slide, 3, torch.arange(3.0))


def test_a_sequence_comes_back_exactly(tmp_path: Path, states: Gaussians) -> None:
    assert [path.name for path in write_splats(tmp_path, states)] == ["000.ply", "001.ply", "002.ply"]
    back = read_splats(tmp_path)
    assert all(torch.equal(getattr(back, name), value) for name, value in vars(states).items())


def test_every_file_is_the_cloud_at_its_frame(tmp_path: Path, states: Gaussians) -> None:
    write_splats(tmp_path, states)
    assert torch.equal(read_ply(tmp_path / "002.ply", y_down=True).means, states.means[2])


def test_every_spz_is_the_cloud_at_its_frame(tmp_path: Path, states: Gaussians) -> None:
    paths = write_spz_frames(tmp_path, states)
    assert [path.name for path in paths] == ["000.spz", "001.spz", "002.spz"]
    for path, means in zip(paths, states.means.numpy(), strict=True):
        np.testing.assert_allclose(gsply.read_spz(str(path)).means, means, atol=1 / 8192)


def test_every_splat_glb_is_the_cloud_at_its_frame(tmp_path: Path, states: Gaussians) -> None:
    paths = write_splat_glb_frames(tmp_path, states)
    assert [path.name for path in paths] == ["000.glb", "001.glb", "002.glb"]
    for path, means in zip(paths, states.means, strict=True):
        assert torch.equal(read_splat_glb(path.read_bytes()).means, means)


def test_a_gap_in_the_numbers_is_refused(tmp_path: Path, states: Gaussians) -> None:
    write_splats(tmp_path, states)
    (tmp_path / "001.ply").unlink()
    with pytest.raises(BadInput, match=r"without gaps; given 000\.ply to 002\.ply, 2 files"):
        read_splats(tmp_path)


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="given none"):
        read_splats(tmp_path)


def test_a_foreign_frame_is_refused(tmp_path: Path, states: Gaussians) -> None:
    write_splats(tmp_path, states)
    first = states.at(0)
    stranger = Gaussians(first.means, first.log_scales, first.quats, first.opacity_logits + 1, first.harmonics)
    write_ply(tmp_path / "001.ply", stranger)
    with pytest.raises(BadInput, match=r"001\.ply and 000\.ply are not frames of one sequence"):
        read_splats(tmp_path)


def test_a_fifo_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "000.ply")
    with pytest.raises(BadInput, match=r"000\.ply is not a file"):
        read_splats(tmp_path)
