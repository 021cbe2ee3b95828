"""Splat PLY files: exact round trip, equal bytes, third-party readers, error messages."""

from dataclasses import replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import COLUMNS, read_ply, write_ply


def cloud(count: int = 7) -> Gaussians:
    generator = torch.Generator().manual_seed(3)
    shapes = ((count, 3), (count, 3), (count, 4), (count,), (count, 1, 3))
    return Gaussians(*(torch.randn(shape, generator=generator) for shape in shapes))


def fields(gaussians: Gaussians) -> list[torch.Tensor]:
    return list(vars(gaussians).values())


@pytest.mark.parametrize("count", [0, 1, 7])
def test_a_cloud_comes_back_exactly(tmp_path: Path, count: int) -> None:
    write_ply(tmp_path / "a.ply", cloud(count))
    for back, given in zip(fields(read_ply(tmp_path / "a.ply")), fields(cloud(count)), strict=True):
        assert torch.equal(back, given)


@pytest.mark.parametrize("count", [0, 7])
def test_a_cloud_in_the_axes_of_other_programs_comes_back_exactly(tmp_path: Path, count: int) -> None:
    write_ply(tmp_path / "a.ply", cloud(count), y_down=True)
    for back, given in zip(fields(read_ply(tmp_path / "a.ply", y_down=True)), fields(cloud(count)), strict=True):
        assert torch.equal(back, given)


def test_another_reader_sees_the_cloud_with_y_down(tmp_path: Path) -> None:
    """Turn positions and covariances by 180 degrees around x: y and z change their signs."""
    write_ply(tmp_path / "a.ply", cloud(), y_down=True)
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0]
    assert b"comment" not in header  # which Niantic's reader refuses
    seen, given = gsply.plyread(str(tmp_path / "a.ply")), cloud()
    flip = np.array([1, -1, -1])
    assert np.array_equal(seen.means, given.means.numpy() * flip)
    theirs = replace(given, quats=torch.from_numpy(np.array(seen.quats)))
    expected = given.covariances.numpy() * np.outer(flip, flip)
    np.testing.assert_allclose(theirs.covariances.numpy(), expected, rtol=1e-4, atol=1e-5)


def test_equal_clouds_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a.ply", "b.ply"):
        write_ply(tmp_path / name, cloud())
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_numbers_that_are_not_finite_are_refused_by_name(tmp_path: Path) -> None:
    given = cloud()
    with pytest.raises(BadInput, match="a PLY cannot hold non-finite numbers; given some in log_scales;"):
        write_ply(tmp_path / "a.ply", replace(given, log_scales=given.log_scales / 0))


