import math

import pytest
import torch
from test_zbuffer import soup, square

from dg4d_lib.cameras.orbit import OrbitCamera, viewmats
from dg4d_lib.mesh_rasterizer import scanlines, scanlines_cpu
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

CAMERAS = [OrbitCamera(20, 130, width=48, height=32), OrbitCamera(-60, -75, 1.5, 35, width=48, height=32)]


def strange() -> tuple[torch.Tensor, torch.Tensor]:
    """Triangles through the camera, behind it, far off, of no size, and none of numbers, among others."""
    vertices, faces = soup(7)
    corners = vertices.reshape(-1, 3, 3).clone()
    corners[0] *= 20
    corners[1, 0] += 1e12
    corners[2] = corners[2, :1]
    corners[3, 1] = math.nan
    corners[4, 2] = -math.inf
    corners[5, 2] = corners[5].mean(0)
    corners[6] += 4 * CAMERAS[0].position()
    return corners.reshape(-1, 3), faces


@pytest.mark.parametrize(
    "mesh", [soup(1), soup(2, 600), strange(), (square(0.4), torch.empty(0, 3, dtype=torch.int32))]
)
@pytest.mark.parametrize("batched", [False, True])
def test_both_forms_draw_the_same(mesh, batched):
    vertices, faces = mesh
    if batched:
        vertices = torch.stack([vertices, 0.8 * vertices.flip(-1)])
    fast, plain = (backend.rasterize(vertices, faces, CAMERAS) for backend in (scanlines_cpu, scanlines))
    assert torch.equal(fast[0], plain[0])
    torch.testing.assert_close(fast[1], plain[1], atol=1e-6, rtol=0)
    torch.testing.assert_close(fast[2], plain[2], atol=1e-6, rtol=0)


def test_what_is_in_memory_at_a_time_does_not_matter(monkeypatch):
    vertices, faces = soup(4, 300)
    whole = scanlines.rasterize(vertices, faces, CAMERAS)
    monkeypatch.setattr(scanlines, "AT_ONCE", 97)
    for one, other in zip(whole, scanlines.rasterize(vertices, faces, CAMERAS), strict=True):
        assert torch.equal(one, other)


def test_the_number_of_threads_does_not_matter():
    vertices, faces = soup(4, 300)
    threads = torch.get_num_threads()
    try:
        drawn = []
        for count in (1, 3):
            torch.set_num_threads(count)
            drawn.append(scanlines_cpu.rasterize(vertices, faces, CAMERAS))
    finally:
        torch.set_num_threads(threads)
    for one, other in zip(*drawn, strict=True):
        assert torch.equal(one, other)


def test_nothing_is_made_on_another_device(monkeypatch):
    """The default device holds no numbers: whatever is made there cannot be computed with."""
    vertices, faces = soup(4)
    poses = viewmats(CAMERAS)
    monkeypatch.setattr(scanlines, "viewmats", lambda _: poses)
    with torch.device("meta"):
        drawn = scanlines.rasterize(vertices, faces, CAMERAS)
    assert {value.device.type for value in drawn} == {"cpu"}


@pytest.mark.gpu
@pytest.mark.parametrize("batched", [False, True])
def test_a_gpu_draws_what_the_processor_draws(batched):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    vertices, faces = soup(2, 600)
    if batched:
        vertices = torch.stack([vertices, 0.8 * vertices.flip(-1)])
    here, there = rasterize_mesh(vertices, faces, CAMERAS), rasterize_mesh(vertices.cuda(), faces.cuda(), CAMERAS)
    assert {value.device.type for value in vars(there).values()} == {"cuda"}
    same = there.faces.cpu() == here.faces
    assert (~same).sum() <= 1  # centers within the last bit of an edge
    torch.testing.assert_close(there.barycentrics.cpu()[same], here.barycentrics[same], atol=1e-5, rtol=0)
    torch.testing.assert_close(there.depth.cpu()[same], here.depth[same], atol=1e-5, rtol=0)
