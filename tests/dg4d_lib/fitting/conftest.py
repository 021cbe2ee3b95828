"""Moving object with known images, and its exact prior."""

from collections.abc import Sequence

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.guidance.analytic import AnalyticPrior
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from dg4d_lib.settings import MotionSettings, ResolutionStage, StaticSettings
from dg4d_lib.video.driving import DrivingVideo

SIZE, FRAMES, SLIDE = 32, 4, 0.3
LADDER = (ResolutionStage(until=1.0, size=SIZE),)


class KnownObject:
    """A few dozen colored Gaussians that move along x."""

    def __init__(self) -> None:
        generator = torch.Generator().manual_seed(4)
        means = (torch.rand(40, 3, generator=generator) - 0.5) * 0.7
        self.gaussians = isotropic(means, torch.full((40,), 0.06), torch.rand(40, 3, generator=generator), 0.95)
        self.rasterize: Rasterizer = get_rasterizer("cpu")

    def at(self, frames: Sequence[int]) -> Gaussians:
        shift = torch.tensor([[SLIDE * frame / (FRAMES - 1), 0.0, 0.0] for frame in frames])[:, None]
        g, n = self.gaussians, len(frames)
        return Gaussians(
            g.means + shift,
            g.log_scales.expand(n, -1, -1),
            g.quats.expand(n, -1, -1),
            g.opacity_logits,
            g.harmonics,
        )

    def clean(self, views: Sequence[GuidanceView]) -> tuple[torch.Tensor, torch.Tensor]:
        picture = self.rasterize(
            self.at([view.frame for view in views]), [view.camera for view in views], torch.ones(3)
        )
        return picture.color, picture.alpha

    def prior(self, t_max_start: float) -> AnalyticPrior:
        return AnalyticPrior(self.clean, TimestepSchedule(t_max_start))

    def video(self) -> DrivingVideo:
        camera = OrbitCamera(width=SIZE, height=SIZE)
        picture = self.rasterize(self.at(range(FRAMES)), [camera] * FRAMES, torch.zeros(3))
        return DrivingVideo(picture.color / picture.alpha.clamp(min=1e-3), picture.alpha, 8.0)

    def subject(self) -> torch.Tensor:
        video = self.video()
        return torch.cat([video.frames[0], video.alpha[0]], -1)


@pytest.fixture(scope="session")
def known() -> KnownObject:
    return KnownObject()


@pytest.fixture
def static_settings() -> StaticSettings:
    return StaticSettings(
        iterations=150,
        views=4,
        resolution_schedule=LADDER,
        reference_size=SIZE,
        start={"kind": "blob", "points": 300},
        densify_every=50,
    )


@pytest.fixture
def motion_settings() -> MotionSettings:
    return MotionSettings(
        iterations=120, views=1, resolution_schedule=LADDER, reference_size=SIZE, plane_lr=0.02, network_lr=0.005
    )
