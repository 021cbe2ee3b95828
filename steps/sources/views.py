"""Format of the views that a user gives: `views.json` and the files that it names. Imports no torch.

A zip of pictures with their azimuths, of a turntable video, or of pictures or videos with known cameras.
"""

import math
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from dg4d_lib.errors import BadInput, quoted
from steps.artifacts.archives import stays_inside
from steps.contract import Frozen, settings_errors

VIEWS_JSON = "views.json"
LARGEST_JSON = 16 * 2**20  # bytes
MOST_VIEWS = 64  # pictures or cameras
CLOSE_DEG = 2.0  # two views nearer to each other count as one
LARGEST_AZIMUTH_DEG = 360.0
HIGHEST_DEG = 80.0  # elevation; near a pole the azimuth is undefined
OTHER_SHAPE = 0.02  # ratio of width to height by which picture and camera may differ: rounding after shrinking
DISTORTED = 0.05  # largest lens distortion coefficient that is ignored
Side = Annotated[int, Field(gt=0, le=1_000_000)]  # of a picture, pixels


class PlacedCamera(Frozen):
    """Camera of a picture, as transforms.json gives it.

    Attributes:
        matrix: camera to world, OpenGL axes (x right, y up, z backward).
        focal: focal length, in widths of the picture.
        center: principal point, in widths and heights of the picture.
        size: width and height of the picture, pixels; None if unknown.
    """

    matrix: tuple[tuple[float, float, float, float], ...]
    focal: float = Field(gt=0)
    center: tuple[float, float] = (0.5, 0.5)
    size: tuple[Side, Side] | None = None

    def check_shape(self, size: tuple[int, int], name: str) -> None:
        """Refuse a picture of another shape than that of the camera: its focal length would be wrong.

        Args:
            size: width and height of the upright picture, pixels.
            name: of the picture, for the message.

        Raises:
            BadInput: names both sizes.
        """
        if self.size is None:
            return
        ratio = size[0] * self.size[1] / (size[1] * self.size[0])
        if max(ratio, 1 / ratio) > 1 + OTHER_SHAPE:
            raise BadInput(
                f"{name} is {size[0]} x {size[1]} pixels, its camera {self.size[0]} x {self.size[1]}: give the picture "
                "that the camera was computed from, without a turn in its EXIF data, or correct w and h in "
                "transforms.json"
            )


class GivenView(Frozen):
    """Picture, or video, from one direction.

    Attributes:
        file: name in the zip.
        name: name for messages.
        azimuth: degrees, 0 is the input view, 90 the side that it shows on the right.
        elevation: degrees, positive above.
        camera: known camera, which replaces the angles.
    """

    file: str
    name: str
    azimuth: float = Field(0.0, ge=-LARGEST_AZIMUTH_DEG, le=LARGEST_AZIMUTH_DEG)
    elevation: float = Field(0.0, ge=-HIGHEST_DEG, le=HIGHEST_DEG)
    camera: PlacedCamera | None = None


class GivenViews(Frozen):
    """Content of `views.json`.

    Attributes:
        views: pictures, in the order in which they were given.
        turntable: name in the zip of a video of the still subject, turned once; empty without.
        input_camera: camera of the input; None without known cameras.
    """

    views: tuple[GivenView, ...] = Field((), max_length=MOST_VIEWS)
    turntable: str = ""
    input_camera: PlacedCamera | None = None


def read_views(folder: Path) -> GivenViews:
    """Read the `views.json` of an unpacked zip.

    Raises:
        BadInput: it is of another form, or names a file outside of the zip.
    """
    try:
        given = GivenViews.model_validate_json((folder / VIEWS_JSON).read_bytes())
    except (OSError, ValidationError) as error:
        raise BadInput(f"the views cannot be read: {error}; give them with --view, --turntable or --cameras") from error
    for name in filter(None, (*(view.file for view in given.views), given.turntable)):
        if not stays_inside(name) or not (folder / name).is_file():
            raise BadInput(f"{VIEWS_JSON} names {quoted(name)}, which is not among the views")
    return given


def parse_view(text: str) -> tuple[float, float, str]:
    """Parse `AZIMUTH[,ELEVATION]=FILE`.

    Raises:
        BadInput: it is not of this form, or an angle is out of range.
    """
    angles, equals, file = text.partition("=")
    try:
        numbers = [float(part) for part in angles.split(",")]
        if not equals or not file.strip() or len(numbers) > 2 or not all(map(math.isfinite, numbers)):
            raise ValueError
    except ValueError:
        raise BadInput(
            f"{quoted(text)} is not a view: write AZIMUTH[,ELEVATION]=FILE in degrees, for example 90=right.png"
        ) from None
    azimuth, elevation = (*numbers, 0.0)[:2]
    check_direction(azimuth, elevation, text)
    return azimuth, elevation, file.strip()


