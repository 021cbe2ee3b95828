"""Camera rings for priors that score several views together."""

import pytest
import torch

from dg4d_lib.fitting.motion import sample_views
from dg4d_lib.fitting.static import sample_cameras
from dg4d_lib.guidance.interface import ring_size
from dg4d_lib.settings import MotionSettings, StaticSettings


class Judge:
    viewpoints, frames = None, None

    def loss(self, images, alpha, views, progress, generator):
        return images.sum()


class RingJudge(Judge):
    ring_size = 4


def turns(cameras) -> list[float]:
    return [(camera.azimuth_deg - cameras[0].azimuth_deg) % 360 for camera in cameras]


def test_a_prior_without_a_ring_judges_every_view_for_itself():
    assert ring_size(Judge()) == 1
    cameras = sample_cameras(Judge(), StaticSettings(views=4), 32, torch.Generator().manual_seed(0))
    assert len({camera.elevation_deg for camera in cameras}) == 4


def test_the_static_stage_draws_rings():
    cameras = sample_cameras(RingJudge(), StaticSettings(views=8), 32, torch.Generator().manual_seed(0))
    assert turns(cameras[:4]) == turns(cameras[4:]) == pytest.approx([0, 90, 180, 270])


def test_in_the_dynamic_stage_a_ring_is_of_one_frame():
    frames = torch.tensor([2, 5, 7])
    views, rows = sample_views(RingJudge(), frames, MotionSettings(views=4), 32, torch.Generator().manual_seed(0))
    for k, frame in enumerate((2, 5, 7)):
        ring = views[4 * k : 4 * k + 4]
        assert {view.frame for view in ring} == {frame}
        assert turns([view.camera for view in ring]) == pytest.approx([0, 90, 180, 270])
        assert rows[4 * k : 4 * k + 4].tolist() == [k] * 4
