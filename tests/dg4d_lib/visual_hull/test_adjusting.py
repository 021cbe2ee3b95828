from dataclasses import replace

import pytest
import torch
from creatures import creature, ring, seen

from dg4d_lib.images import resize
from dg4d_lib.video.framing import bounding_box
from dg4d_lib.visual_hull.adjusting import Scaling, adjust_exposure, match_scale, scaling_between


def test_darker_pictures_get_the_exposure_of_the_input():
    views = ring(8)
    dim = [views[0]]
    dim += [replace(v, cutout=torch.cat([v.cutout[..., :3] * 0.6, v.cutout[..., 3:]], -1)) for v in views[1:]]
    for mended, given in zip(adjust_exposure(dim), views, strict=True):
        ratio = mended.cutout[..., :3].sum() / given.cutout[..., :3].sum()
        assert float(ratio) == pytest.approx(1, abs=0.12)  # 0.6 before


def test_equal_exposures_stay():
    views = ring(4)
    assert all(new is old for new, old in zip(adjust_exposure(views), views, strict=True))


def test_a_picture_of_another_scale_is_brought_to_that_of_the_input():
    front, side = seen(creature(), 0).cutout, seen(creature(), 90).cutout
    small = torch.zeros_like(side)
    small[30:78, 10:58] = resize(side[None], (48, 48))[0]
    mended = match_scale(small, front, 90)
    assert bounding_box(mended[None, ..., 3])[1::2] == pytest.approx(bounding_box(front[None, ..., 3])[1::2], abs=1)
    both, either = (mended[..., 3] > 0.5) & (side[..., 3] > 0.5), (mended[..., 3] > 0.5) | (side[..., 3] > 0.5)
    assert float(both.sum() / either.sum()) > 0.75  # across, the middle is all that is known


def test_the_scaling_of_a_picture_is_found_and_undone():
    front = seen(creature(), 0).cutout
    changed = Scaling(1.25, 6, -4).apply(front, 0, 96)
    found = scaling_between(changed, front)
    assert found.factor == pytest.approx(1 / 1.25, rel=0.03) and not found.is_small
    back = found.apply(changed, 0, 96)
    assert float((back[..., 3] - front[..., 3]).abs().mean()) < 0.02  # half a pixel of the outline
    assert scaling_between(front, front).is_small
