import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.kept_views import KeptViews


def test_a_view_is_drawn_once_and_stays_what_it_was():
    drawn: list[GuidanceView] = []
    ramp = torch.linspace(0, 0.4, 4 * 6 * 4).view(4, 6, 4)  # every pixel and channel differs

    def pictures(views):
        return torch.stack([ramp + (view.camera.azimuth_deg + view.frame) / 360 for view in views])

    def draw(views):
        drawn.extend(views)
        return pictures(views)[..., :3], pictures(views)[..., 3:]

    kept = KeptViews(draw)
    a, b, c = (GuidanceView(OrbitCamera(0, azimuth), frame) for azimuth, frame in ((10, 0), (10, 1), (200, 0)))
    for views in ([a, b], [b, c, b], [c, a]):
        color, alpha = kept.clean(views)
        for values, expected in ((color, pictures(views)[..., :3]), (alpha, pictures(views)[..., 3:])):
            assert values.dtype == torch.float32 and values.shape == expected.shape
            assert (values - expected).abs().max() < 3e-4
    assert drawn == [a, b, c]
