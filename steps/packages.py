"""What lies where in a package, and the manifest that says so (`asset.json`)."""

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS
from dg4d_lib.errors import BadInput
from steps.contract import Frozen

MANIFEST = "asset.json"
ASSET = "asset.glb"
SPLATS = "splats"
MESHES = "meshes"
GAUSSIANS = "canonical/gaussians.ply"
MOTION = "canonical/motion.safetensors"
SUBJECT = "input/subject.png"
PREVIEW = "preview.mp4"
SHEET = "contact_sheet.png"


class Camera(Frozen):
    """The viewpoint of the input picture, and what the numbers mean."""

    elevation_deg: float = 0.0
    azimuth_deg: float = 0.0
    radius: float = RADIUS
    fov_y_deg: float = FOV_Y_DEG
    convention: str = (
        "right-handed world, y up, the front looks along +z; the camera looks at the origin from `radius` world units; "
        "azimuth 0 is on +z, 90 on +x; positive elevation is above"
    )


class Manifest(Frozen):
    """What a package holds. Frame i is shown at i / fps seconds; after the last frame comes the first again."""

    format: Literal["dg4d-asset"] = "dg4d-asset"
    version: Literal[1] = 1
    generator: str
    mode: Literal["tracked", "per_frame"]
    fps: float = Field(gt=0)
    frames: int = Field(ge=1)
    duration_s: float
    gaussians: int = Field(ge=0)
    vertices: tuple[int, ...] = Field(description="of the tracked mesh, or of every frame's mesh")
    triangles: tuple[int, ...] = Field(description="of the tracked mesh, or of every frame's mesh")
    camera: Camera = Camera()
    files: dict[str, str] = Field(description="what every file is, by its name in the package")
    notes: tuple[str, ...] = ()


def read_manifest(folder: Path) -> Manifest:
    """The manifest of an unpacked package.

    Raises:
        BadInput: the folder is no package, or its manifest is broken or from another version.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise BadInput(f"{folder} is no asset: it has no {MANIFEST}; give a folder that `dg4d make` wrote")
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc'])) or 'JSON'}: {e['msg']}" for e in error.errors()]
        raise BadInput(f"{path} cannot be used: {'; '.join(lines)}") from error
