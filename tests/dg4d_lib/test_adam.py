"""Adam moves as torch's own, and neither it nor a fit imports torch's compiler."""

import subprocess
import sys

import pytest
import torch

from dg4d_lib.adam import Adam

FITS = """
import sys, torch
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.asset_pose import find_placement
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import get_rasterizer

random = torch.Generator().manual_seed(0)
means = torch.randn(40, 3, generator=random) * 0.2
cloud = Gaussians(means, torch.full((40, 3), -3.0), torch.eye(4)[:1].repeat(40, 1), torch.ones(40), means[:, None])
rasterize = get_rasterizer("cpu")
drawn = rasterize(cloud, [OrbitCamera(width=32, height=32)], torch.zeros(3))
subject = torch.cat([drawn.color[0], drawn.alpha[0]], -1).clamp(0, 1)
print(find_placement(cloud, subject, rasterize, azimuth_deg=5.0).agreement > 0)
print("torch._dynamo" in sys.modules)
"""


@pytest.mark.parametrize("fused", [False, True])
def test_steps_are_those_of_torch(fused: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(shape, generator=generator) for shape in ((5, 3), (4,), (2, 2), (3,))]
    pairs = [[start.clone().requires_grad_() for start in starts] for _ in range(2)]
    groups = [
        [{"params": own[:2], "lr": 0.01}, {"params": own[2], "lr": 0.0}, {"params": own[3:], "eps": 1e-3}]
        for own in pairs
    ]
    for own in groups:
        own[2]["lr"] = 0.1
    ours = Adam(groups[0], betas=(0.9, 0.98), eps=1e-6)
    theirs = torch.optim.Adam(groups[1], betas=(0.9, 0.98), eps=1e-6, fused=fused)
    for step in range(25):
        for adam, own in ((ours, pairs[0]), (theirs, pairs[1])):
            adam.param_groups[0]["lr"] = 0.01 / (1 + step)
            adam.zero_grad()
            used = own if step % 3 else own[1:]  # the first one has no gradient in every third step
            sum(((value - 1) ** 4).sum() for value in used).backward()
            adam.step()
    for mine, other, start in zip(*pairs, starts, strict=True):
        torch.testing.assert_close(mine, other, atol=1e-6 * (not fused), rtol=0)
        assert torch.equal(mine, start) == (start is starts[2])
    assert ours.state[pairs[0][0]]["step"] == 16


def test_nothing_moves_without_gradients() -> None:
    value = torch.ones(3, requires_grad=True)
    adam = Adam([{"params": value, "lr": 0.1}, {"params": [], "lr": 0.1}])
    adam.step()
    assert torch.equal(value, torch.ones(3)) and not adam.state


def test_a_fit_does_not_import_torchs_compiler() -> None:
    said = subprocess.run([sys.executable, "-c", FITS], capture_output=True, text=True, check=True).stdout
    assert said.split() == ["True", "False"]
