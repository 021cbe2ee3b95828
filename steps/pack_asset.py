"""Step that writes all delivery formats of an asset into one package."""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.animated import Asset4D, pose_gaussians
from dg4d_lib.assets.formats.compact import CompactAsset, write_compact
from dg4d_lib.assets.formats.foreign_placement import place_moving_glb
from dg4d_lib.assets.formats.glb import component_notes, write_frames_glb, write_glb, write_mesh_glb
from dg4d_lib.assets.formats.rigged import PRECISE, fit_asset_rig, write_rigged_glb
from dg4d_lib.assets.formats.splats import write_splat_glb_frames, write_splats, write_spz_frames
from dg4d_lib.assets.formats.spz import scale_notes
from dg4d_lib.assets.formats.usd import write_skinned_usdz, write_usdz
from dg4d_lib.assets.formats.web_splats import write_web_splats
from dg4d_lib.assets.placement import Placement, Surface, ground_placement
from dg4d_lib.assets.rendering.preview import shown_points, write_mp4, write_preview, write_turntable
from dg4d_lib.assets.rendering.sheet import draw_contact_sheet
from dg4d_lib.assets.rendering.webp import write_webp
from dg4d_lib.assets.resample import (
    nearest_rate,
    pose_gaussians_in_chunks,
    resample_asset,
    resampled_positions,
)
from dg4d_lib.cameras.viewpoints import whole_fov_y_deg
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import read_ply
from dg4d_lib.mesh.extraction.simplify import simplify_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.delight import delight, remove_shading
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts import package_files
from steps.artifacts.media import read_frames, write_png, write_zip
from steps.artifacts.meshes import read_meshes, read_tracked
from steps.artifacts.motions import read_motion
from steps.artifacts.packages import Camera, Manifest, PackagePlacement
from steps.artifacts.rendering import mesh_at
from steps.profiles import PackNotes
from steps.runtime.job import Job, StepReport

WRITER_THREADS = 2  # each writer uses one core most of the time


