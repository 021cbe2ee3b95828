"""SPZ: third-party reader, quantization error, refused input."""

import gzip
import math
import struct
from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch

from dg4d_lib.assets.formats.spz import scale_notes, write_spz
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_to_rotmat


def cloud(count: int = 200) -> Gaussians:
    """Within what the format can hold."""
    generator = torch.Generator().manual_seed(3)
    means, log_scales, quats, logits, harmonics = (
        torch.randn(shape, generator=generator) for shape in ((count, 3), (count, 3), (count, 4), (count,), (count, 3))
    )
    return Gaussians(means, log_scales - 4, quats, 3 * logits, harmonics.clamp(-3.3, 3.3)[:, None])


def test_another_reader_sees_the_cloud_to_the_stated_steps(tmp_path: Path) -> None:
    given = cloud()
    write_spz(tmp_path / "a.spz", given)
    seen = gsply.read_spz(str(tmp_path / "a.spz"))
    rounding = 1 + 1e-4  # of float32, in the reader
    assert np.abs(seen.means - given.means.numpy()).max() <= rounding / 8192
    assert np.abs(seen.scales - given.log_scales.numpy()).max() <= rounding / 32
    assert np.abs(seen.sh0 - given.harmonics[:, 0].numpy()).max() <= rounding / 76
    opacities = torch.from_numpy(seen.opacities).flatten().sigmoid()
    assert (opacities - given.opacities).abs().max() <= rounding / 510


def test_another_reader_sees_the_rotations_to_the_stated_angle(tmp_path: Path) -> None:
    given = cloud(5000)
    write_spz(tmp_path / "a.spz", given)
    seen = torch.from_numpy(gsply.read_spz(str(tmp_path / "a.spz")).quats).double()
    between = quat_to_rotmat(seen) @ quat_to_rotmat(given.quats.double()).mT
    cosines = (between.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    assert math.degrees(float(cosines.clamp(-1, 1).acos().max())) < 0.3


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_whichever_component_of_a_rotation_is_largest_comes_back(tmp_path: Path, axis: int, sign: float) -> None:
    quat = torch.tensor([0.1, -0.2, 0.3, -0.05])
    quat[axis] = sign
    given = replace(cloud(1), quats=2 * quat[None])
    write_spz(tmp_path / "a.spz", given)
    seen = gsply.read_spz(str(tmp_path / "a.spz")).quats[0]
    assert abs(float(seen @ (quat / quat.norm()).numpy())) == pytest.approx(1, abs=1e-5)


def test_the_header_says_version_three_and_no_directional_color(tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", cloud(9))
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert struct.unpack_from("<4sIIBBBB", content) == (b"NGSP", 3, 9, 0, 12, 0, 0)
    assert len(content) == 16 + 9 * (9 + 1 + 3 + 3 + 4)


def test_equal_clouds_give_equal_bytes_at_any_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_spz(tmp_path / "a.spz", cloud())
    monkeypatch.setattr("time.time", lambda: 1e9)  # a date that gzip could write into its header
    write_spz(tmp_path / "b.spz", cloud())
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def test_what_lies_beyond_the_steps_becomes_the_last_of_them(tmp_path: Path) -> None:
    given = replace(
        cloud(2), log_scales=torch.tensor([[-30.0, 9.0, 0.0]] * 2), opacity_logits=torch.tensor([90.0, -90])
    )
    write_spz(tmp_path / "a.spz", given)
    seen = gsply.read_spz(str(tmp_path / "a.spz"))
    assert seen.scales[0].tolist() == [-10, 5.9375, 0]
    assert torch.from_numpy(seen.opacities).flatten().sigmoid().tolist() == pytest.approx([1, 0], abs=1e-5)


@pytest.mark.parametrize(
    ("smallest", "others", "noted"), [(1e-5, 1e-5, True), (1e-6, 1e-2, False), (1e-4, 1e-4, False)]
)
def test_splats_that_become_visibly_thicker_are_noted(smallest: float, others: float, noted: bool) -> None:
    """A thin axis of a large splat may be thicker."""
    given = replace(cloud(2), log_scales=torch.tensor([[smallest, others, others], [1.0, 1.0, 1.0]]).log())
    notes = scale_notes(given)
    assert bool(notes) == noted
    assert not noted or notes[0].startswith("50% of the splats are more than 10% too thick")


def test_an_empty_cloud_is_a_header(tmp_path: Path) -> None:
    write_spz(tmp_path / "a.spz", cloud(0))
    assert len(gzip.decompress((tmp_path / "a.spz").read_bytes())) == 16


def test_a_center_that_the_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="within 2048 meters; given 3000"):
        write_spz(tmp_path / "a.spz", replace(cloud(1), means=torch.tensor([[0.0, -3000.0, 0.0]])))


@pytest.mark.parametrize("broken", ["means", "log_scales", "quats", "opacity_logits", "harmonics"])
def test_numbers_that_are_not_finite_are_refused_by_name(tmp_path: Path, broken: str) -> None:
    given = cloud(2)
    with pytest.raises(BadInput, match=f"an SPZ cannot hold non-finite numbers; given some in {broken};"):
        write_spz(tmp_path / "a.spz", replace(given, **{broken: vars(given)[broken] * math.nan}))


@pytest.mark.parametrize("count", [0, 1, 200, 20_000])
def test_version_four_has_the_sections_of_version_three_as_zstandard_frames(tmp_path: Path, count: int) -> None:
    pyarrow = pytest.importorskip("pyarrow", reason="a reader of Zstandard")
    write_spz(tmp_path / "3.spz", cloud(count))
    write_spz(tmp_path / "4.spz", cloud(count), 4)
    three, four = gzip.decompress((tmp_path / "3.spz").read_bytes()), (tmp_path / "4.spz").read_bytes()
    magic, version, points, degree, bits, flags, streams, table = struct.unpack_from("<4sIIBBBBI", four)
    assert (magic, version, points, degree, bits, flags, streams, table) == (b"NGSP", 4, count, 0, 12, 0, 5, 32)
    sizes = [struct.unpack_from("<QQ", four, table + 16 * stream) for stream in range(streams)]
    start, sections = table + 16 * streams, []
    for stored, size in sizes:
        sections.append(pyarrow.decompress(four[start : start + stored], size, "zstd", asbytes=True) if size else b"")
        start += stored
    assert start == len(four)
    assert b"".join(sections) == three[16:]


def test_positions_of_a_small_cloud_are_as_exact_relative_to_its_size(tmp_path: Path) -> None:
    small = replace(cloud(), means=cloud().means / 64)
    write_spz(tmp_path / "a.spz", small)
    seen = gsply.read_spz(str(tmp_path / "a.spz"))
    assert np.abs(seen.means - small.means.numpy()).max() <= small.means.abs().max() / 2**12
