"""Pictures of known cameras, framed as the orbit cameras around the input would show them."""

import math
from collections.abc import Callable, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.framing import bounding_box
from dg4d_lib.video.subject import PreparedSubject
from dg4d_lib.visual_hull.adjusting import warped
from dg4d_lib.visual_hull.known import KnownView, known_view
from dg4d_lib.visual_hull.rig import OrbitPlace, meeting_point, orbit_places
from steps.sources.reader import Source
from steps.sources.views import HIGHEST_DEG, GivenViews, PlacedCamera, check_apart

Box = tuple[float, float, float, float]  # left, top, right, bottom; tangents, or halves of the square


def place_pictures(
    given: GivenViews,
    sources: Sequence[Source],
    source: Source,
    first: PreparedSubject,
    inputs: Float[Tensor, "t s s 4"],
    cut_out: Callable[[Source, str, int], PreparedSubject],
) -> list[list[KnownView]]:
    """Return the views of every camera by frame.

    The input's own framing decides the scale: its outline in the source, in tangents, against that in its square.

    Args:
        given: views with their cameras, and the camera of the input.
        sources: decoded files of the views.
        source: decoded file of the input.
        first: its first frame, cut out by the settings of `inputs`.
        inputs: frames of the input, cut out and framed.
        cut_out: cuts the subject out of the file of a view with this name, cropped to it in squares of at most so many
            pixels a side.

    Raises:
        BadInput: a camera faces away from the subject or is above it, or two are equal; or a picture has another
            shape than that of its camera.
    """
    assert given.input_camera is not None, "placed views need the camera of the input"
    given.input_camera.check_shape(source.size, "the input")
    for view, file in zip(given.views, sources, strict=True):
        if view.camera is not None:
            view.camera.check_shape(file.size, view.name)
    cameras = [given.input_camera, *(view.camera for view in given.views if view.camera is not None)]
    poses = torch.tensor([camera.matrix for camera in cameras], dtype=torch.float64)
    size = inputs.shape[1]
    scale, offset = _framing(_box(inputs[:1], 2 / size, 1), _tangent_box(first, given.input_camera, source))
    origin = _origin(poses, meeting_point(poses), scale, offset)
    places = orbit_places(poses, 0, origin)
    _check(places[1:], given)
    views = []
    for view, place, camera, file in zip(given.views, places[1:], cameras[1:], sources, strict=True):
        cut = cut_out(file, view.name, 2 * size)
        theta = _affine(place, camera, file, cut, scale)
        pictures = [warped(frame, theta, size) for frame in cut.frames]
        views.append([known_view(each, place.azimuth_deg, place.elevation_deg, view.name) for each in pictures])
    return views


def _box(cutouts: Float[Tensor, "t s s 4"], unit: float, half: float) -> Box:
    left, top, right, bottom = (edge * unit - half for edge in bounding_box(cutouts[..., 3]))
    return left, top, right, bottom


def _tangent_box(cut: PreparedSubject, camera: PlacedCamera, source: Source) -> Box:
    """Return the outline's box in tangents of the angles from the optical axis."""
    half, (x, y), (zoom, across, down) = _half(camera, source), _principal(camera, source), _crop_place(cut)
    left, top, right, bottom = _box(cut.frames, 2 * zoom / cut.frames.shape[1], zoom)
    x, y = x - across, y - down
    return (left - x) * half, (top - y) * half, (right - x) * half, (bottom - y) * half


def _crop_place(cut: PreparedSubject) -> tuple[float, float, float]:
    """Return half the side, column and row of the middle of a crop in the square around its picture, in [-1, 1]."""
    (height, width), crop = cut.frame, cut.crop
    side = max(height, width)
    return crop.side / side, (2 * crop.left + crop.side - width) / side, (2 * crop.top + crop.side - height) / side


def _half(camera: PlacedCamera, source: Source) -> float:
    """Return the tangent of half the square frame around the picture."""
    height, width = source.frames.shape[1:3]
    return max(height, width) / width / camera.focal / 2


def _principal(camera: PlacedCamera, source: Source) -> tuple[float, float]:
    """Return the principal point in the square frame, in [-1, 1]."""
    height, width = source.frames.shape[1:3]
    side = max(height, width)
    return (2 * camera.center[0] - 1) * width / side, (2 * camera.center[1] - 1) * height / side


def _framing(framed: Box, tangents: Box) -> tuple[float, tuple[float, float]]:
    """Return scale and offset from tangents to places in the framed input, in [-1, 1]."""
    scale = (framed[3] - framed[1]) / max(1e-9, tangents[3] - tangents[1])
    middle = (
        [(box[0] + box[2]) / 2 for box in (framed, tangents)],
        [(box[1] + box[3]) / 2 for box in (framed, tangents)],
    )
    return scale, (middle[0][0] - scale * middle[0][1], middle[1][0] - scale * middle[1][1])


def _origin(
    poses: Float[Tensor, "k 3 4"], meeting: Float[Tensor, " 3"], scale: float, offset: tuple[float, float]
) -> Float[Tensor, " 3"]:
    """Return the point in the middle of the framed input, as far away as the subject."""
    pose = poses[0]
    depth = -float((meeting - pose[:, 3]) @ pose[:, 2])
    x, y = -offset[0] / scale, -offset[1] / scale  # tangents of the middle, y down
    return pose[:, 3] + depth * (x * pose[:, 0] - y * pose[:, 1] - pose[:, 2])


def _affine(
    place: OrbitPlace, camera: PlacedCamera, source: Source, cut: PreparedSubject, scale: float
) -> Float[Tensor, "1 2 3"]:
    """Return the map from places in the framed view to places in the crop of the picture."""
    half, (x, y), (side, across, down) = _half(camera, source), _principal(camera, source), _crop_place(cut)
    c, s = math.cos(math.radians(place.roll_deg)), math.sin(math.radians(place.roll_deg))
    zoom = 1 / (scale * place.distance * half * side)
    rows = [
        [c * zoom, -s * zoom, (place.center[0] / half + x - across) / side],
        [s * zoom, c * zoom, (place.center[1] / half + y - down) / side],
    ]
    return torch.tensor([rows])


def _check(places: Sequence[OrbitPlace], given: GivenViews) -> None:
    """Refuse cameras near a pole, and two cameras in one place."""
    pairs = list(zip(places, given.views, strict=True))
    for place, view in pairs:
        if abs(place.elevation_deg) > HIGHEST_DEG:
            raise BadInput(
                f"{view.name} was taken from {place.elevation_deg:.0f} degrees above the input's horizon; cameras from "
                f"-{HIGHEST_DEG:g} to {HIGHEST_DEG:g} are used: leave it out"
            )
    check_apart([(place.azimuth_deg, place.elevation_deg, view.name) for place, view in pairs])
