"""CPU rasterizer on other CPUs, with other threads, and over many calls."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.kernels import workers
from dg4d_lib.rasterizer.interface import get_rasterizer

CPU = get_rasterizer("cpu")
WHITE = torch.ones(3)
CAMERAS = [OrbitCamera(10, 50 * i, width=75, height=131) for i in range(4)]

# Without FMA, LLVM's fma is a call into the C library for every lane: eight times slower
ON_THE_OLDEST = """
import sys, torch
from dg4d_lib.rasterizer.cpu import rasterize
from dg4d_lib.rasterizer.cpu_tiles import blend, blend_backward
cloud, cameras, cotangent = torch.load(sys.argv[1], weights_only=False)
color = rasterize(cloud, cameras, torch.ones(3)).color
gradients = torch.autograd.grad(color, list(vars(cloud).values()), cotangent)
for kernel in (blend, blend_backward):
    (code,) = kernel.inspect_asm().values()
    assert "xmm" in code and "ymm" not in code and "fmaf" not in code
torch.save((color.detach(), gradients), sys.argv[1])
"""


@pytest.mark.parametrize("states", [0, 4])
def test_the_number_of_threads_changes_no_byte(states, random_cloud, forward_and_backward):
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3, 5):  # 5 threads share the tiles of 4 views; 3 threads get uneven ranges of Gaussians
            torch.set_num_threads(threads)
            results.append(
                forward_and_backward(CPU, random_cloud(1001, states=states, scale=0.04), CAMERAS, torch.float32)
            )
    finally:
        torch.set_num_threads(before)
    for rendering, gradients in results[1:]:
        assert all(value.equal(getattr(results[0][0], name)) for name, value in vars(rendering).items())
        assert all(value.equal(results[0][1][name]) for name, value in gradients.items())


def test_memory_stays_the_same_over_many_calls_of_many_sizes(random_cloud, forward_and_backward):
    def calls() -> int:
        for i in range(100):
            size = 20 + 7 * (i % 9)
            cameras = [replace(camera, width=size, height=90 - size) for camera in CAMERAS[: 1 + i % 4]]
            forward_and_backward(CPU, random_cloud(10 * (i % 11)), cameras, torch.float32)
        return sum(size * len(arrays) for size, arrays in workers._IDLE.items())

    first = calls()
    assert calls() == first > 0


def test_memory_that_is_kept_has_a_limit(monkeypatch):
    monkeypatch.setattr(workers, "_IDLE", type(workers._IDLE)(list))
    monkeypatch.setattr(workers, "_MAX_IDLE_BYTES", 3 << 20)
    scratch = workers.Scratch()
    for _ in range(5):
        scratch.empty((1 << 20,), "uint8")
    del scratch
    assert {size: len(arrays) for size, arrays in workers._IDLE.items()} == {1 << 20: 3}


@pytest.mark.slow  # it compiles everything for that processor
def test_the_oldest_processor_of_its_kind_draws_the_same(random_cloud, tmp_path):
    cloud = random_cloud(300, scale=0.1).to(torch.float32)
    for value in vars(cloud).values():
        value.requires_grad_()
    color = CPU(cloud, CAMERAS, WHITE).color
    cotangent = torch.randn(color.shape, generator=torch.Generator().manual_seed(0))
    gradients = torch.autograd.grad(color, list(vars(cloud).values()), cotangent)
    file = tmp_path / "exchange.pt"
    torch.save((cloud, CAMERAS, cotangent), file)
    environment = {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", ON_THE_OLDEST, file], env={**os.environ, **environment}, check=True)
    old_color, old_gradients = torch.load(file)
    assert (color - old_color).abs().mean() < 2e-7  # float32 rounding
    for gradient, old in zip(gradients, old_gradients, strict=True):
        assert (gradient - old).norm() / gradient.norm() < 5e-6


def test_without_numba_the_backend_is_not_here(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("dg4d_lib.rasterizer.cpu")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(BackendUnavailable, match=r"'cpu' cannot run here: .*numba"):
        get_rasterizer("cpu")
