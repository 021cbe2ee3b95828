"""Fits on the device of their cloud.

Without a GPU: on torch's `meta` device tensors have shapes and no numbers, and an operation on tensors of two devices
is refused, so what makes a tensor on the processor by accident is caught. With one: the fits themselves, and how often
they wait for it.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tiny_weights import write_zero123

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.deformation.hexplane import HexPlane
from dg4d_lib.deformation.mlp import Mlp
from dg4d_lib.deformation.rigidity_loss import neighborhoods, rigidity_loss
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.fitting.losses import reference_loss, resize_cutouts
from dg4d_lib.fitting.motion import bounds_of, fit_motion
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.density_control import Grad2dStats, reset_opacity
from dg4d_lib.gaussians.initialize import blob, isotropic, on_surface
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.zero123 import ConditionedZero123, Zero123
from dg4d_lib.rasterizer.interface import Rasterizer, Rendering, get_rasterizer, preferred_device
from dg4d_lib.settings import HexPlaneSettings, MlpSettings, MotionSettings, StaticSettings, Zero123PriorSettings
from dg4d_lib.video.driving import DrivingVideo
from tests.emulation.gpu import Emulated

META = torch.device("meta")
COUNT, FRAMES = 30, 4
DEFORMATIONS = {
    "hexplane": lambda box: HexPlane(HexPlaneSettings(spatial=4, temporal=4, features=8, hidden=16), box, seed()),
    "mlp": lambda box: Mlp(MlpSettings(frequencies=2, hidden=16), box, seed()),
    "framewise": lambda box: Framewise(FRAMES, COUNT),
}


def seed() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def meta_rendering() -> Rendering:
    color, alpha = torch.zeros(2, 8, 8, 3, device=META), torch.zeros(2, 8, 8, 1, device=META)
    return Rendering(color.requires_grad_(), alpha.requires_grad_(), alpha, torch.ones(2, COUNT, device=META).bool())


def test_tensors_of_two_devices_would_be_noticed():
    with pytest.raises(RuntimeError, match="expected device meta"):
        torch.zeros(3, device=META) + torch.zeros(3)


@pytest.mark.parametrize("kind", DEFORMATIONS)
def test_motions_stay_on_the_device_of_their_cloud(kind):
    cloud = blob(COUNT, 0.5, seed()).to(META)
    video = DrivingVideo(torch.zeros(FRAMES, 8, 8, 3, device=META), torch.zeros(FRAMES, 8, 8, 1, device=META), 8.0)
    deformation = DEFORMATIONS[kind](bounds_of(cloud)).to(META)
    moved = deformation.displace(cloud.means, video.times).apply(cloud)
    assert moved.means.device == deformation.regularization_loss().device == META
    assert moved.states([0, 0, 1]).means.device == META


def test_rigidity_stays_on_the_device_of_the_cloud():
    cloud, times = blob(COUNT, 0.5, seed()).to(META), torch.zeros(FRAMES, device=META)
    moved = Framewise(FRAMES, COUNT).to(META).displace(cloud.means, times).apply(cloud)
    neighbors, weights = neighborhoods(blob(COUNT, 0.5, seed()).means)
    assert rigidity_loss(moved, neighbors, weights.to(META)).device == META


def test_losses_stay_on_the_device_of_the_pictures(known):
    color, alpha = resize_cutouts(torch.zeros(2, 16, 16, 4, device=META), 8)
    assert reference_loss(meta_rendering(), color, alpha, 1.0, 1.0).device == META
    views = [GuidanceView(OrbitCamera(azimuth_deg=90.0 * i, width=8, height=8)) for i in range(2)]
    rendering = meta_rendering()
    loss = known.prior(0.98).loss(rendering.color, rendering.alpha, views, 0.5, seed())  # its pictures are elsewhere
    assert loss.device == META
    loss.backward()
    assert rendering.color.grad is not None


def test_clouds_stay_on_the_device_of_their_points():
    points = torch.zeros(COUNT, 3, device=META)
    for cloud in (on_surface(points, points, 1.0), isotropic(points, points[:, 0], points, 0.5)):
        assert {value.device for value in vars(cloud).values()} == {META}
        assert {value.device for value in vars(reset_opacity(cloud)).values()} == {META}
    gradients = Grad2dStats.zeros(COUNT, META)
    gradients.add(torch.zeros(2, COUNT, 2, device=META), meta_rendering().visible, 8)
    assert gradients.mean.device == META


@pytest.fixture
def drawn_here_and_there(known) -> dict[str, tuple[torch.device, Rasterizer]]:
    """Return device and rasterizer of the CPU, and those of gsplat."""
    try:
        gsplat = get_rasterizer("cuda_gsplat")
    except BackendUnavailable as missing:
        pytest.skip(str(missing))
    return {"here": (torch.device("cpu"), known.rasterize), "there": (preferred_device("cuda_gsplat"), gsplat)}


@pytest.mark.gpu
def test_the_static_fit_on_a_gpu_ends_where_the_processor_ends(known, static_settings, drawn_here_and_there):
    """Density is controlled on the way; the sums of a GPU have no fixed order, so the losses agree, not the bytes."""
    settings = static_settings.model_copy(update={"iterations": 60, "densify_every": 25, "densify_gradient": 1e-4})
    start, ends = blob(settings.start.points, 0.5, seed()), {}
    for place, (device, rasterize) in drawn_here_and_there.items():
        losses: list[float] = []
        fitted = fit_gaussians(
            start.to(device), known.subject(), known.prior(0.98), rasterize, settings, seed(),
            lambda _, values, losses=losses: losses.append(values["reference"]),
        )  # fmt: skip
        assert fitted.means.device.type == device.type
        ends[place] = sum(losses[-10:]) / 10
        assert ends[place] < 0.5 * losses[0]
    assert ends["there"] == pytest.approx(ends["here"], rel=0.2)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", DEFORMATIONS)
def test_the_motion_fit_on_a_gpu_ends_where_the_processor_ends(kind, known, motion_settings, drawn_here_and_there):
    settings = motion_settings.model_copy(update={"iterations": 60, "rigidity_weight": 0.1})
    ends = {}
    for place, (device, rasterize) in drawn_here_and_there.items():
        make = DEFORMATIONS[kind] if kind != "framewise" else lambda box: Framewise(FRAMES, len(known.gaussians))
        deformation = make(bounds_of(known.gaussians)).to(device)
        losses: list[float] = []
        fit_motion(
            known.gaussians.to(device), deformation, known.video(), known.prior(0.5), rasterize, settings, seed(),
            lambda _, values, losses=losses: losses.append(values["reference"]),
        )  # fmt: skip
        ends[place] = sum(losses[-10:]) / 10
        assert ends[place] < 0.5 * losses[0]
    assert ends["there"] == pytest.approx(ends["here"], rel=0.2)


@pytest.fixture
def on_gpu(known, emulated_gpu: Emulated, tmp_path: Path) -> ConditionedZero123:
    """Return a tiny Zero-1-to-3 conditioned on the video."""
    model = Zero123.load(write_zero123(tmp_path / "zero123"), Zero123PriorSettings(), preferred_device("cuda_gsplat"))
    return model.conditioned_on(known.video().frames, TimestepSchedule(0.98))


def waits_of_an_iteration(gpu: Emulated, fit: Callable[[Callable[..., None]], object]) -> dict[str, int]:
    """Return the synchronizations of the fourth iteration, after one-time setup."""
    counts = []
    fit(lambda *_: counts.append(gpu.waits))
    return dict(counts[3] - counts[2])


@pytest.mark.gpu
@pytest.mark.parametrize("fit", ["static", "motion"])
def test_an_iteration_waits_for_the_gpu_where_it_draws_and_for_its_losses_only(
    fit: str, known, static_settings: StaticSettings, motion_settings: MotionSettings, emulated_gpu, on_gpu
) -> None:
    """Two drawings: are the Gaussians finite, and how many of gsplat's tiles are touched. Then all losses at once."""
    draw, device = get_rasterizer("cuda_gsplat"), preferred_device("cuda_gsplat")
    cloud, few = known.gaussians.to(device), {"iterations": 4}

    def run(report: Callable[..., None]) -> None:
        if fit == "static":
            settings = static_settings.model_copy(update=few)
            fit_gaussians(cloud, known.subject(), on_gpu, draw, settings, seed(), report)
        else:
            settings = motion_settings.model_copy(update=few)
            deformation = DEFORMATIONS["hexplane"](bounds_of(known.gaussians)).to(device)
            fit_motion(cloud, deformation, known.video(), on_gpu, draw, settings, seed(), report)

    waits = waits_of_an_iteration(emulated_gpu, run)
    assert waits == {"aten::_local_scalar_dense": 4, "copy from the device": 1}


@pytest.mark.gpu
def test_a_batch_that_does_not_fit_into_the_memory_of_a_gpu_is_halved(emulated_gpu: Emulated, on_gpu) -> None:
    """The loss of four views takes more than a quarter above that of one; the gradient is the same in pieces."""
    views = [GuidanceView(OrbitCamera(azimuth_deg=90.0 * i), 0) for i in range(4)]
    pictures = torch.rand(4, 64, 64, 3, generator=seed()).to(preferred_device("cuda_gsplat"))

    def gradient(count: int) -> torch.Tensor:
        seen = pictures[:count].clone().requires_grad_()
        on_gpu.loss(seen, seen[..., :1].detach(), views[:count], 0.5, seed()).backward()
        return seen.grad

    peaks = []
    for count in (1, 4):
        emulated_gpu.has_memory()
        whole = gradient(count)
        peaks.append(emulated_gpu.peak)
    assert not on_gpu.batches.notes()
    emulated_gpu.has_memory((peaks[0] + peaks[1]) // 2)
    halved = gradient(4)
    assert on_gpu.batches.notes() and on_gpu.batches.size < 4
    torch.testing.assert_close(halved, whole, rtol=0.02, atol=1e-3 * float(whole.abs().max()))  # half precision
