"""Driving videos without a video model: the picture itself, warped in a loop."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import inflate
from dg4d_lib.settings import Motion, WarpSettings
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.limbs import WAVE_DEG, LimbAnimator, waving_limbs
from dg4d_lib.video.puppet import Puppet
from dg4d_lib.video.puppet_motions import BEND_DEG, JUMP, SWAY_DEG, bounce, breathe, jump_height, lean

TURN_DEG = 20.0
TURN_SIZE = 256  # pixels at which the surface that turns is built, at most
FOR_BUSTS = ("sway", "breathe", "turn")  # motions that leave a cropped lower border where it is
MOTIONS: tuple[Motion, ...] = ("sway", "bend", "breathe", "bounce", "wave", "turn")
WEAKER = 0.6  # times the strength: candidates beyond the number of motions
SMALL_JUMP = 0.5  # of the wanted height: below, the user is told


def candidate_settings(settings: WarpSettings, number: int) -> WarpSettings:
    """The settings of one of several motions: the first is the chosen one, then come the others, then weaker ones.

    Args:
        settings: what the user chose.
        number: from 1.
    """
    place = (MOTIONS.index(settings.motion) + number - 1) % len(MOTIONS)
    rounds = (number - 1) // len(MOTIONS)
    return settings.model_copy(update={"motion": MOTIONS[place], "strength": settings.strength * WEAKER**rounds})


class Warp:
    """A loop of the chosen motion; needs no weights and no randomness.

    `sway` and `bend` lean like a beam held at the feet, `breathe` swells, `bounce` hops, `wave` moves what sticks out,
    `turn` shows the inflated surface from 20 degrees left and right. The frame after the last is the first.

    Attributes:
        notes: what the last video does otherwise than asked, in sentences for the user.
    """

    def __init__(self, settings: WarpSettings, turn_deg: float = 0.0) -> None:
        """Choose the motion, its strength, how many frames at which rate, and how the subject is turned (`turn`)."""
        self.settings, self.turn_deg = settings, turn_deg
        self.notes: tuple[str, ...] = ()

    def generate(self, subject: Float[Tensor, "h w 4"], generator: torch.Generator) -> DrivingVideo:
        """The moving subject; the first frame shows it as it is (of `turn`: as its inflated surface).

        Args:
            subject: straight alpha, in [0, 1]; square for `turn`.
            generator: not used.

        Raises:
            BadInput: there is no subject in the picture.
        """
        self.notes = ()
        if self.settings.motion == "turn":
            return self._turn(subject)
        puppet = Puppet(subject.double().cpu().numpy())
        pose = self._choose(puppet)
        frames = torch.from_numpy(np.stack([pose(phase) for phase in self._phases()])).to(subject)
        return DrivingVideo(frames[..., :3], frames[..., 3:], self.settings.fps)

    def _phases(self) -> Iterator[float]:
        return (frame / self.settings.frames for frame in range(self.settings.frames))

    def _choose(self, puppet: Puppet) -> Callable[[float], Float64[np.ndarray, "h w 4"]]:
        """The puppet's picture by phase."""
        motion, strength = self.settings.motion, self.settings.strength
        nodes, bounds = puppet.nodes, puppet.bounds
        if bounds.cropped and motion not in FOR_BUSTS:
            self.notes += (f"the picture's lower border cuts the subject off, so it sways instead of '{motion}'",)
            motion = "sway"
        if motion == "wave":
            limbs = waving_limbs(puppet)
            if limbs:
                waver = LimbAnimator(puppet, limbs)
                return lambda phase: waver.draw(math.radians(WAVE_DEG) * strength * math.sin(2 * math.pi * phase))
            self.notes += ("nothing sticks out that could wave, so the subject bends instead",)
            motion = "bend"
        if motion == "bounce":
            if jump_height(bounds, strength) < SMALL_JUMP * JUMP * strength:
                self.notes += ("there is little room above the subject, so it jumps less high",)
            return lambda phase: puppet.draw(bounce(nodes, bounds, phase, strength))
        if motion == "breathe":
            return lambda phase: puppet.draw(breathe(nodes, bounds, phase, strength))
        degrees = strength * (BEND_DEG if motion == "bend" else SWAY_DEG)
        return lambda phase: puppet.draw(lean(nodes, bounds, phase, degrees))

    def _turn(self, subject: Float[Tensor, "h w 4"]) -> DrivingVideo:
        height, width = subject.shape[:2]
        surface = inflate(subject, min(height, TURN_SIZE), self.turn_deg)
        angles = [TURN_DEG * self.settings.strength * math.sin(2 * math.pi * phase) for phase in self._phases()]
        cameras = [OrbitCamera(azimuth_deg=angle, width=width, height=height) for angle in angles]
        color, alpha = render_surface(surface, cameras)
        return DrivingVideo(color.to(subject), alpha.to(subject), self.settings.fps)