@dataclass(frozen=True)
class PackageWriter:
    """Content of a package and its folder; the methods write files and return notes for the report.

    Attributes:
        notes: sentences that are stored in the files.
        placement: from the coordinates of the fit to those of the files.
        surface: tracked mesh, or a mesh per state, placed.
        fit: canonical Gaussians, their deformation, and the frame rate of the driving video.
        states: Gaussians at every written frame, placed.
        fps: frame rate of the written frames.
        inputs: input files by port.
    """

    folder: Path
    pack: PackSettings
    notes: tuple[str, ...]
    placement: Placement
    surface: Surface
    fit: CompactAsset
    video: DrivingVideo
    states: Gaussians
    fps: float
    rasterizer: Rasterizer
    inputs: Mapping[str, Path]

    @property
    def meshes(self) -> list[TexturedMesh]:
        """Mesh of the reference frame, or one per state."""
        return [self.surface.mesh] if isinstance(self.surface, Asset4D) else self.surface

    def path(self, name: str) -> Path:
        """Return the path of a file of the package, in a folder that exists."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def rate_notes(self) -> list[str]:
        """Return a note if the files have another frame rate than the requested one."""
        if self.fps == (self.pack.fps or self.video.fps):
            return []
        if isinstance(self.surface, list):
            reason = "every frame has its own mesh"
        else:
            reason = f"at {'least' if self.fps > self.pack.fps else 'most'} {len(self.states.means)} states"
        return [f"the files have {self.fps:.4g} frames per second instead of {self.pack.fps:g} (pack.fps): {reason}"]

    def write_meshes(self) -> Sequence[str]:
        """Write the animated mesh, and in the mode per_frame also the mesh of every frame."""
        gltf, surface, notes = self.pack.gltf, self.surface, tuple[str, ...]()
        if isinstance(surface, Asset4D):
            name = package_files.ASSET
            if "moving" in self.inputs:
                notes = self._write_model(name)
                name = package_files.MERGED
            content = write_glb(surface, gltf)
            self.path(name).write_bytes(content)
            return notes + component_notes(name, content, self.placement.scale)
        self.path(package_files.ASSET).write_bytes(write_frames_glb(surface, self.fps, _extras(self.notes), gltf))
        for frame, mesh in enumerate(surface):
            self.path(f"{package_files.MESHES}/{frame:03d}.glb").write_bytes(write_mesh_glb(mesh, gltf))
        return ()

    def _write_model(self, name: str) -> tuple[str, ...]:
        """Write the user's model in motion, placed; it keeps its keys and lasts as long as the other files."""
        slowdown = len(self.states.means) / self.fps / (len(self.video) / self.video.fps)
        content = place_moving_glb(self.inputs["moving"].read_bytes(), self.placement, slowdown)
        self.path(name).write_bytes(content)
        if self.fps == self.video.fps:
            return ()
        return (f"{name} keeps the keys of the driving video, {self.video.fps:.4g} per second, not {self.fps:.4g}",)

    def write_levels(self) -> Sequence[str]:
        """Write the tracked mesh with fewer triangles."""
        surface, notes = self.surface, []
        if not isinstance(surface, Asset4D):
            return ()
        for level, share in enumerate(self.pack.lods, 1):
            mesh, offsets = simplify_mesh(surface.mesh, surface.offsets, max(1, round(share * len(surface.mesh.faces))))
            name = f"{package_files.LEVELS}/{level}.glb"
            self.path(name).write_bytes(write_glb(replace(surface, mesh=mesh, offsets=offsets), self.pack.gltf))
            notes.append(f"{name} has {len(mesh.faces)} of {len(surface.mesh.faces)} triangles")
        return notes

    def write_rig(self) -> Sequence[str]:
        """Write the tracked mesh with a skeleton, if one reproduces its motion; without, the USDZ has point samples."""
        pack, surface, rig, notes = self.pack, self.surface, None, tuple[str, ...]()
        about = _extras(self.notes)
        if pack.rig and isinstance(surface, Asset4D):
            rig, note = fit_asset_rig(surface, pack.rig_bones, pack.rig_error, self.placement.scale)
            notes = (note,)
        if isinstance(surface, Asset4D) and rig is not None:
            precise = rig.rms <= PRECISE * self.placement.scale
            path = self.path(package_files.RIGGED if precise else package_files.PLAYBACK)
            path.write_bytes(write_rigged_glb(surface, rig, pack.gltf))
            if not precise:
                notes = (f"{note}; it is for playback only, in {path.name}, and asset.glb is exact",)
            if pack.usd:
                write_skinned_usdz(self.path(package_files.USD), surface, rig, about, pack.gltf)
        elif pack.usd:
            write_usdz(self.path(package_files.USD), surface, self.fps, None, about, pack.gltf)
        return notes

    def write_usd_splats(self) -> None:
        """Write point samples of the mesh, and the splats, as one USDZ."""
        if self.pack.usd:
            path, about = self.path(package_files.USD_SPLATS), _extras(self.notes)
            write_usdz(path, self.surface, self.fps, self.states, about, self.pack.gltf, open_pbr=True, half=True)

    def write_splats(self) -> Sequence[str]:
        """Write the Gaussians of every frame in the requested formats, and for the viewer."""
        pack, states = self.pack, self.states
        self.path(package_files.WEB_SPLATS).write_bytes(write_web_splats(states, self.fps))
        folder = self.path(package_files.WEB_SPLATS).parent
        if pack.splats:
            write_splats(folder, states)
        if pack.spz:
            write_spz_frames(folder, states, pack.spz_version)
        if pack.splat_gltf != "none":
            write_splat_glb_frames(folder, states, pack.splat_gltf)
        return scale_notes(states) if pack.spz else ()

    def write_canonical(self) -> None:
        """Write the fit, the subject and the driving video, from which everything else was made."""
        for name, port in ((package_files.GAUSSIANS, "gaussians"), (package_files.SUBJECT, "subject")):
            shutil.copyfile(self.inputs[port], self.path(name))
        write_compact(self.path(package_files.COMPACT), self.fit)
        even = self.video.frames.shape[1] // 2 * 2  # pixels; some players cannot show videos of odd sizes
        write_mp4(self.path(package_files.DRIVING), self.video.over(torch.ones(3))[:, :even, :even], self.video.fps)

    def write_preview(self) -> Sequence[str]:
        """Write the video of the motion, as splats and as a lit mesh, with an orbiting camera."""
        return write_preview(self.path(package_files.PREVIEW), *self._motion, self.points, self._mesh_at_frame)

    def write_moving_picture(self) -> None:
        """Write the same as a small animated WebP for web pages."""
        write_webp(self.path(package_files.MOVING_PICTURE), *self._motion, self.points)

    @cached_property
    def points(self) -> Float[Tensor, "t p 3"]:
        """Points that the pictures of the motion hold, as they were fitted."""
        return shown_points(self.fit.gaussians, self.fit.deformation, self.fit.frames)

    @property
    def _motion(self) -> tuple[Gaussians, Deformation, int, float, Rasterizer, PackSettings]:
        fit = self.fit
        return fit.gaussians, fit.deformation, fit.frames, fit.fps, self.rasterizer, self.pack

    def write_turntable(self) -> Sequence[str]:
        """Write the video of the first frame on a turntable."""
        fit = self.fit
        first = pose_gaussians(fit.gaussians, fit.deformation, fit.frames, torch.zeros(1)).at(0)
        return write_turntable(self.path(package_files.TURNTABLE), first, self.rasterizer, self.pack)

    def write_sheet(self) -> None:
        """Write the contact sheet."""
        fit = self.fit
        sheet = draw_contact_sheet(
            fit.gaussians, fit.deformation, self.video, self.rasterizer, self.pack, self.points, self._mesh_at_frame
        )
        write_png(self.path(package_files.SHEET), sheet)

    @cached_property
    def _fitted_surface(self) -> Surface:
        """Surface as it was fitted."""
        return self.placement.inverse.surface(self.surface)

    def _mesh_at_frame(self, frame: float) -> TexturedMesh:
        """Return the mesh, as it was fitted, at a frame of the driving video, which may have another rate."""
        surface = self._fitted_surface
        frames = len(surface.offsets) if isinstance(surface, Asset4D) else len(surface)
        return mesh_at(surface, torch.tensor(frame * frames / len(self.video), dtype=torch.float64))


