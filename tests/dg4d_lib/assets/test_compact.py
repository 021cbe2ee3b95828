"""Compact format: lossless round trip, self-description, corrupt files."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open

from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.assets.formats.compact import TENSORS, CompactAsset, read_compact, write_compact
from dg4d_lib.deformation.factory import new_deformation
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.settings import DeformationSettings, FramewiseSettings, HexPlaneSettings, MlpSettings

SETTINGS = [
    HexPlaneSettings(spatial=4, temporal=3, features=2, hidden=4, scales=(1, 2), endpoint=False),
    MlpSettings(hidden=4),
    FramewiseSettings(),
]


def asset(settings: DeformationSettings = SETTINGS[0]) -> CompactAsset:
    generator = torch.Generator().manual_seed(0)
    bounds = torch.tensor([[-1.0] * 3, [1.0, 2.0, 3.0]])
    deformation = new_deformation(settings, bounds, 5, 30, generator)
    for parameter in deformation.parameters():
        parameter.data.normal_(generator=generator)
    return CompactAsset(blob(30, 0.5, generator), deformation.requires_grad_(False), settings, 5, 12.0)


def metadata(path: Path) -> Any:
    with safe_open(path, "numpy") as file:
        return json.loads(file.metadata()["asset4d"]), set(file.keys())


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s.kind)
def test_an_asset_comes_back_exactly(tmp_path: Path, settings: DeformationSettings) -> None:
    given = asset(settings)
    write_compact(tmp_path / "a", given)
    back = read_compact(tmp_path / "a")
    assert (back.settings, back.frames, back.fps) == (settings, 5, 12.0)
    positions = torch.tensor([0.0, 0.5, 3.9, 4.0, 4.5])
    before, after = (pose_gaussians(each.gaussians, each.deformation, 5, positions) for each in (given, back))
    assert all(torch.equal(value, vars(after)[name]) for name, value in vars(before).items())


def test_equal_assets_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_compact(tmp_path / name, asset())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s.kind)
def test_the_file_says_what_every_tensor_is(tmp_path: Path, settings: DeformationSettings) -> None:
    write_compact(tmp_path / "a", asset(settings))
    about, names = metadata(tmp_path / "a")
    described = {name.strip() for key in about["tensors"] for name in key.split(",")}
    stems = {name.removesuffix(".i").removesuffix(".NAME") for name in described}
    assert about["tensors"] == TENSORS
    assert not [name for name in names if not any(name == stem or name.startswith(f"{stem}.") for stem in stems)]


def test_the_file_says_how_it_moves_and_how_fast(tmp_path: Path) -> None:
    write_compact(tmp_path / "a", asset())
    about, _ = metadata(tmp_path / "a")
    facts = {name: about[name] for name in ("format", "version", "frames", "fps", "gaussians", "last_time")}
    assert facts == {
        "format": "dg4d-compact", "version": 1, "frames": 5, "fps": 12.0, "gaussians": 30, "last_time": 0.8,
    }  # fmt: skip
    assert about["settings"]["kind"] == "hexplane"


def test_numbers_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    given = asset()
    broken = replace(given.gaussians, means=given.gaussians.means / 0)
    with pytest.raises(BadInput, match="a compact asset cannot hold non-finite numbers; given some in means"):
        write_compact(tmp_path / "a", replace(given, gaussians=broken))


def test_a_missing_or_broken_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="a is not a compact asset"):
        read_compact(tmp_path / "a")
    write_compact(tmp_path / "a", asset())
    content = (tmp_path / "a").read_bytes()
    for damaged in (content[:-1], b"", content.replace(b"asset4d", b"asset5d"), content.replace(b"quats", b"qutas")):
        (tmp_path / "a").write_bytes(damaged)
        with pytest.raises(BadInput, match="a is not a compact asset"):
            read_compact(tmp_path / "a")


def test_another_version_is_refused(tmp_path: Path) -> None:
    write_compact(tmp_path / "a", asset())
    content = (tmp_path / "a").read_bytes()
    (tmp_path / "a").write_bytes(content.replace(b'\\"version\\": 1', b'\\"version\\": 2'))
    with pytest.raises(BadInput, match="this program reads dg4d-compact version 1"):
        read_compact(tmp_path / "a")


def test_a_fifo_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "asset4d.safetensors")
    with pytest.raises(BadInput, match=r"asset4d\.safetensors is not a compact asset"):
        read_compact(tmp_path / "asset4d.safetensors")
