"""Manifest of a package, `asset.json`."""

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from dg4d_lib.assets.placement import Placement
from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS
from dg4d_lib.errors import BadInput
from steps.artifacts.package_files import MANIFEST
from steps.contract import Frozen
from steps.store.files import require_regular

WIDEST_FOV_DEG = 179.9  # at 180 degrees, the focal length is 0


class PackagePlacement(Frozen):
    """Map from the coordinates of canonical/ to those of all other files: x to `scale` * x + `translation`."""

    scale: float = Field(1.0, gt=0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def placement(self) -> Placement:
        """The placement as an object of the library."""
        return Placement(self.scale, self.translation)


class Camera(Frozen):
    """Camera of the input picture, and the convention of its angles."""

    elevation_deg: float = 0.0
    azimuth_deg: float = 0.0
    radius: float = RADIUS
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fov_y_deg: float = FOV_Y_DEG
    whole_fov_y_deg: float | None = Field(
        None,
        gt=0,
        le=WIDEST_FOV_DEG,
        description="field of view of square pictures that hold the whole animation from all sides, at the distance of "
        "the input camera; older packages have none",
    )
    convention: str = (
        "right-handed world in meters, y up, the front looks along +z; the camera looks at `target` from a distance of "
        "`radius`; azimuth 0 is on +z, 90 on +x; positive elevation is above"
    )

    @classmethod
    def placed(cls, placement: Placement, whole_fov_y_deg: float) -> "Camera":
        """Return the camera in the coordinates of the files."""
        return cls(
            radius=RADIUS * placement.scale,
            target=placement.translation,
            whole_fov_y_deg=min(round(whole_fov_y_deg, 1), WIDEST_FOV_DEG),
        )


class Manifest(Frozen):
    """Content of a package, an animation that loops: frame i is shown at i / fps seconds.

    With `pack.fps`, the number of frames differs from that of the driving video.
    """

    format: Literal["dg4d-asset"] = "dg4d-asset"
    version: Literal[1] = 1
    generator: str
    mode: Literal["tracked", "per_frame", "own"]
    fps: float = Field(gt=0)
    frames: int = Field(ge=1)
    duration_s: float
    gaussians: int = Field(ge=0)
    vertices: tuple[int, ...] = Field(description="of the tracked mesh, or of every frame's mesh")
    triangles: tuple[int, ...] = Field(description="of the tracked mesh, or of every frame's mesh")
    placement: PackagePlacement = PackagePlacement()
    camera: Camera = Camera()
    ply_axes: Literal["y_up", "y_down"] = Field(
        "y_up", description="of splats/*.ply; y_down: x right, y down, z forward, as other programs expect"
    )
    files: dict[str, str] = Field(description="description of every file, by its name in the package")
    notes: tuple[str, ...] = ()


def read_file(folder: Path, name: str) -> bytes:
    """Return the content of a file of an unpacked package.

    Raises:
        BadInput: the file is missing or cannot be read.
    """
    try:
        require_regular(folder / name)
        return (folder / name).read_bytes()
    except OSError as error:
        raise BadInput(f"{folder} is not complete: {name} cannot be read ({error.strerror}); make it again") from error


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of an unpacked package.

    Raises:
        BadInput: the folder is not a package, or its manifest is broken or of another version.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise BadInput(f"{folder} is not an asset: it has no {MANIFEST}; give a folder that `dg4d make` wrote")
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc'])) or 'JSON'}: {e['msg']}" for e in error.errors()]
        raise BadInput(f"{path} cannot be used: {'; '.join(lines)}") from error
