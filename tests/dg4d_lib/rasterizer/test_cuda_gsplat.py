"""gsplat adapter without a GPU: the stand-in checks shapes and renders by the reference."""

import sys
from dataclasses import dataclass, replace
from importlib import import_module
from types import ModuleType

import pytest
import torch
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.rasterizer import reference
from dg4d_lib.rasterizer.interface import BLUR, NEAR

ADAPTER = "dg4d_lib.rasterizer.cuda_gsplat"
BACKEND = "gsplat.cuda._backend"
WHITE = torch.ones(3)


@dataclass(frozen=True)
class Pinhole(OrbitCamera):
    """Camera as gsplat receives it: world to camera with OpenCV axes, and intrinsics in pixels."""

    pose: Tensor | None = None
    lens: float = 0.0

    @property
    def focal(self) -> float:
        return self.lens

    def viewmat(self) -> Tensor:
        assert self.pose is not None
        return self.pose


class StandIn(ModuleType):
    """Stand-in for the parts of gsplat 1.5.3 that the adapter uses."""

    def __init__(self) -> None:
        super().__init__("gsplat")
        self.calls: list[tuple[int, ...]] = []
        self._C: object = "kernels"
        self.__path__: list[str] = []  # a package

    def rasterization(
        self, means, quats, scales, opacities, colors, viewmats, Ks, width, height,
        near_plane=0.01, eps2d=0.3, packed=True, backgrounds=None, render_mode="RGB",
    ):  # fmt: skip
        batch, n, views = means.shape[:-2], means.shape[-2], viewmats.shape[-3]
        assert n > 0, "gsplat divides by the number of Gaussians"
        assert quats.shape == (*batch, n, 4)
        assert scales.shape == colors.shape == (*batch, n, 3)
        assert opacities.shape == (*batch, n)
        assert viewmats.shape == (*batch, views, 4, 4)
        assert Ks.shape == (*batch, views, 3, 3)
        assert backgrounds.shape == (*batch, views, 3)
        tensors = (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
        assert {tensor.dtype for tensor in tensors} == {torch.float32}
        assert (near_plane, eps2d, packed, render_mode) == (NEAR, BLUR, False, "RGB+D")
        assert viewmats[..., 3, :].flatten().tolist() == [0, 0, 0, 1] * (viewmats.numel() // 16)
        assert Ks[..., 2, :].flatten().tolist() == [0, 0, 1] * (Ks.numel() // 9)
        assert torch.allclose(Ks[..., :2, 2], torch.tensor([width / 2, height / 2]))
        assert Ks[..., 0, 0].equal(Ks[..., 1, 1])
        self.calls.append(tuple(viewmats.shape))

        clouds = [tensor.double().reshape(-1, *tensor.shape[len(batch) :]) for tensor in tensors]
        splats, backs = [], []
        for mean, quat, scale, opacity, color, poses, lenses, behind in zip(*clouds, strict=True):
            cloud = Gaussians(mean, scale.log(), quat, opacity.logit(), rgb_to_sh(color))
            for pose, lens in zip(poses, lenses, strict=True):
                camera = Pinhole(width=width, height=height, pose=pose, lens=float(lens[0, 0]))
                splats.append(reference._project(cloud, camera, torch.zeros(n, 2)))
            backs.extend(behind)
        centers = torch.stack([view.means2d for view in splats]).reshape(*batch, views, n, 2)
        for view, own in zip(splats, centers.reshape(-1, n, 2), strict=True):
            view.means2d = own
        pictures = []
        for view, behind in zip(splats, backs, strict=True):
            visible, drawn = reference._sorted_by_depth(view, height, width)
            chosen = reference._Splats(*(value[drawn] for value in vars(view).values()))
            pictures.append((*reference._render(chosen, behind, height, width), visible))
        color, alpha, depth, visible = (torch.stack(part).float() for part in zip(*pictures, strict=True))
        radii = (4 * visible).int()[..., None].expand(-1, -1, 2).reshape(centers.shape)
        shape = (*batch, views, height, width)
        both = torch.cat((color, depth), -1).reshape(*shape, 4)
        return both, alpha.reshape(*shape, 1), {"means2d": centers, "radii": radii}


@pytest.fixture
def gsplat(monkeypatch):
    stand_in = StandIn()
    monkeypatch.setitem(sys.modules, "gsplat", stand_in)
    monkeypatch.setitem(sys.modules, BACKEND, stand_in)
    return stand_in


@pytest.fixture
def adapter(gsplat, monkeypatch):
    monkeypatch.delitem(sys.modules, ADAPTER, raising=False)
    module = import_module(ADAPTER)
    monkeypatch.delitem(sys.modules, ADAPTER)  # nobody else meets the one with the stand-in
    monkeypatch.setattr(module, "DEVICE", torch.device("cpu"))
    return module


CAMERAS = [OrbitCamera(10.0 * i, 50.0 * i, radius=1.5 + 0.2 * i, width=45, height=30) for i in range(3)]


@pytest.mark.parametrize("states", [0, 3])
def test_one_call_draws_every_camera_as_the_definition_does(states, adapter, gsplat, random_cloud, drawn, gradients):
    cloud = random_cloud(80, states)
    found, leaves = drawn(adapter.rasterize, cloud, CAMERAS, torch.float32)
    truth, true_leaves = drawn(reference.rasterize, cloud, CAMERAS, torch.float64)
    assert gsplat.calls == [(3, 1, 4, 4) if states else (3, 4, 4)]
    for name in ("color", "alpha", "depth"):
        torch.testing.assert_close(getattr(found, name).double(), getattr(truth, name), atol=1e-5, rtol=0)
    assert found.visible.equal(truth.visible)
    expected = gradients(truth, true_leaves)
    for name, gradient in gradients(found, leaves).items():
        assert (gradient - expected[name]).norm() < 5e-6 * expected[name].norm(), name


def test_the_screen_gradient_needs_no_other_and_comes_again(adapter, random_cloud):
    cloud, offsets = random_cloud(30).to(torch.float32), torch.zeros(1, 30, 2, requires_grad=True)
    loss = adapter.rasterize(cloud, CAMERAS[:1], WHITE, offsets).color.square().sum()
    first, again = (torch.autograd.grad(loss, offsets, retain_graph=True)[0] for _ in range(2))
    assert first.abs().max() > 0
    assert first.equal(again)
    loss.backward()
    assert first.equal(offsets.grad)


def test_offsets_without_gradient_are_no_obstacle(adapter, random_cloud):
    cloud = random_cloud(30).to(torch.float32)
    plain = adapter.rasterize(cloud, CAMERAS, WHITE)
    fixed = adapter.rasterize(cloud, CAMERAS, WHITE, torch.zeros(3, 30, 2))
    assert plain.color.equal(fixed.color)
    moving = replace(cloud, means=cloud.means.requires_grad_())
    adapter.rasterize(moving, CAMERAS, WHITE, torch.zeros(3, 30, 2)).color.sum().backward()
    assert cloud.means.grad.abs().max() > 0


def test_no_gaussians_are_not_given_to_gsplat(adapter, gsplat, random_cloud):
    picture = adapter.rasterize(random_cloud(0), CAMERAS, WHITE)
    assert picture.color.eq(1).all()
    assert gsplat.calls == []


def test_kernels_that_were_not_compiled_are_named(adapter, monkeypatch, random_cloud):
    """Without a compiler gsplat's kernels are None."""
    monkeypatch.setattr(sys.modules[BACKEND], "_C", None)
    with pytest.raises(BackendUnavailable, match=r"nvcc.*rasterizer=cpu"):
        adapter.rasterize(random_cloud(3), CAMERAS, WHITE)


def test_that_kernels_are_compiled_is_said_once(adapter, monkeypatch, tmp_path, caplog, random_cloud):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("TORCH_EXTENSIONS_DIR", raising=False)
    monkeypatch.setattr(adapter, "find_spec", lambda name: None)
    caplog.set_level("INFO", adapter.__name__)
    for _ in range(2):
        adapter.rasterize(random_cloud(3), CAMERAS, WHITE)
    assert caplog.messages == [adapter.NOTICE]
    (tmp_path / "torch_extensions" / "py311_cu130" / "gsplat_cuda").mkdir(parents=True)
    (tmp_path / "torch_extensions" / "py311_cu130" / "gsplat_cuda" / "gsplat_cuda.so").touch()
    adapter._require_kernels.cache_clear()
    adapter.rasterize(random_cloud(3), CAMERAS, WHITE)
    assert caplog.messages == [adapter.NOTICE]


@pytest.mark.parametrize("failure", [RuntimeError("Error building extension\n[1/30] nvcc"), ImportError("no .so")])
def test_kernels_that_do_not_compile_are_named(failure, adapter, monkeypatch, random_cloud):
    """What a broken toolkit leaves: the first import of gsplat's kernels fails in its build, the next in loading it."""

    def fail(name):
        raise failure

    monkeypatch.setattr(adapter, "import_module", fail)
    with pytest.raises(BackendUnavailable, match=r"(?s)(Error building|no \.so).*nvcc.*rasterizer=cpu"):
        adapter.rasterize(random_cloud(3), CAMERAS, WHITE)


def test_few_gaussians_with_states_are_drawn_one_by_one(adapter, gsplat, random_cloud, drawn, gradients):
    """gsplat 1.5.3 adds up, over the states in one warp, the gradients of Gaussians of the same number."""
    found, leaves = drawn(adapter.rasterize, random_cloud(31, 3), CAMERAS, torch.float32)
    assert gsplat.calls == [(1, 4, 4)] * 3
    truth, true_leaves = drawn(reference.rasterize, random_cloud(31, 3), CAMERAS, torch.float64)
    assert found.visible.equal(truth.visible)
    expected = gradients(truth, true_leaves)
    for name, gradient in gradients(found, leaves).items():
        assert (gradient - expected[name]).norm() < 1e-5 * expected[name].norm(), name


@pytest.mark.gpu
def test_a_cloud_on_the_gpu_gets_its_pictures_there(random_cloud, drawn, gradients):
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    rasterize = pytest.importorskip(ADAPTER, reason="gsplat is not installed").rasterize
    device = torch.device("cuda")
    for states in (0, 3):
        cloud = random_cloud(80, states)
        here, _ = drawn(rasterize, cloud, CAMERAS, torch.float32)
        there, leaves = drawn(rasterize, cloud.to(device), CAMERAS, torch.float32)
        assert there.color.device.type == there.visible.device.type == "cuda"
        torch.testing.assert_close(there.color.cpu(), here.color, atol=1e-5, rtol=0)  # exp is rounded otherwise there
        assert {gradient.device.type for gradient in gradients(there, leaves).values()} == {"cuda"}
