"""File names in a package, and its manifest `asset.json`."""

from pathlib import Path, PurePosixPath
from typing import Literal

from pydantic import Field, ValidationError

from dg4d_lib.assets.placement import Placement
from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS
from dg4d_lib.errors import BadInput
from steps.contract import Frozen
from steps.store.files import require_regular

MANIFEST = "asset.json"
ASSET = "asset.glb"
MERGED = "asset_merged.glb"
RIGGED = "asset_rigged.glb"
PLAYBACK = "asset_playback.glb"
USD = "asset.usdz"
USD_SPLATS = "asset_splats.usdz"
SPLATS = "splats"
WEB_SPLATS = "splats/moving.websplats"
MESHES = "meshes"
LEVELS = "lod"
GAUSSIANS = "canonical/gaussians.ply"
COMPACT = "canonical/asset4d.safetensors"
SUBJECT = "input/subject.png"
DRIVING = "input/driving.mp4"
PREVIEW = "preview.mp4"
TURNTABLE = "turntable.mp4"
MOVING_PICTURE = "preview.webp"
SHEET = "contact_sheet.png"

WIDEST_FOV_DEG = 179.9  # at 180 degrees, the focal length is 0

ABOUT = {
    ASSET: "animated textured mesh, glTF 2.0",
    MERGED: "the user's model, animated, as one mesh with one texture, glTF 2.0",
    RIGGED: "the same mesh on a skeleton, glTF 2.0",
    PLAYBACK: "the same mesh on a skeleton that follows the motion roughly, glTF 2.0",
    USD: "animated mesh, on a skeleton if one follows the motion, USDZ",
    USD_SPLATS: "moving splats, and as a variant point samples of the mesh, USDZ",
    WEB_SPLATS: "splats of all frames, format of the viewer",
    GAUSSIANS: "Gaussians in the canonical pose, 3DGS PLY",
    COMPACT: "Gaussians and their deformation over time, safetensors",
    SUBJECT: "input picture, cut out",
    DRIVING: "driving video, MP4",
    PREVIEW: "preview of the animation with an orbiting camera, MP4",
    TURNTABLE: "first frame on a turntable, MP4",
    MOVING_PICTURE: "preview of the animation, animated WebP",
    SHEET: "contact sheet: columns are frames, rows are azimuths",
}
ABOUT_FOLDERS = {
    (SPLATS, ".ply"): "Gaussians of one frame, 3DGS PLY in OpenCV axes (y down)",
    (SPLATS, ".spz"): "Gaussians of one frame, SPZ (y up)",
    (SPLATS, ".glb"): "Gaussians of one frame, glTF with KHR_gaussian_splatting",
    (MESHES, ".glb"): "textured mesh of one frame, glTF 2.0",
    (LEVELS, ".glb"): "the animated mesh with fewer triangles, glTF 2.0",
}


class PackagePlacement(Frozen):
    """Map from the coordinates of canonical/ to those of all other files: x to `scale` * x + `translation`."""

    scale: float = Field(1.0, gt=0)
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def placement(self) -> Placement:
        """The same as the library's class."""
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


def about(name: str) -> str:
    """Return one line on a file of a package, by its name there."""
    path = PurePosixPath(name)
    return ABOUT.get(name) or ABOUT_FOLDERS[path.parts[0], path.suffix]


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