def run(job: Job) -> StepReport:
    """Write the package and the contact sheet.

    Raises:
        BadInput: the inputs have different numbers of frames, or neither or both kinds of mesh.
        BackendUnavailable: a setting needs a library that is not installed.
    """
    with TemporaryDirectory() as scratch:
        package = _read_inputs(job, Path(scratch))
        notes = package.rate_notes()
        writers: tuple[Callable[[], Sequence[str] | None], ...] = (  # the slowest first
            package.write_preview,
            package.write_rig,
            package.write_moving_picture,
            package.write_usd_splats,
            package.write_meshes,
            package.write_turntable,
            package.write_levels,
            package.write_sheet,
            package.write_splats,
            package.write_canonical,
        )
        with ThreadPoolExecutor(WRITER_THREADS) as threads:
            for done, written in enumerate([threads.submit(write) for write in writers], 1):
                notes += written.result() or ()
                job.progress(done, len(writers), {})
        shutil.copyfile(package.folder / package_files.SHEET, job.outputs["sheet"])
        names = sorted(path.relative_to(package.folder).as_posix() for path in package.folder.rglob("*.*"))
        frames = len(package.states.means)
        manifest = Manifest(
            generator=_generator(),
            mode=_mode(job, package.surface),
            fps=package.fps,
            frames=frames,
            duration_s=frames / package.fps,
            gaussians=len(package.fit.gaussians),
            vertices=tuple(len(mesh.vertices) for mesh in package.meshes),
            triangles=tuple(len(mesh.faces) for mesh in package.meshes),
            placement=PackagePlacement(scale=package.placement.scale, translation=package.placement.translation),
            camera=Camera.placed(package.placement, whole_fov_y_deg(package.points)),
            ply_axes="y_down",
            files={name: package_files.about(name) for name in names},
            notes=(*package.notes, *notes),
        )
        text = json.dumps(manifest.model_dump(mode="json"), indent=2, ensure_ascii=False) + "\n"
        files = [(name, (package.folder / name).read_bytes()) for name in names]
        write_zip(job.outputs["package"], [(package_files.MANIFEST, text.encode()), *files])
    return StepReport(backend=f"{job.settings.rasterizer} rasterizer", notes=tuple(notes))


