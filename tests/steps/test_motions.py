from pathlib import Path

import pytest
import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.settings import FramewiseSettings, HexPlaneSettings, MlpSettings
from steps.motions import new_deformation, read_motion, write_motion

SETTINGS = [HexPlaneSettings(spatial=4, temporal=3, features=2, hidden=4), MlpSettings(hidden=4), FramewiseSettings()]


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s.kind)
def test_a_motion_survives_the_round_trip(settings, tmp_path: Path):
    cloud = blob(30, 0.5, torch.Generator().manual_seed(0))
    deformation = new_deformation(settings, cloud, 5, torch.Generator().manual_seed(1))
    for i, parameter in enumerate(deformation.parameters()):
        parameter.data.normal_(generator=torch.Generator().manual_seed(i))
    write_motion(tmp_path / "m", deformation, settings, 5, 30)
    again, frames = read_motion(tmp_path / "m")
    times = torch.linspace(0, 1, 5)
    assert frames == 5
    before, after = deformation.displace(cloud.means, times), again.displace(cloud.means, times)
    assert all(torch.equal(vars(before)[name], vars(after)[name]) for name in vars(before))
    write_motion(tmp_path / "n", deformation, settings, 5, 30)
    assert (tmp_path / "m").read_bytes() == (tmp_path / "n").read_bytes()


def test_another_file_is_no_motion(tmp_path: Path):
    (tmp_path / "m").write_bytes(b"not safetensors at all")
    with pytest.raises(BadInput, match="is no motion"):
        read_motion(tmp_path / "m")
