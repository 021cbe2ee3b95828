"""Splats of other programs."""

import gzip
import struct
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
import zstandard

from dg4d_lib.assets.formats.foreign_splats import read_foreign_ply, read_spz
from dg4d_lib.assets.formats.spz import write_spz
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.geometry.spherical_harmonics import sh_to_rgb


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


def test_both_versions_of_spz_hold_the_same(cloud: Gaussians, tmp_path: Path) -> None:
    write_spz(tmp_path / "3.spz", cloud)
    write_spz(tmp_path / "4.spz", cloud, 4)
    three, four = (read_spz((tmp_path / f"{version}.spz").read_bytes(), 100)[0] for version in (3, 4))
    assert all(torch.equal(getattr(three, field.name), getattr(four, field.name)) for field in fields(three))


def spz4(**changes: int) -> bytes:
    """Return an SPZ of version 4 with 4 splats of zeros; changed in what its header and table say."""
    said = {"count": 4, "degree": 0, "streams": 5, "table": 32, "first": 36} | changes
    frames = [zstandard.ZstdCompressor().compress(bytes(4 * size)) for size in (9, 1, 3, 3, 4)]
    sizes = [(len(frame), 4 * size) for frame, size in zip(frames, (9, 1, 3, 3, 4), strict=True)]
    sizes[0] = (sizes[0][0], said["first"])
    header = struct.pack("<4sIIBBBB", b"NGSP", 4, said["count"], said["degree"], 12, 0, said["streams"])
    table = b"".join(struct.pack("<QQ", *row) for row in sizes)
    return header + struct.pack("<I12x", said["table"]) + table + b"".join(frames)


def test_version_4_of_splats_of_zeros_is_read() -> None:
    read, notes = read_spz(spz4(degree=3), 100)
    assert not read.means.any() and "base color" in notes[0]


@pytest.mark.parametrize(
    "content",
    [spz4(streams=4), spz4(table=0), spz4(first=37), spz4(count=5), spz4()[:-40], spz4()[:70] + spz4()[71:]],
    ids=["too few streams", "a table in the header", "a wrong size", "too many splats", "cut", "a byte missing"],
)
def test_broken_spz_of_version_4_gets_a_sentence(content: bytes) -> None:
    with pytest.raises(BadInput, match="SPZ"):
        read_spz(content, 100)


CHUNK = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z", *(
    f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"))  # fmt: skip
COLORS = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def compressed_ply(bounds: list[list[float]], words: list[tuple[int, ...]], names: tuple[str, ...] = CHUNK) -> bytes:
    """Return splats as SuperSplat compresses them."""
    header = "ply\nformat binary_little_endian 1.0\ncomment by a test\n"
    header += f"element chunk {len(bounds)}\n" + "".join(f"property float {name}\n" for name in names)
    header += f"element vertex {len(words)}\n" + "".join(f"property uint {name}\n" for name in WORDS)
    rows = np.array(bounds, "<f4").tobytes() + np.array(words, "<u4").tobytes()
    return f"{header}end_header\n".encode() + rows


def packed(x: int, y: int, z: int) -> int:
    return x << 21 | y << 11 | z


ZERO, W_LARGEST = 512, 0  # about 0 as a component of a rotation; index of the largest one
UPRIGHT = W_LARGEST << 30 | ZERO << 20 | ZERO << 10 | ZERO
HALF_TURN = 1 << 30 | ZERO << 20 | ZERO << 10 | ZERO  # about x


def test_compressed_splats_lie_between_the_bounds_of_their_chunk() -> None:
    bounds = [[0.0, 0, 0, 1, 2, 4, -5, -5, -5, -3, -3, -3], [10.0, 0, 0, 11, 2, 4, -5, -5, -5, -3, -3, -3]]
    first = (packed(0, 1023, 2047), UPRIGHT, packed(2047, 0, 2047), 0xFF800040)
    last = (packed(2047, 0, 0), HALF_TURN, packed(0, 0, 0), 0x000000FF)
    read, notes = read_foreign_ply(compressed_ply(bounds, [first] * 256 + [last]), 300)
    torch.testing.assert_close(read.means[[0, 256]], torch.tensor([[0.0, 2, 4], [11, 0, 0]]))
    torch.testing.assert_close(read.log_scales[[0, 256]], torch.tensor([[-3.0, -5, -3], [-5, -5, -5]]))
    turned = quat_to_rotmat(read.quats[[0, 256]])
    expected = torch.stack([torch.eye(3), torch.diag(torch.tensor([1.0, -1, -1]))])
    torch.testing.assert_close(turned, expected, atol=0.01, rtol=0)
    torch.testing.assert_close(sh_to_rgb(read.harmonics[[0]]), torch.tensor([[1, 128 / 255, 0]]))
    torch.testing.assert_close(read.opacities[[0, 256]], torch.tensor([64 / 255, 0.9999]), atol=1e-4, rtol=0)
    assert notes == ()


