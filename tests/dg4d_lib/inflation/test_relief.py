import numpy as np
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.geometric import InflatedSurfaces
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.inflation.relief import relief
from dg4d_lib.inflation.surface import inflate
from dg4d_lib.settings import GeometricPriorSettings

AXIS = np.linspace(-1, 1, 64)
X, Y = np.meshgrid(AXIS, AXIS)
MASK = X**2 + Y**2 < 0.5
DOME = np.sqrt(np.clip(0.5 - X**2 - Y**2, 0, None))


def disc() -> torch.Tensor:
    alpha = torch.from_numpy(MASK.astype(np.float32))
    return torch.stack([alpha, 0.5 * alpha, 0 * alpha, alpha], -1)


def test_an_estimate_of_the_surface_itself_shifts_nothing_in_any_scale() -> None:
    assert np.abs(relief(7 * DOME - 3, DOME, MASK, 1.0)).max() < 1e-9


def test_a_bump_comes_towards_the_camera_in_proportion_to_the_weight() -> None:
    bump = 0.1 * np.exp(-((X - 0.2) ** 2 + Y**2) / 0.02)
    half, whole = (relief(DOME + bump, DOME, MASK, weight) for weight in (0.5, 1.0))
    row, column = np.unravel_index(whole.argmax(), whole.shape)
    assert abs(X[row, column] - 0.2) < 0.06 and abs(Y[row, column]) < 0.06
    assert np.allclose(half, whole / 2) and 0.04 < whole.max() < 0.1  # smoothed
    assert not whole[~MASK].any()


def test_an_estimate_that_contradicts_the_surface_or_is_flat_or_broken_shifts_nothing() -> None:
    for disparity in (-DOME, np.ones_like(DOME), np.where(X > 0, np.nan, DOME)):
        assert not relief(disparity, DOME, MASK, 1.0).any()


def test_the_input_view_keeps_its_outline_and_the_side_view_shows_the_relief() -> None:
    bump = 0.3 * np.exp(-((X - 0.3) ** 2 + Y**2) / 0.02)
    plain, bent = inflate(disc(), 64), inflate(disc(), 64, disparity=torch.from_numpy(DOME + bump), depth_weight=1.0)
    assert float(bent.vertices[:, 2].max()) > float(plain.vertices[:, 2].max()) + 0.03

    class Estimator:
        def disparity(self, cutout: torch.Tensor) -> torch.Tensor:
            return torch.from_numpy(DOME + bump).float()

    camera = OrbitCamera(width=64, height=64)
    settings = GeometricPriorSettings(size=64, depth_sigma=0, depth_weight=1)
    views = [GuidanceView(camera)]
    alphas = [InflatedSurfaces([disc()], settings, depth=each).clean(views)[1] for each in (None, Estimator())]
    assert float((alphas[0] - alphas[1]).abs().mean()) < 0.005