def check_direction(azimuth: float, elevation: float, name: str) -> None:
    """Refuse a direction out of range.

    Args:
        azimuth: degrees.
        elevation: degrees.
        name: of the view, for the message.

    Raises:
        BadInput: names the view, the wrong angle and what is allowed.
    """
    angles = (("azimuth", azimuth, LARGEST_AZIMUTH_DEG), ("elevation", elevation, HIGHEST_DEG))
    wrong = [
        f"{angle} {value:g} is out of range; use -{most:g} to {most:g}"
        for angle, value, most in angles
        if not abs(value) <= most  # NaN is out of range, too
    ]
    if wrong:
        raise BadInput(f"{quoted(name)}: {'; '.join(wrong)}")


def check_apart(places: list[tuple[float, float, str]]) -> None:
    """Refuse two views of one direction; azimuth and elevation 0 is the input's.

    Args:
        places: azimuth, elevation and name.

    Raises:
        BadInput: names both.
    """
    known = [(0.0, 0.0, "the input")]
    for azimuth, elevation, name in places:
        for other_azimuth, other_elevation, other in known:
            around = abs((azimuth - other_azimuth + 180) % 360 - 180)
            if around < CLOSE_DEG and abs(elevation - other_elevation) < CLOSE_DEG:
                raise BadInput(
                    f"{name} and {other} are views of one direction (azimuth {azimuth:g}, elevation {elevation:g}); "
                    "keep one of them, or correct the azimuth: 90 is the side that the input shows on the right, 180 "
                    "the back"
                )
        known.append((azimuth, elevation, name))


class _Loose(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


Bounded = Annotated[float, Field(ge=-1e6, le=1e6)]  # larger ones are not places, and overflow when squared
Row = tuple[Bounded, Bounded, Bounded, Bounded]


class _Intrinsics(_Loose):
    """Intrinsics of all frames, or of one."""

    fl_x: float | None = Field(None, gt=0)
    cx: float | None = None
    cy: float | None = None
    w: Side | None = None
    h: Side | None = None
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @property
    def distortion(self) -> float:
        """Largest distortion coefficient of the lens."""
        return max(map(abs, (self.k1, self.k2, self.k3, self.k4, self.p1, self.p2)))


class TransformsFrame(_Intrinsics):
    """Frame of a transforms.json; intrinsics of its own win over the common ones."""

    file_path: str = Field(min_length=1)
    transform_matrix: Annotated[tuple[Row, ...], Field(min_length=3, max_length=4)]


class Transforms(_Intrinsics):
    """Content of a transforms.json of nerfstudio: pinhole cameras in OpenGL axes."""

    frames: tuple[TransformsFrame, ...] = Field(min_length=2, max_length=MOST_VIEWS + 1)
    camera_angle_x: float | None = Field(None, gt=0, lt=math.pi)
    camera_model: str = "OPENCV"

    @model_validator(mode="after")
    def _pinhole(self) -> Self:
        bent = max(self.distortion, *(frame.distortion for frame in self.frames))
        if bent > DISTORTED or "FISHEYE" in self.camera_model.upper():
            raise ValueError(f"the lens is distorted (coefficient {bent:g}); give undistorted pictures")
        return self

    def camera(self, frame: TransformsFrame) -> PlacedCamera:
        """Return the camera of a frame.

        Raises:
            BadInput: no focal length is given, or no size of the picture to go with it.
        """
        width, height = frame.w or self.w, frame.h or self.h
        focal, x, y = frame.fl_x or self.fl_x, frame.cx or self.cx, frame.cy or self.cy
        if focal and width:
            share = focal / width
        elif self.camera_angle_x:
            share = 0.5 / math.tan(self.camera_angle_x / 2)
        else:
            raise BadInput(
                f"{quoted(frame.file_path)} has no focal length: give fl_x, w and h in pixels, or camera_angle_x in "
                "radians"
            )
        center = (x / width if x and width else 0.5, y / height if y and height else 0.5)
        size = (width, height) if width and height else None
        return PlacedCamera(matrix=frame.transform_matrix[:3], focal=share, center=center, size=size)


def read_transforms(path: Path) -> Transforms:
    """Read a transforms.json.

    Raises:
        BadInput: it is too large or of another form.
    """
    try:
        if (size := path.stat().st_size) > LARGEST_JSON:
            raise BadInput(f"{path} has {size} bytes; at most {LARGEST_JSON} are read")
        return Transforms.model_validate_json(path.read_bytes())
    except OSError as error:
        raise BadInput(f"{path} cannot be read: {error.strerror}") from error
    except ValidationError as error:
        raise BadInput(
            f"{path} is not a transforms.json of nerfstudio (frames with file_path and transform_matrix): "
            f"{settings_errors(error)}"
        ) from error
