"""Composition of finished packages into one animated scene, for `dg4d compose`."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.assets.animated import pose_gaussians
from dg4d_lib.assets.formats.compact import read_compact
from dg4d_lib.assets.formats.usd import UsdPlacement, compose_usdz
from dg4d_lib.assets.rendering.preview import render_over, studio_background, write_mp4
from dg4d_lib.assets.scenes.compose import Actor, AnimatedGlb, compose_glb, line_up, scene_duration
from dg4d_lib.assets.scenes.scene import Scene, SceneItem
from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS, OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.transform import concatenate, transform
from dg4d_lib.rasterizer.interface import get_rasterizer
from steps.artifacts.package_files import ASSET, COMPACT, MERGED, USD
from steps.artifacts.packages import read_file, read_manifest
from steps.artifacts.rendering import fitted_positions

PREVIEW_SIZE = 384  # side of the preview video, pixels
MOST_PICTURES = 300  # of a preview video; all are in memory until it is written
SWING_DEG = 25.0  # amplitude of the camera's azimuth
ELEVATION_DEG = 10.0  # of the camera
FILLED = 0.9  # part of the picture that the scene's bounding sphere fills
BATCH = 8  # pictures per rasterizer call, bounds the memory
IDENTITY_QUAT = torch.tensor((1.0, 0.0, 0.0, 0.0))  # wxyz


class SceneWriter:
    """Writer of a scene, which reads each package once.

    Args:
        folders: package folder of every item.
        items: position, time and speed of every item.
        names: unique names in the scene.

    Raises:
        BadInput: a folder is not a package, or its asset cannot be placed in a scene.
        BackendUnavailable: an asset is compressed, and the library that decodes it is not installed.
    """

    def __init__(self, folders: Sequence[Path], items: Sequence[SceneItem], names: Sequence[str]) -> None:
        self.folders = list(folders)
        glbs = {folder: _read_glb(folder) for folder in dict.fromkeys(folders)}
        self.actors = [
            Actor(name, glbs[folder], item) for name, folder, item in zip(names, folders, items, strict=True)
        ]

    def in_a_row(self, spacing: float) -> None:
        """Place the items side by side on the ground, instead of at their own positions."""
        positions = line_up([actor.glb for actor in self.actors], spacing)
        self.actors = [
            Actor(actor.name, actor.glb, actor.item.model_copy(update={"position": position}))
            for actor, position in zip(self.actors, positions, strict=True)
        ]

    def write_glb(self, path: Path, duration_s: float | None) -> tuple[str, ...]:
        """Write the scene as GLB and return notes for the user, here none.

        Raises:
            BadInput: an asset starts after the end.
            OSError: the file could not be written.
        """
        path.write_bytes(compose_glb(self.actors, duration_s))
        return ()

    def write_usdz(self, path: Path, duration_s: float | None) -> tuple[str, ...]:
        """Write the scene as USDZ, in which every asset plays once, and return notes for the user.

        Raises:
            BadInput: an asset starts after the end, or a package has no USDZ.
            OSError: the file could not be written.
        """
        length = scene_duration(self.actors, duration_s)
        placements = []
        for actor, folder in zip(self.actors, self.folders, strict=True):
            if not (folder / USD).is_file():
                raise BadInput(f"{folder} has no {USD}; make it again, or write the scene as .glb")
            transform, item = torch.from_numpy(actor.transform), actor.item
            hold_s = None if item.loop else actor.glb.last_pose_s
            placements.append(UsdPlacement(actor.name, folder / USD, transform, item.start_s, item.speed, hold_s))
        compose_usdz(path, placements, length)
        again = [actor.name for actor in self.actors if actor.item.loop and actor.end_s < length]
        return (
            (f"USDZ cannot loop: these assets play once here, but loop in a GLB: {', '.join(again)}",) if again else ()
        )

    def write_preview(
        self,
        path: Path,
        scene: Scene,
        rasterizer: str = "auto",
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        """Write a video of the moving Gaussians, from a camera that swings once from side to side.

        Args:
            path: file, ending in .mp4.
            scene: scene with duration and frame rate.
            rasterizer: name of the rasterizer.
            progress: callback (pictures done, total).

        Raises:
            BadInput: there are too many pictures, an asset starts after the end, or a package is broken.
            BackendUnavailable: there is no rasterizer or no codec.
            OSError: the file could not be written.
        """
        count = round(scene_duration(self.actors, scene.duration_s) * scene.fps)
        if not 1 <= count <= MOST_PICTURES:
            raise BadInput(
                f"a preview video has 1 to {MOST_PICTURES} frames, this scene would need {count}: change fps or "
                "duration_s"
            )
        draw = get_rasterizer(rasterizer)
        clouds = {folder: _MovingGaussians(folder) for folder in dict.fromkeys(self.folders)}
        center, radius = self._bounding_sphere()
        scale = FILLED * RADIUS * math.sin(math.radians(FOV_Y_DEG / 2)) / radius
        background, pictures = studio_background(PREVIEW_SIZE), []
        for start in range(0, count, BATCH):
            frames = torch.arange(start, min(start + BATCH, count), dtype=torch.float64)
            pairs = zip(self.actors, self.folders, strict=True)
            states = concatenate([clouds[folder].at(actor, frames / scene.fps) for actor, folder in pairs])
            azimuths = [SWING_DEG * math.sin(2 * math.pi * frame / count) for frame in frames.tolist()]
            cameras = [OrbitCamera(ELEVATION_DEG, each, width=PREVIEW_SIZE, height=PREVIEW_SIZE) for each in azimuths]
            centered = transform(states, IDENTITY_QUAT, scale, -scale * center)
            pictures.append(render_over(background, centered, cameras, draw))
            progress(start + len(frames), count)
        write_mp4(path, torch.cat(pictures), scene.fps)

    def _bounding_sphere(self) -> tuple[Float[Tensor, " 3"], float]:
        """Return center and radius of a sphere around the bounding boxes of all actors."""
        boxes = []
        for actor in self.actors:
            low, high = (torch.from_numpy(corner) for corner in (actor.glb.box_min, actor.glb.box_max))
            corners = torch.cartesian_prod(*torch.stack((low, high), 1))
            matrix = torch.from_numpy(actor.transform)
            boxes.append(corners @ matrix[:3, :3].mT + matrix[:3, 3])
        points = torch.cat(boxes)
        center = (points.amin(0) + points.amax(0)) / 2
        return center.float(), max(1e-6, float((points - center).norm(dim=1).max()))


class _MovingGaussians:
    """Gaussians of a package and their motion."""

    def __init__(self, folder: Path) -> None:
        self.fit = read_compact(folder / COMPACT)
        manifest = read_manifest(folder)
        self.fps = self.fit.frames / manifest.duration_s  # frames of the fit, not of the files
        self.placement = manifest.placement.placement

    def at(self, actor: Actor, times_s: Float[Tensor, " b"]) -> Gaussians:
        """Return the states at times of the scene, at the actor's place."""
        played = torch.from_numpy(actor.animation_times(times_s.numpy()))
        fit, positions = self.fit, (played * self.fps).clamp(max=self.fit.frames)
        states = self.placement.gaussians(pose_gaussians(fit.gaussians, fit.deformation, fit.frames, positions))
        quat = torch.from_numpy(actor.rotation.as_quat(canonical=True))[[3, 0, 1, 2]]
        return transform(states, quat, actor.item.scale, torch.from_numpy(actor.origin))


def _read_glb(folder: Path) -> AnimatedGlb:
    manifest = read_manifest(folder)
    name = MERGED if manifest.mode == "own" else ASSET
    content = read_file(folder, name)
    _, last = fitted_positions(2, folder, manifest).tolist()
    try:
        return AnimatedGlb(content, return_s=(manifest.frames - last) / manifest.fps)
    except BadInput as error:
        raise BadInput(f"{folder / name}: {error}") from error