def test_compressed_colors_have_bounds_in_newer_files() -> None:
    bounds = [[0.0, 0, 0, 1, 1, 1, -5, -5, -5, -3, -3, -3, 0.5, 0.5, 0.5, 0.5, 0.5, 1.0]]
    content = compressed_ply(bounds, [(0, UPRIGHT, 0, 0xFFFFFFFF)] * 4, (*CHUNK, *COLORS))
    torch.testing.assert_close(sh_to_rgb(read_foreign_ply(content, 4)[0].harmonics[:1]), torch.tensor([[0.5, 0.5, 1]]))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (compressed_ply([[0.0] * 12], [(0, 0, 0, 0)] * 257), "1 chunks of 256 for 257 splats"),
        (compressed_ply([[0.0] * 12], [(0, 0, 0, 0)] * 9)[:-1], "truncated"),
        (compressed_ply([[0.0] * 11], [(0, 0, 0, 0)] * 9, CHUNK[:-1]), "lack bounds"),
        (compressed_ply([[0.0] * 12], [(0, 0, 0, 0)] * 9).replace(b"packed_color", b"packed_taste"), "packed_color"),
        (compressed_ply([[np.nan] * 12], [(0, 0, 0, 0)] * 9), "not finite"),
        (compressed_ply([[0.0] * 12], [(0, 0, 0, 0)] * 9999), r"9999 splats; at most 300 can be read"),
    ],
    ids=["too few chunks", "cut", "no bounds", "no color", "nan", "too many"],
)
def test_broken_compressed_splats_get_a_sentence(content: bytes, sentence: str) -> None:
    with pytest.raises(BadInput, match=sentence):
        read_foreign_ply(content, 300)


def test_points_alone_are_refused(tmp_path: Path) -> None:
    content = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
    with pytest.raises(BadInput, match="points alone cannot be animated"):
        read_foreign_ply(content, 100)


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
    with pytest.raises(BadInput, match=r"20 splats; at most 10 can be read"):
        read_spz((tmp_path / "a.spz").read_bytes(), 10)


def test_a_header_that_promises_too_much_is_refused() -> None:
    with pytest.raises(BadInput, match=r"at most 100 can be read"):
        read_spz(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 2**31, 0, 12, 0, 0)), 100)


@pytest.mark.parametrize(
    "content",
    [b"", b"\x1f\x8b", gzip.compress(b"NGSP"), gzip.compress(b"x" * 64)],
    ids=["nothing", "no content", "a cut header", "another content"],
)
def test_broken_spz_gets_a_sentence(content: bytes) -> None:
    with pytest.raises(BadInput, match="SPZ"):
        read_spz(content, 100)


def rewritten(cloud: Gaussians, folder: Path, further: str = "", end: str = "\n") -> bytes:
    """Return splats as a PLY with further lines at the end of its header, and with other ends of lines."""
    write_ply(folder / "a.ply", cloud)
    header, rows = (folder / "a.ply").read_bytes().split(b"end_header\n", 1)
    return (header.decode() + further + "end_header\n").replace("\n", end).encode() + rows


@pytest.mark.parametrize(
    "further",
    [
        "element intrinsic 9\nproperty float intrinsic\n",
        "element face 0\nproperty list uchar int vertex_indices\nelement frame 2\nproperty int frame\n",
    ],
    ids=["of SHARP", "a list"],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_further_elements_and_windows_lines_are_read_over(
    further: str, end: str, cloud: Gaussians, tmp_path: Path
) -> None:
    read, notes = read_foreign_ply(rewritten(cloud, tmp_path, further, end) + bytes(36), 100)
    assert all(torch.equal(getattr(read, field.name), getattr(cloud, field.name)) for field in fields(cloud))
    assert notes == ()


def test_extreme_splats_become_usable_and_are_counted(cloud: Gaussians, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", cloud)
    header, rows = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    table = np.frombuffer(rows, "<f4").reshape(20, 17).copy()
    table[[0, 1], 9], table[2, 10], table[3, 13:] = (np.inf, -np.inf), -np.inf, 0
    read, notes = read_foreign_ply(header + b"end_header\n" + table.tobytes(), 100)
    assert read.opacities[:2].tolist() == pytest.approx([1, 0], abs=1e-6)
    assert read.scales[2, 0].item() == pytest.approx(0, abs=1e-6)
    assert torch.equal(quat_to_rotmat(read.quats[3]), torch.eye(3))
    assert torch.equal(read.quats[:3], cloud.quats[:3]) and torch.equal(read.log_scales[3:], cloud.log_scales[3:])
    assert len(notes) == 1 and notes[0].startswith("4 splats")


@pytest.mark.parametrize("column", [0, 9, 10, 13], ids=["mean", "opacity", "scale", "rotation"])
def test_nan_of_any_kind_is_refused(column: int, cloud: Gaussians, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", cloud)
    content = bytearray((tmp_path / "a.ply").read_bytes())
    start = len(content) - 17 * 4 + column * 4  # of the last splat
    content[start : start + 4] = struct.pack("<f", float("nan"))
    with pytest.raises(BadInput, match="not finite"):
        read_foreign_ply(bytes(content), 100)
