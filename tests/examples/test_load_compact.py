"""The loader that users copy: it needs nothing of ours, and gives what the library gives."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.assets.formats.compact import CompactAsset, write_compact
from dg4d_lib.deformation.factory import new_deformation
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.settings import HexPlaneSettings
from examples.load_compact import states

FRAMES = 14
SCRIPT = Path(__file__).parents[2] / "examples" / "load_compact.py"


def asset(settings: HexPlaneSettings) -> CompactAsset:
    """A cloud half outside the planes, moved by random numbers."""
    generator = torch.Generator().manual_seed(0)
    cloud = blob(300, 0.5, generator)
    deformation = new_deformation(settings, torch.tensor([[-0.3, -0.2, -0.4], [0.3, 0.5, 0.2]]), FRAMES, 300, generator)
    for parameter in deformation.parameters():
        parameter.data.normal_(std=0.4, generator=generator)
    deformation.bounds = torch.tensor([[-0.3, -0.2, -0.4], [0.3, 0.5, 0.2]])
    return CompactAsset(cloud, deformation.requires_grad_(False), settings, FRAMES, 12.0)


@pytest.mark.parametrize(
    "settings",
    [
        HexPlaneSettings(),
        HexPlaneSettings(spatial=5, temporal=7, features=3, hidden=4, scales=(1, 2)),
        HexPlaneSettings(endpoint=False),
    ],
    ids=["default", "two levels", "without the endpoint"],
)
def test_the_states_are_those_of_the_library(tmp_path: Path, settings: HexPlaneSettings) -> None:
    given = asset(settings)
    write_compact(tmp_path / "a.safetensors", given)
    times = [0.0, 0.31, 0.5, 1.0]
    ours = pose_gaussians(given.gaussians, given.deformation, FRAMES, torch.tensor(times) * (FRAMES - 1))
    assert (ours.means - given.gaussians.means).abs().max() > 0.1
    for i, time in enumerate(times):
        theirs = states(tmp_path / "a.safetensors", time)
        for name, value in vars(ours.at(i)).items():
            np.testing.assert_allclose(theirs[name], value.numpy(), atol=1e-5, rtol=1e-5)


def test_it_runs_without_this_library_and_without_torch(tmp_path: Path) -> None:
    write_compact(tmp_path / "a.safetensors", asset(HexPlaneSettings(spatial=4, temporal=4, features=2, hidden=4)))
    program = (
        f"import runpy, sys\nstates = runpy.run_path({str(SCRIPT)!r})['states']\n"
        "print(states('a.safetensors', 0.5)['means'].shape)\n"
        "loaded = {name.partition('.')[0] for name in sys.modules} & {'torch', 'dg4d_lib', 'scipy', 'steps'}\n"
        "sys.exit(f'loaded {loaded}' if loaded else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "(300, 3)"
