"""Objects with ground truth: input video, view bank of the oracle, and held-out views for scoring."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.objects.drawing import Painted
from benchmarks.objects.excavator import Excavator
from benchmarks.objects.jellyfish import Jellyfish
from benchmarks.objects.parrot import Parrot
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.video.driving import DrivingVideo
from examples.drawing import Creature
from examples.newt import Newt
from steps.artifacts.ground_truth import GroundTruth
from steps.artifacts.media import read_png
from steps.fitting.priors import read_bank_folder

OBJECTS: dict[str, Callable[[], Creature]] = {  # walking, flying, soft and rigid motion
    "newt": Newt,
    "parrot": Parrot,
    "jellyfish": Jellyfish,
    "excavator": Excavator,
}
SCORED_AZIMUTHS_DEG = (-75, 15, 105, 195)  # degrees, of Consistent4D; none of them is in a bank
BANK_AZIMUTHS = 16  # number of views, at equal steps of azimuth
BANK_ELEVATIONS_DEG = (-20.0, 0.0, 20.0)
FPS = 12.0


@dataclass(frozen=True)
class Specimen:
    """Ground truth of an object.

    Attributes:
        name: of the object.
        cutouts: of the input camera, straight alpha.
        bank: views of the oracle prior.
        cameras: held out for scoring.
        views: of these cameras, straight alpha, one row per camera.
    """

    name: str
    cutouts: Float[Tensor, "t h w 4"]
    bank: Bank
    cameras: tuple[OrbitCamera, ...]
    views: Float[Tensor, "v t g x 4"]

    @property
    def video(self) -> DrivingVideo:
        """Return the driving video."""
        return DrivingVideo(self.cutouts[..., :3], self.cutouts[..., 3:], FPS)


def render_specimen(name: str, frames: int, size: int) -> Specimen:
    """Render one of our own objects: a loop of this many frames, `size` pixels.

    Raises:
        KeyError: there is no such object.
    """
    painted = Painted(OBJECTS[name]())
    scored = tuple(OrbitCamera(0, azimuth, width=size, height=size) for azimuth in SCORED_AZIMUTHS_DEG)
    known = tuple(
        OrbitCamera(elevation, 360 * i / BANK_AZIMUTHS, width=size, height=size)
        for elevation in BANK_ELEVATIONS_DEG
        for i in range(BANK_AZIMUTHS)
    )
    everywhere = [OrbitCamera(width=size, height=size), *scored, *known]
    pictures = torch.stack([painted.draw(frame / frames, everywhere) for frame in range(frames)], 1)
    first = 1 + len(scored)
    bank = Bank(known, tuple(range(frames)), (pictures[first:] * 255).round().to(torch.uint8))
    return Specimen(name, pictures[0], bank, scored, pictures[1:first])


def read_specimen(ground_truth: GroundTruth, frames: int) -> Specimen:
    """Read an object of a data set.

    Of a longer video every second, third ... frame is taken, whatever gives at most `frames`.

    Raises:
        BadInput: it has no bank, or one without the first frame; no views; or pictures that cannot be compared.
    """
    if ground_truth.bank is None:
        raise BadInput(f"{ground_truth.name} has no bank/ of ground-truth views; the oracle prior needs one")
    if not ground_truth.views:
        raise BadInput(f"{ground_truth.name} has no view_<azimuth>/ with ground-truth views; scores need at least one")
    stride = -(-len(ground_truth.inputs) // frames)
    full = read_bank_folder(ground_truth.bank)
    kept = [column for column, frame in enumerate(full.frames) if frame % stride == 0]
    frame_numbers = tuple(full.frames[column] // stride for column in kept)
    if 0 not in frame_numbers:
        raise BadInput(f"the bank/ of {ground_truth.name} has no frame 0; the static stage needs it")
    bank = Bank(full.cameras, frame_numbers, full.pictures[:, kept])
    pictures = _pictures(ground_truth, stride)
    size = pictures.shape[2]
    cameras = tuple(OrbitCamera(0, view.azimuth_deg, width=size, height=size) for view in ground_truth.views)
    return Specimen(ground_truth.name, pictures[0], bank, cameras, pictures[1:])


def _pictures(ground_truth: GroundTruth, stride: int) -> Float[Tensor, "v t s s 4"]:
    """Return the frames of the input camera and of all views, as many of each."""
    folders = [ground_truth.inputs, *(view.frames for view in ground_truth.views)]
    rows = [[read_png(path) for path in folder[: len(ground_truth.inputs) : stride]] for folder in folders]
    shapes = {picture.shape for row in rows for picture in row}
    if len(shapes) > 1 or any(height != width or channels != 4 for height, width, channels in shapes):
        found = ", ".join(sorted(" x ".join(map(str, shape)) for shape in shapes))
        raise BadInput(f"input and views of {ground_truth.name} must be square, of one size and RGBA; found {found}")
    return torch.stack([torch.stack(row) for row in rows])