def _mode(job: Job, surface: Surface) -> Literal["own", "tracked", "per_frame"]:
    if "moving" in job.inputs:
        return "own"
    return "tracked" if isinstance(surface, Asset4D) else "per_frame"


def _read_inputs(job: Job, scratch: Path) -> PackageWriter:
    """Read the inputs and resample them to the requested frame rate."""
    pack: PackSettings = job.settings.pack
    about: PackNotes = job.settings
    gaussians = read_ply(job.inputs["gaussians"])
    deformation, frames, settings = read_motion(job.inputs["motion"])
    video = read_frames(job.inputs["driving_video"], scratch)
    surface = _surface(job, video.fps, about.notes)
    mesh_frames = len(surface.offsets) if isinstance(surface, Asset4D) else len(surface)
    _check_frames(len(video), {"motion": frames, "mesh": mesh_frames})
    fps = video.fps
    if isinstance(surface, Asset4D):
        fps = nearest_rate(frames, fps, pack.fps or fps)
        surface = resample_asset(surface, gaussians, deformation, frames, fps)
    if pack.delight and "moving" not in job.inputs:  # a user's model keeps its textures
        surface = _delit(surface)
    placement = ground_placement(surface, pack.height_m, pack.ground)
    states = pose_gaussians_in_chunks(gaussians, deformation, frames, resampled_positions(frames, video.fps, fps))
    return PackageWriter(
        folder=scratch / "package",
        pack=pack,
        notes=about.notes,
        placement=placement,
        surface=placement.surface(surface),
        fit=CompactAsset(gaussians, deformation, settings, frames, video.fps),
        video=video,
        states=placement.gaussians(states),
        fps=fps,
        rasterizer=get_rasterizer(job.settings.rasterizer),
        inputs=job.inputs,
    )


def _surface(job: Job, fps: float, notes: Sequence[str]) -> Surface:
    """Read the tracked mesh, which gets the frame rate of the driving video, or a mesh per frame."""
    given = [port for port in ("tracked", "meshes") if port in job.inputs]
    match given:
        case ["tracked"]:
            tracked = read_tracked(job.inputs["tracked"])
            textures, frame = tracked.textures, tracked.reference_frame
            return Asset4D(
                tracked.mesh, tracked.offsets, fps, extras=_extras(notes), textures=textures, reference_frame=frame
            )
        case ["meshes"]:
            return read_meshes(job.inputs["meshes"])
    raise BadInput(f"a package needs one kind of mesh, `tracked` or `meshes`; given {given or 'neither'}")


def _delit(surface: Surface) -> Surface:
    """Return the meshes without the shading in their textures."""
    if not isinstance(surface, Asset4D):
        return [delight(mesh) for mesh in surface]
    textures = surface.textures
    if textures is not None:
        textures = torch.stack([remove_shading(texture, surface.mesh) for texture in textures])
    return replace(surface, mesh=delight(surface.mesh), textures=textures)


def _check_frames(expected: int, given: dict[str, int]) -> None:
    wrong = [f"{name} {count}" for name, count in given.items() if count != expected]
    if wrong:
        raise BadInput(f"the driving video has {expected} frames, but: {', '.join(wrong)}; run the earlier steps again")


def _extras(notes: Sequence[str]) -> dict[str, Any]:
    """Return the metadata of meshes and scenes."""
    return {"generator": _generator(), "notes": list(notes)}


def _generator() -> str:
    return f"dg4d {version('dg4d')}"
