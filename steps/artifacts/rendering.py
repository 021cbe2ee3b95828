"""Rendering of finished packages from any camera at any time, for `dg4d render` and the metrics."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D, interpolate_frames, pose_gaussians, states_between
from dg4d_lib.assets.formats.compact import read_compact
from dg4d_lib.assets.formats.glb import read_glb, read_mesh_glb
from dg4d_lib.assets.formats.splats import read_splats
from dg4d_lib.assets.placement import Surface
from dg4d_lib.cameras.orbit import FOV_Y_DEG, OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from steps.artifacts.media import write_png
from steps.artifacts.package_files import ASSET, COMPACT, MANIFEST, MERGED, MESHES, SPLATS
from steps.artifacts.packages import Manifest, read_file, read_manifest

BATCH = 8  # pictures per rasterizer call, bounds the memory
SMALLEST, LARGEST = 16, 4096  # pixels of a side
FRAME_FILE = re.compile(r"([0-9]{3}|[1-9][0-9]{3,8})\.png")  # names of `_file_name`
OPAQUE = 0.5  # alpha above which a pixel on the edge of a picture counts as cut off

States = Callable[[Float[Tensor, " b"]], Gaussians]  # Gaussians at positions of the animation, in frames
Renderer = Callable[[Float[Tensor, " b"], Sequence[OrbitCamera]], Float[Tensor, "b h w 4"]]


class Renders(NamedTuple):
    """Written pictures of a package.

    Attributes:
        views: folders, one per azimuth.
        cropped: number of pictures in which the asset touches the edge.
    """

    views: list[Path]
    cropped: int


def render_package(
    folder: Path,
    azimuths_deg: Sequence[float],
    elevation_deg: float,
    size: int,
    frames: int | None,
    mesh: bool,
    out: Path,
    rasterizer: str = "auto",
    fit: bool = False,
    end: float = 1.0,
) -> Renders:
    """Write OUT/view_<azimuth>/NNN.png, RGBA with straight alpha, for every azimuth and frame.

    Args:
        folder: unpacked package.
        azimuths_deg: azimuths of the cameras.
        elevation_deg: elevation of the cameras, -90 to 90.
        size: pixels of a side, 16 to 4096.
        frames: number of pictures, evenly spaced from the first to the last frame of the fit; None: one per frame.
        mesh: render the textured mesh instead of the splats.
        out: folder, made if necessary; pictures of the same name are replaced.
        rasterizer: name of the rasterizer for splats.
        fit: take the field of view that holds the whole asset from all sides (`whole_fov_y_deg` of the manifest)
            instead of that of the input picture.
        end: share of `frames`, above 0, after which pictures show the last frame of the fit; see `fitted_positions`.

    Raises:
        BadInput: the folder is not a package, a broken one, or too old for `fit`, a number is out of range, or a view
            holds pictures of more frames.
        BackendUnavailable: the rasterizer cannot run here.
        OSError: a picture could not be written.
    """
    manifest = read_manifest(folder)
    _check(azimuths_deg, elevation_deg, size, frames)
    if mesh:
        draw = mesh_renderer(read_surface(folder, manifest))
    else:
        draw = splat_renderer(read_states(folder, manifest), get_rasterizer(rasterizer))
    every = torch.arange(manifest.frames, dtype=torch.float64)
    positions = every if frames is None else fitted_positions(frames, folder, manifest, end)
    fov_y_deg = _whole_fov_y_deg(folder, manifest) if fit else FOV_Y_DEG
    count, cropped = len(positions), 0
    views = [out / f"view_{azimuth_deg + 0.0:g}" for azimuth_deg in azimuths_deg]
    for view in views:
        _check_no_later(count, view)
    for view, azimuth_deg in zip(views, azimuths_deg, strict=True):
        view.mkdir(parents=True, exist_ok=True)
        camera = OrbitCamera(elevation_deg, azimuth_deg, fov_y_deg=fov_y_deg, width=size, height=size)
        for start in range(0, count, BATCH):
            part = positions[start : start + BATCH]
            for frame, picture in enumerate(draw(part, [camera] * len(part)), start):
                write_png(view / _file_name(frame), picture)
                cropped += _touches_edge(picture)
    return Renders(views, cropped)


def _file_name(frame: int) -> str:
    return f"{frame:03d}.png"


def _check_no_later(count: int, view: Path) -> None:
    """Refuse a view that holds pictures of more frames: they would be mixed with the new ones."""
    numbered = (FRAME_FILE.fullmatch(path.name) for path in view.iterdir()) if view.is_dir() else ()
    later = sum(1 for frame in numbered if frame and int(frame[1]) >= count)
    if later:
        raise BadInput(
            f"{view} holds {later} picture{'s' * (later != 1)} beyond the {count} of this render; choose another "
            "folder, or remove them"
        )


def _whole_fov_y_deg(folder: Path, manifest: Manifest) -> float:
    if manifest.camera.whole_fov_y_deg is None:
        raise BadInput(
            f"{folder} cannot be fitted into pictures: an older dg4d made it, so its {MANIFEST} has no "
            "camera.whole_fov_y_deg; make it again, or render without --fit"
        )
    return manifest.camera.whole_fov_y_deg


def _touches_edge(picture: Float[Tensor, "h w 4"]) -> bool:
    alpha = picture[..., 3]
    return any(bool((edge > OPAQUE).any()) for edge in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]))


def fitted_positions(count: int, folder: Path, manifest: Manifest, end: float = 1.0) -> Float[Tensor, " n"]:
    """Return evenly spaced positions from the first to the last frame of the fit, in frames of the package.

    The last frames of a package with another frame rate than the fit (`pack.fps`) lead back to the first.

    Args:
        count: number of positions.
        folder: unpacked package.
        manifest: of the package.
        end: share of the time from the first to the last position, above 0, after which the last frame is repeated.
    """
    fitted = read_compact(folder / COMPACT).frames if (folder / COMPACT).is_file() else manifest.frames
    last = (fitted - 1) * manifest.frames / fitted
    span = max(1, count - 1) * end
    return torch.arange(count, dtype=torch.float64).clamp(max=span) * last / span


def read_states(folder: Path, manifest: Manifest) -> States:
    """Return the stored Gaussians of all frames, or those of the fitted motion if a package has no splats.

    They are in the coordinates of the fit, which the cameras orbit.

    Raises:
        BadInput: files are missing or broken, or have another number of frames than the package.
    """
    if any((folder / SPLATS).glob("*.ply")):
        stored = read_splats(folder / SPLATS, y_down=manifest.ply_axes == "y_down")
        _check_frames(SPLATS, len(stored.means), manifest)
        return partial(states_between, manifest.placement.placement.inverse.gaussians(stored))
    fit = read_compact(folder / COMPACT)
    return lambda positions: pose_gaussians(
        fit.gaussians, fit.deformation, fit.frames, positions * fit.frames / manifest.frames
    )


def read_surface(folder: Path, manifest: Manifest) -> Surface:
    """Read the tracked mesh, or the mesh of every frame, of an unpacked package, in the coordinates of the fit.

    Raises:
        BadInput: files are missing or broken, or have another number of frames than the package.
    """
    to_fit = manifest.placement.placement.inverse
    if manifest.mode == "per_frame":
        meshes = [read_mesh_glb(read_file(folder, f"{MESHES}/{i:03d}.glb")) for i in range(manifest.frames)]
        return to_fit.surface(meshes)
    asset = read_glb(read_file(folder, MERGED if manifest.mode == "own" else ASSET))
    _check_frames(ASSET, len(asset.offsets), manifest)
    return to_fit.surface(asset)


def mesh_renderer(surface: Surface) -> Renderer:
    """Return a function that renders meshes as players do: linear between frames, or each frame's mesh until the next.

    The function takes positions in frames and a camera for each.
    """
    if isinstance(surface, Asset4D) and surface.textures is None:
        return lambda positions, cameras: torch.cat(
            render_mesh(surface.mesh, cameras, interpolate_frames(surface.offsets, positions)), -1
        )

    def draw(positions: Float[Tensor, " b"], cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b h w 4"]:
        pairs = zip(positions, cameras, strict=True)
        return torch.cat([torch.cat(render_mesh(mesh_at(surface, at), [camera]), -1) for at, camera in pairs])

    return draw


def mesh_at(surface: Surface, position: Float[Tensor, ""]) -> TexturedMesh:
    """Return the mesh at a position of the animation, with the texture of its frame if textures change."""
    frame = int(position)
    if not isinstance(surface, Asset4D):
        return surface[frame]
    texture = surface.mesh.texture if surface.textures is None else surface.textures[frame % len(surface.textures)]
    return replace(
        surface.mesh,
        vertices=surface.mesh.vertices + interpolate_frames(surface.offsets, position[None])[0],
        texture=texture,
    )


def _check(azimuths_deg: Sequence[float], elevation_deg: float, size: int, frames: int | None) -> None:
    if not azimuths_deg or not all(map(math.isfinite, azimuths_deg)):
        raise BadInput(f"azimuths must be one or more angles in degrees, for example 0,-75,15; given {azimuths_deg}")
    if not -90 <= elevation_deg <= 90:
        raise BadInput(f"the elevation must lie between -90 and 90 degrees; given {elevation_deg}")
    if not SMALLEST <= size <= LARGEST:
        raise BadInput(f"the size must lie between {SMALLEST} and {LARGEST} pixels; given {size}")
    if frames is not None and frames < 1:
        raise BadInput(f"there must be at least one frame to render; given {frames}")


def splat_renderer(states: States, rasterizer: Rasterizer) -> Renderer:
    """Return a function that renders Gaussians at positions in frames, with a camera for each, as RGBA."""

    def draw(positions: Float[Tensor, " b"], cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b h w 4"]:
        with torch.no_grad():
            rendering = rasterizer(states(positions), cameras, torch.zeros(3))
        straight = rendering.color / rendering.alpha.clamp_min(torch.finfo(rendering.alpha.dtype).tiny)
        return torch.cat([straight, rendering.alpha], -1).clamp(0, 1)

    return draw


def _check_frames(name: str, given: int, manifest: Manifest) -> None:
    if given != manifest.frames:
        raise BadInput(f"{name} has {given} frames, the package {manifest.frames}; make it again")
