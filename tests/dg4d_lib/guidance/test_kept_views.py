import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.kept_views import KeptViews


def test_a_view_is_drawn_once_and_stays_what_it_was():
    drawn: list[GuidanceView] = []

    def draw(views):
        drawn.extend(views)
        both = torch.stack([torch.full((4, 4, 4), (view.camera.azimuth_deg + view.frame) / 360) for view in views])
        return both[..., :3], both[..., 3:]

    kept = KeptViews(draw)
    a, b, c = (GuidanceView(OrbitCamera(0, azimuth), frame) for azimuth, frame in ((10, 0), (10, 1), (200, 0)))
    for views in ([a, b], [b, c, b], [c, a]):
        color, alpha = kept.clean(views)
        wanted = torch.tensor([(view.camera.azimuth_deg + view.frame) / 360 for view in views])
        for values, shape in ((color, (4, 4, 3)), (alpha, (4, 4, 1))):
            assert values.dtype == torch.float32 and values.shape == (len(views), *shape)
            assert (values - wanted[:, None, None, None]).abs().max() < 3e-4
    assert drawn == [a, b, c]
