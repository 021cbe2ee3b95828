"""Scene file format: assets with placement and timing."""

from typing import Annotated

from pydantic import Field

from dg4d_lib.settings import NotNegative, Positive, Settings

Number = Annotated[float, Field(ge=-1e6, le=1e6)]


class SceneItem(Settings):
    """Placement and timing of an asset. World axes: right-handed, y up; unrotated assets face +z."""

    package: str = Field(min_length=1, description="folder of the package, relative to the folder of the scene file")
    name: str = Field("", max_length=200, description="name in the scene; empty: name of the folder")
    position: tuple[Number, Number, Number] = Field(
        (0.0, 0.0, 0.0),
        description="position of its foot, meters: below the center of its bounding box over all frames, at the "
        "lowest point of the first frame",
    )
    rotation_deg: tuple[Number, Number, Number] = Field(
        (0.0, 0.0, 0.0), description="rotation about the x, then y, then z axis of the scene, through its foot"
    )
    scale: Positive = Field(1.0, le=1e6)
    start_s: NotNegative = Field(0.0, description="start of its animation, seconds; it stands still before")
    speed: Positive = Field(1.0, le=1e3, description="playback speed relative to the recording")
    loop: bool = Field(
        True, description="true: loops until the scene ends; false: plays once, then stands in its last pose"
    )


class Scene(Settings):
    """Content of a scene file."""

    items: tuple[SceneItem, ...] = Field(min_length=1, max_length=1000)
    duration_s: Positive | None = Field(
        None, le=3600, description="seconds; default: until every asset has played once"
    )
    fps: float = Field(24.0, ge=1, le=120, description="frames per second of the preview video")