def test_rows_stand_in_the_order_viewers_expect(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", cloud())
    header, rows = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    expected = b"x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert b" ".join(line.split()[-1] for line in header.splitlines() if line.startswith(b"property float")) == expected
    first = np.frombuffer(rows, "<f4").reshape(7, 17)[0]
    given = cloud()
    assert first[:3].tolist() == given.means[0].tolist()
    assert first[3:6].tolist() == [0, 0, 0]
    assert first[9] == given.opacity_logits[0]
    assert first[13:].tolist() == given.quats[0].tolist()


def test_another_reader_sees_the_same_cloud(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", cloud())
    theirs, ours = gsply.plyread(str(tmp_path / "a.ply")), cloud()
    assert np.array_equal(theirs.means, ours.means.numpy())
    assert np.array_equal(theirs.scales, ours.log_scales.numpy())
    assert np.array_equal(theirs.quats, ours.quats.numpy())
    assert np.array_equal(theirs.opacities.ravel(), ours.opacity_logits.numpy())
    assert np.array_equal(theirs.sh0, ours.harmonics[:, 0].numpy())


def test_a_file_of_another_writer_is_read(tmp_path: Path) -> None:
    given = cloud()
    write_ply(tmp_path / "a.ply", given)
    gsply.plywrite(str(tmp_path / "b.ply"), gsply.plyread(str(tmp_path / "a.ply")))
    assert torch.equal(read_ply(tmp_path / "b.ply").quats, given.quats)


def test_columns_may_stand_in_another_order(tmp_path: Path) -> None:
    names = (*reversed(COLUMNS), "spare")
    header = "ply\ncomment other tool\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    row = np.arange(len(names), dtype="<f4")
    (tmp_path / "a.ply").write_bytes(header.encode() + row.tobytes())
    back = read_ply(tmp_path / "a.ply")
    assert back.means[0].tolist() == [names.index(name) for name in "xyz"]
    assert back.quats[0].tolist() == [3, 2, 1, 0]


@pytest.mark.parametrize("bits", [8, 16, 32])
@pytest.mark.parametrize("signed", [True, False])
@pytest.mark.parametrize("short", [True, False])
def test_columns_of_any_integer_type_are_skipped(tmp_path: Path, bits: int, signed: bool, short: bool) -> None:
    prefix = "" if signed else "u"
    written = prefix + ({8: "char", 16: "short", 32: "int"}[bits] if short else f"int{bits}")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty {written} label\n"
    header += "".join(f"property float {name}\n" for name in COLUMNS) + "end_header\n"
    rows = np.zeros(2, np.dtype([("label", f"u{bits // 8}"), *((name, "<f4") for name in COLUMNS)]))
    rows["x"] = (1, 2)
    (tmp_path / "a.ply").write_bytes(header.encode() + rows.tobytes())
    assert read_ply(tmp_path / "a.ply").means[:, 0].tolist() == [1, 2]


def test_faces_after_the_gaussians_are_not_read(tmp_path: Path) -> None:
    """Properties that follow a list belong to its element, not to the one before it."""
    path, faces = tmp_path / "a.ply", b"element face 1\nproperty list uchar int vertex_indices\nproperty int flags\n"
    write_ply(path, cloud())
    content = path.read_bytes().replace(b"end_header\n", faces + b"end_header\n")
    path.write_bytes(content + np.array([3], "u1").tobytes() + np.arange(4, dtype="<i4").tobytes())
    for back, given in zip(fields(read_ply(path)), fields(cloud()), strict=True):
        assert torch.equal(back, given)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (lambda content: b"", "not a PLY"),
        (lambda content: b"a text file", "not a PLY"),
        (lambda content: content[:-1], "truncated: 7 Gaussians declared, 6 found"),
        (lambda content: content[:100], "not a PLY"),
        (lambda content: content.replace(b"opacity", b"opacitx"), "lacks opacity"),
        (lambda content: content.replace(b"binary_little_endian", b"ascii"), "binary_little_endian"),
        (lambda content: content.replace(b"vertex 7", b"vertex x"), "header"),
        (lambda content: content.replace(b"vertex 7", b"face 7"), "'vertex'"),
        (lambda content: content.replace(b"float nx", b"list uchar float nx"), "header"),
        (lambda content: content.replace(b"property float nx", b"property float f_rest_0"), "higher degree"),
        (lambda content: content[:-4] + np.float32(np.nan).tobytes(), "non-finite"),
    ],
)
def test_a_broken_file_is_refused_with_its_reason(tmp_path: Path, damage, says: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "a.ply"
    write_ply(path, cloud())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(BadInput, match=says):
        read_ply(path)


def test_a_missing_file_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"a\.ply cannot be read"):
        read_ply(tmp_path / "a.ply")


def test_a_batch_is_not_written_as_if_it_were_one_cloud(tmp_path: Path) -> None:
    one = cloud()
    batch = Gaussians(one.means[None], one.log_scales[None], one.quats[None], one.opacity_logits, one.harmonics)
    with pytest.raises(BadInput, match="one state"):
        write_ply(tmp_path / "a.ply", batch)
    assert not (tmp_path / "a.ply").exists()
