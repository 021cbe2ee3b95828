"""Splats of other programs."""

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from dg4d_lib.assets.formats.foreign_splats import read_foreign_ply, read_spz
from dg4d_lib.assets.formats.spz import write_spz
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.geometry.quaternion import quat_to_rotmat


@pytest.fixture
def cloud() -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    means, quats, colors = (torch.randn(20, k, generator=generator) for k in (3, 4, 3))
    return Gaussians(means, -3 + 0.3 * means, quats, torch.linspace(-3, 3, 20), 0.5 * colors[:, None])


def test_spz_comes_back_as_exact_as_it_is_stored(cloud: Gaussians, tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", cloud)
    read, notes = read_spz((tmp_path / "a.spz").read_bytes(), 100)
    torch.testing.assert_close(read.means, cloud.means, atol=1 / 8192, rtol=0)
    torch.testing.assert_close(read.log_scales, cloud.log_scales, atol=1 / 32, rtol=0)
    torch.testing.assert_close(read.opacities, cloud.opacities, atol=1 / 510, rtol=0)
    torch.testing.assert_close(read.harmonics, cloud.harmonics, atol=1 / 76, rtol=0)
    torch.testing.assert_close(quat_to_rotmat(read.quats), quat_to_rotmat(cloud.quats), atol=0.01, rtol=0)
    assert notes == ()


def test_rotations_of_version_2_are_read() -> None:
    xyz = np.array([[0, 0, 0], [255, 127, 127], [127, 255, 127], [127, 127, 127]], np.uint8)
    body = bytes(4 * 9) + bytes(4) + bytes(4 * 3) + bytes(4 * 3) + xyz.tobytes()
    content = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, 4, 0, 12, 0, 0) + body)
    read, _ = read_spz(content, 100)
    torch.testing.assert_close(read.quats[1], torch.tensor([0.0, 1, 0, 0]), atol=0.01, rtol=0)
    torch.testing.assert_close(read.quats[3], torch.tensor([1.0, 0, 0, 0]), atol=0.01, rtol=0)


def test_color_of_higher_degrees_is_dropped_and_said(cloud: Gaussians, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", cloud)
    header, rows = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    wide = np.frombuffer(rows, "<f4").reshape(20, -1)
    wide = np.concatenate([wide, np.ones((20, 1), "<f4")], 1)
    content = header + b"property float f_rest_0\nend_header\n" + wide.astype("<f4").tobytes()
    read, notes = read_foreign_ply(content, 100)
    assert torch.equal(read.harmonics, cloud.harmonics)
    assert "base color" in notes[0]


def test_the_number_of_splats_is_limited(cloud: Gaussians, tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", cloud)
    with pytest.raises(BadInput, match=r"20 splats; asset\.max_splats allows 10"):
        read_spz((tmp_path / "a.spz").read_bytes(), 10)


def test_a_header_that_promises_too_much_is_refused() -> None:
    with pytest.raises(BadInput, match=r"asset\.max_splats"):
        read_spz(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 2**31, 0, 12, 0, 0)), 100)


@pytest.mark.parametrize(
    "content",
    [b"", b"\x1f\x8b", gzip.compress(b"NGSP"), gzip.compress(b"x" * 64)],
    ids=["nothing", "no content", "a cut header", "another content"],
)
def test_broken_spz_gets_a_sentence(content: bytes) -> None:
    with pytest.raises(BadInput, match="SPZ"):
        read_spz(content, 100)


def test_nan_in_splats_is_refused(cloud: Gaussians, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", cloud)
    content = bytearray((tmp_path / "a.ply").read_bytes())
    content[-4:] = struct.pack("<f", float("nan"))
    with pytest.raises(BadInput, match="not finite"):
        read_foreign_ply(bytes(content), 100)
