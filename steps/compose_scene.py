"""Several finished packages as one animated scene; behind `dg4d compose`."""

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
from dg4d_lib.gaussians.placing import joined, placed
from dg4d_lib.rasterizer.interface import choose_rasterizer
from steps.artifacts.packages import ASSET, COMPACT, USD, read_manifest

FILM_SIZE = 384  # pixels of a side
MOST_PICTURES = 300  # of a film; they are kept until it is written
SWING_DEG = 25.0  # how far the camera of the film goes to either side
ELEVATION_DEG = 10.0  # of that camera
FILLED = 0.9  # of the picture, by the ball around the scene
BATCH = 8  # pictures of one rasterizer call, bounds the memory


class Cast:
    """The packages of a scene, each read once."""

    def __init__(self, folders: Sequence[Path], items: Sequence[SceneItem], names: Sequence[str]) -> None:
        """Read the bodies.

        Args:
            folders: of the package of every item.
            items: where and when.
            names: in the scene, each once.

        Raises:
            BadInput: a folder is no package, or its asset cannot stand in a scene.
            BackendUnavailable: an asset is compressed, and the package that unpacks it is missing.
        """
        self.folders = list(folders)
        bodies = {folder: _body(folder) for folder in dict.fromkeys(folders)}
        self.actors = [
            Actor(name, bodies[folder], item) for name, folder, item in zip(names, folders, items, strict=True)
        ]

    def in_a_row(self, spacing: float) -> None:
        """Put them side by side on the ground, whatever positions they have."""
        positions = line_up([actor.glb for actor in self.actors], spacing)
        self.actors = [
            Actor(actor.name, actor.glb, actor.item.model_copy(update={"position": position}))
            for actor, position in zip(self.actors, positions, strict=True)
        ]

    def write_glb(self, path: Path, duration_s: float | None) -> tuple[str, ...]:
        """Write the scene as GLB. Returns notes for the user.

        Raises:
            BadInput: an asset starts after the end.
            OSError: the file could not be written.
        """
        path.write_bytes(compose_glb(self.actors, duration_s))
        return ()

    def write_usdz(self, path: Path, duration_s: float | None) -> tuple[str, ...]:
        """Write the scene as USDZ, in which every asset plays once. Returns notes for the user.

        Raises:
            BadInput: an asset starts after the end, or a package has no USDZ.
            OSError: the file could not be written.
        """
        length = scene_duration(self.actors, duration_s)
        for folder in self.folders:
            if not (folder / USD).is_file():
                raise BadInput(f"{folder} has no {USD}; make it again, or write the scene as .glb")
        compose_usdz(
            path,
            [
                UsdPlacement(
                    actor.name,
                    folder / USD,
                    torch.from_numpy(actor.transform),
                    actor.item.start_s,
                    actor.item.speed,
                )
                for actor, folder in zip(self.actors, self.folders, strict=True)
            ],
        )
        again = [actor.name for actor in self.actors if actor.item.loop and actor.end_s < length]
        return (f"USDZ plays every asset once; these would go on in a GLB: {', '.join(again)}",) if again else ()

    def write_preview(
        self,
        path: Path,
        scene: Scene,
        rasterizer: str = "auto",
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> None:
        """Write a film of the moving Gaussians, before which the camera swings once from side to side.

        Args:
            path: of the file, ending in .mp4.
            scene: gives length and frames per second.
            rasterizer: draws the pictures.
            progress: called with pictures done and their number.

        Raises:
            BadInput: too many pictures, an asset that starts after the end, or a broken package.
            BackendUnavailable: there is no rasterizer or no codec.
            OSError: the file could not be written.
        """
        count = round(scene_duration(self.actors, scene.duration_s) * scene.fps)
        if not 1 <= count <= MOST_PICTURES:
            raise BadInput(
                f"a film has 1 to {MOST_PICTURES} pictures; {count} were asked for: change fps or duration_s"
            )
        draw = choose_rasterizer(rasterizer)
        clouds = {folder: _Cloud(folder) for folder in dict.fromkeys(self.folders)}
        center, radius = self._ball()
        scale = FILLED * RADIUS * math.sin(math.radians(FOV_Y_DEG / 2)) / radius
        upright = torch.tensor((1.0, 0.0, 0.0, 0.0))
        background, pictures = studio_background(FILM_SIZE), []
        for start in range(0, count, BATCH):
            moments = torch.arange(start, min(start + BATCH, count), dtype=torch.float64)
            states = joined(
                [
                    clouds[folder].at(actor, moments / scene.fps)
                    for actor, folder in zip(self.actors, self.folders, strict=True)
                ]
            )
            cameras = [
                OrbitCamera(
                    ELEVATION_DEG,
                    SWING_DEG * math.sin(2 * math.pi * moment / count),
                    width=FILM_SIZE,
                    height=FILM_SIZE,
                )
                for moment in moments.tolist()
            ]
            pictures.append(render_over(background, placed(states, upright, scale, -scale * center), cameras, draw))
            progress(start + len(moments), count)
        write_mp4(path, torch.cat(pictures), scene.fps)

    def _ball(self) -> tuple[Float[Tensor, " 3"], float]:
        """Center and radius of a ball around the boxes of all actors."""
        boxes = []
        for actor in self.actors:
            low, high = (torch.from_numpy(corner) for corner in (actor.glb.box_min, actor.glb.box_max))
            corners = torch.cartesian_prod(*torch.stack((low, high), 1))
            matrix = torch.from_numpy(actor.transform)
            boxes.append(corners @ matrix[:3, :3].mT + matrix[:3, 3])
        points = torch.cat(boxes)
        center = (points.amin(0) + points.amax(0)) / 2
        return center.float(), max(1e-6, float((points - center).norm(dim=1).max()))


class _Cloud:
    """The Gaussians of a package and their motion."""

    def __init__(self, folder: Path) -> None:
        self.fit = read_compact(folder / COMPACT)
        self.fps = self.fit.frames / read_manifest(folder).duration_s  # written frames may be others

    def at(self, actor: Actor, times_s: Float[Tensor, " b"]) -> Gaussians:
        """Its states at times of the scene, where the actor stands."""
        played = torch.from_numpy(actor.animation_times(times_s.numpy()))
        fit, positions = self.fit, (played * self.fps).clamp(max=self.fit.frames)
        states = pose_gaussians(fit.gaussians, fit.deformation, fit.frames, positions)
        quat = torch.from_numpy(actor.rotation.as_quat(canonical=True))[[3, 0, 1, 2]]
        return placed(states, quat, actor.item.scale, torch.from_numpy(actor.origin))


def _body(folder: Path) -> AnimatedGlb:
    try:
        return AnimatedGlb((folder / ASSET).read_bytes())
    except OSError as error:
        raise BadInput(f"{folder} is not complete: {ASSET} cannot be read ({error.strerror}); make it again") from error
    except BadInput as error:
        raise BadInput(f"{folder / ASSET}: {error}") from error
