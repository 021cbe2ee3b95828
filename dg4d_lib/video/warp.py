"""Driving videos without a video model: looping warps of the input picture."""

import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.inflation.hints import NO_HINT, DepthHint
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import inflate
from dg4d_lib.input_settings import Motion, WarpSettings
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.limbs import WAVE_DEG, LimbAnimator, waving_limbs
from dg4d_lib.video.puppet import Puppet
from dg4d_lib.video.puppet_motions import BEND_DEG, JUMP, SWAY_DEG, bounce, breathe, jump_height, lean

TURN_DEG = 20.0  # amplitude of `turn`, degrees
TURN_SIZE = 256  # maximum resolution of the inflated surface for `turn`, pixels
FOR_BUSTS = ("sway", "breathe", "turn")  # motions that do not move a cropped lower border
MOTIONS: tuple[Motion, ...] = ("sway", "bend", "breathe", "bounce", "wave", "turn")
WEAKER = 0.6  # factor of the strength for each repetition of the list of motions
SMALL_JUMP = 0.5  # share of the requested height; the user is told about lower jumps


def candidate_settings(settings: WarpSettings, number: int) -> WarpSettings:
    """Return the settings of a candidate: first the configured motion, then the other ones, then all of them weaker.

    Args:
        settings: configured motion and strength.
        number: of the candidate, from 1.
    """
    index = (MOTIONS.index(settings.motion) + number - 1) % len(MOTIONS)
    rounds = (number - 1) // len(MOTIONS)
    return settings.model_copy(update={"motion": MOTIONS[index], "strength": settings.strength * WEAKER**rounds})


class Warp:
    """Generator of looping motions; needs no weights and no random numbers.

    `sway` and `bend` lean like a beam clamped at the feet, `breathe` swells, `bounce` hops, `wave` moves limbs, `turn`
    rotates the inflated surface by 20 degrees to both sides. The frame after the last is the first.

    Attributes:
        notes: sentences for the user about deviations of the last video from the configured motion.
    """

    def __init__(self, settings: WarpSettings, hint: DepthHint = NO_HINT) -> None:
        """Store the settings, and the depth hints of the subject, for `turn`."""
        self.settings, self.hint = settings, hint
        self.notes: tuple[str, ...] = ()

    def generate(self, subject: Float[Tensor, "h w 4"], generator: torch.Generator) -> DrivingVideo:
        """Generate the video; its first frame is the subject at rest (for `turn`: a render of its inflated surface).

        Args:
            subject: straight alpha, in [0, 1]; square for `turn`.
            generator: not used.

        Raises:
            BadInput: the picture shows no subject.
        """
        self.notes = ()
        if self.settings.motion == "turn":
            return self._turn(subject)
        puppet = Puppet(subject.double().cpu().numpy())
        pose = self._choose_motion(puppet)
        frames = torch.from_numpy(np.stack([pose(phase) for phase in self._phases()])).to(subject)
        return DrivingVideo(frames[..., :3], frames[..., 3:], self.settings.fps)

    def _phases(self) -> Iterator[float]:
        return (frame / self.settings.frames for frame in range(self.settings.frames))

    def _choose_motion(self, puppet: Puppet) -> Callable[[float], Float64[np.ndarray, "h w 4"]]:
        """Return a function that draws the puppet at a phase of the motion."""
        motion, strength = self.settings.motion, self.settings.strength
        nodes, bounds = puppet.nodes, puppet.bounds
        if bounds.cropped and motion not in FOR_BUSTS:
            self.notes += (f"the subject is cropped at the lower border, so it sways instead of '{motion}'",)
            motion = "sway"
        if motion == "wave":
            limbs = waving_limbs(puppet)
            if limbs:
                animator = LimbAnimator(puppet, limbs)
                return lambda phase: animator.draw(math.radians(WAVE_DEG) * strength * math.sin(2 * math.pi * phase))
            self.notes += ("the subject has no limb that could wave, so it bends instead",)
            motion = "bend"
        if motion == "bounce":
            if jump_height(bounds, strength) < SMALL_JUMP * JUMP * strength:
                self.notes += ("there is little room above the subject, so it jumps lower",)
            return lambda phase: puppet.draw(bounce(nodes, bounds, phase, strength))
        if motion == "breathe":
            return lambda phase: puppet.draw(breathe(nodes, bounds, phase, strength))
        degrees = strength * (BEND_DEG if motion == "bend" else SWAY_DEG)
        return lambda phase: puppet.draw(lean(nodes, bounds, phase, degrees))

    def _turn(self, subject: Float[Tensor, "h w 4"]) -> DrivingVideo:
        height, width = subject.shape[:2]
        surface = inflate(subject, min(height, TURN_SIZE), self.hint)
        angles = [TURN_DEG * self.settings.strength * math.sin(2 * math.pi * phase) for phase in self._phases()]
        cameras = [OrbitCamera(azimuth_deg=angle, width=width, height=height) for angle in angles]
        color, alpha = render_surface(surface, cameras)
        return DrivingVideo(color.to(subject), alpha.to(subject), self.settings.fps)
