"""Which assets stand in a scene, where, and when they move: what a scene file says."""

from typing import Annotated

from pydantic import Field

from dg4d_lib.settings import NotNegative, Positive, Settings

Number = Annotated[float, Field(ge=-1e6, le=1e6)]


class SceneItem(Settings):
    """An asset in a scene. World: right-handed, y up; an asset looks along +z before it is turned."""

    package: str = Field(min_length=1, description="folder of the package, relative to the folder of the scene file")
    name: str = Field("", max_length=200, description="in the scene; empty: that of the folder")
    position: tuple[Number, Number, Number] = Field(
        (0.0, 0.0, 0.0),
        description="of its foot: below the middle of the box it moves in, as low as its first frame; world units",
    )
    rotation_deg: tuple[Number, Number, Number] = Field(
        (0.0, 0.0, 0.0), description="about x, then y, then z of the scene, through its foot"
    )
    scale: Positive = Field(1.0, le=1e6)
    start_s: NotNegative = Field(0.0, description="when its first frame is shown, seconds; it stands still before")
    speed: Positive = Field(1.0, le=1e3, description="how much faster than recorded it plays")
    loop: bool = Field(True, description="until the scene ends; else it plays once")


class Scene(Settings):
    """Assets, placed and timed."""

    items: tuple[SceneItem, ...] = Field(min_length=1, max_length=1000)
    duration_s: Positive | None = Field(None, le=3600, description="seconds; not given: when every asset played once")
    fps: float = Field(24.0, ge=1, le=120, description="frames per second of the film")
