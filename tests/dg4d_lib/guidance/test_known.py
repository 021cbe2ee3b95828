import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "visual_hull"))
from creatures import creature, ring, seen

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.geometric import InflatedSurfaces
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.known import KnownShapes
from dg4d_lib.images import over_white
from dg4d_lib.settings import GeometricPriorSettings

VIEWS = ring(4)
CUTOUTS = [VIEWS[0].cutout, VIEWS[0].cutout.flip(1)]
GEOMETRIC = InflatedSurfaces(CUTOUTS, GeometricPriorSettings(size=48))
SHAPES = KnownShapes(GEOMETRIC, {0: VIEWS})
SIDE = OrbitCamera(0, 105, width=48, height=48)


def test_frames_with_known_views_show_their_hull_and_others_the_guess():
    color, alpha = SHAPES.clean([GuidanceView(SIDE, 1), GuidanceView(SIDE, 0)])
    guessed, guess = GEOMETRIC.clean([GuidanceView(SIDE, 1)])
    assert torch.equal(color[0], guessed[0]) and torch.equal(alpha[0], guess[0])
    truth = seen(creature(), 105, size=48).cutout
    assert float((alpha[1] - truth[..., 3:]).abs().mean()) < 0.02
    assert float((color[1] - over_white(truth)).abs().mean()) < 0.03


def test_only_frames_with_known_views_are_scored():
    assert SHAPES.frames == (0,)
    with pytest.raises(BadInput, match="frame 2"):
        SHAPES.surface(2)
