from pathlib import Path

import pytest
import torch

from dg4d_lib.deformation.on_parts import OnParts
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.settings import FramewiseSettings, HexPlaneSettings, MlpSettings
from steps.artifacts.motions import new_deformation, read_motion, write_motion

SETTINGS = [HexPlaneSettings(spatial=4, temporal=3, features=2, hidden=4), MlpSettings(hidden=4), FramewiseSettings()]


def seed(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s.kind)
def test_a_motion_survives_the_round_trip(settings, tmp_path: Path):
    cloud = blob(30, 0.5, torch.Generator().manual_seed(0))
    deformation = new_deformation(settings, cloud, 5, torch.Generator().manual_seed(1))
    for i, parameter in enumerate(deformation.parameters()):
        parameter.data.normal_(generator=torch.Generator().manual_seed(i))
    write_motion(tmp_path / "m", deformation, settings, 5, 30)
    again, frames, _ = read_motion(tmp_path / "m")
    times = torch.linspace(0, 1, 5)
    assert frames == 5
    before, after = deformation.displace(cloud.means, times), again.displace(cloud.means, times)
    assert all(torch.equal(vars(before)[name], vars(after)[name]) for name in vars(before))
    write_motion(tmp_path / "n", deformation, settings, 5, 30)
    assert (tmp_path / "m").read_bytes() == (tmp_path / "n").read_bytes()


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s.kind)
def test_parts_survive_the_round_trip(settings, tmp_path: Path):
    cloud = blob(30, 0.5, seed())
    field = new_deformation(settings, cloud, 5, seed(1))
    quats, places = torch.randn(5, 2, 4, generator=seed(2)), torch.randn(5, 2, 3, generator=seed(3))
    owners = (cloud.means[:, 1] > 0).long()
    deformation = OnParts(field, owners, cloud.quats, torch.zeros(2, 3), quats, places)
    write_motion(tmp_path / "m", deformation, settings, 5, 30)
    again, _, _ = read_motion(tmp_path / "m")
    times = torch.linspace(0, 1, 7)
    before, after = deformation.displace(cloud.means, times), again.displace(cloud.means, times)
    assert all(torch.equal(vars(before)[name], vars(after)[name]) for name in vars(before))
    assert not any(parameter.requires_grad for parameter in again.parameters())


@pytest.mark.parametrize("settings", SETTINGS[:2], ids=lambda s: s.kind)
def test_without_the_endpoint_frame_k_of_t_lies_at_k_over_t(settings, tmp_path: Path):
    """The same numbers on both clocks: five frames of one are the first five of six of the other."""
    cloud, open_ended = blob(30, 0.5, seed()), settings.model_copy(update={"endpoint": False})
    deformations = {}
    for name, kind, frames in (("k/T", open_ended, 5), ("k/(T-1)", settings, 6)):
        made = new_deformation(kind, cloud, frames, seed(1))
        for i, parameter in enumerate(made.parameters()):
            parameter.data.normal_(generator=seed(i))
        write_motion(tmp_path / "m", made, kind, frames, 30)
        again = read_motion(tmp_path / "m").deformation
        times = torch.arange(5) / (5 - 1 if name == "k/T" else 6 - 1)
        before, deformations[name] = made.displace(cloud.means, times), again.displace(cloud.means, times)
        assert torch.equal(before.means, deformations[name].means)
    assert deformations["k/T"].means.diff(dim=0).abs().max() > 0.01
    torch.testing.assert_close(deformations["k/T"].means, deformations["k/(T-1)"].means)


def test_the_planes_cover_the_cloud_or_the_box_that_was_asked_for():
    cloud = blob(30, 0.5, seed())
    assert new_deformation(SETTINGS[0], cloud, 5, None).bounds.abs().max() < 0.7
    wide = new_deformation(SETTINGS[0].model_copy(update={"half_side": 1.6}), cloud, 5, None)
    assert torch.equal(wide.bounds, torch.tensor([[-1.6] * 3, [1.6] * 3]))


def test_another_file_is_no_motion(tmp_path: Path):
    (tmp_path / "m").write_bytes(b"not safetensors at all")
    with pytest.raises(BadInput, match="is not a motion"):
        read_motion(tmp_path / "m")
