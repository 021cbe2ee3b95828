"""Everything that leaves the house, in one package."""

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from dg4d_lib.asset_settings import PackSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.formats.compact import Compact, write_compact
from dg4d_lib.assets.formats.glb import write_frames_glb, write_glb, write_mesh_glb
from dg4d_lib.assets.formats.rigged import rig_of, write_rigged_glb
from dg4d_lib.assets.formats.splats import write_splat_glb_frames, write_splats, write_spz_frames
from dg4d_lib.assets.formats.usd import write_usdz
from dg4d_lib.assets.formats.websplats import write_web_splats
from dg4d_lib.assets.rendering.preview import write_film, write_preview, write_turntable
from dg4d_lib.assets.rendering.sheet import contact_sheet
from dg4d_lib.assets.rendering.webp import write_webp
from dg4d_lib.assets.resample import moments, resampled, states
from dg4d_lib.deformation.factory import AnyDeformation
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import read_ply
from dg4d_lib.mesh.extraction.simplify import simplified
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.interface import Rasterizer, choose_rasterizer
from dg4d_lib.settings import DeformationSettings
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts import packages
from steps.artifacts.media import read_frames, write_png, write_zip
from steps.artifacts.meshes import read_meshes, read_tracked
from steps.artifacts.motions import read_fit
from steps.artifacts.packages import MANIFEST, Manifest
from steps.profiles import PackNotes
from steps.runtime.job import Job, StepReport

Surface = Asset4D | list[TexturedMesh]
Notes = Sequence[str]

WRITER_THREADS = 2  # writers at a time: each takes one core most of the time


@dataclass(frozen=True)
class Contents:
    """What is written, and where; its methods write, and give notes for the report.

    Attributes:
        folder: of the package.
        pack: settings of the package.
        notes: sentences that travel in the files.
        surface: the tracked mesh, or a mesh per state.
        gaussians: at rest.
        deformation: their motion.
        fitted: the settings of the deformation.
        video: what the motion was fitted to.
        states: the cloud at every moment that is written.
        fps: how many of these a second has.
        rasterizer: draws the films.
        inputs: the files that go in unchanged, by port.
    """

    folder: Path
    pack: PackSettings
    notes: tuple[str, ...]
    surface: Surface
    gaussians: Gaussians
    deformation: AnyDeformation
    fitted: DeformationSettings
    video: DrivingVideo
    states: Gaussians
    fps: float
    rasterizer: Rasterizer
    inputs: dict[str, Path]

    @property
    def meshes(self) -> list[TexturedMesh]:
        """The mesh at rest, or one per state."""
        return [self.surface.mesh] if isinstance(self.surface, Asset4D) else self.surface

    @property
    def extras(self) -> dict[str, Any]:
        """What the files say about themselves."""
        return {"generator": _generator(), "notes": list(self.notes)}

    def place(self, name: str) -> Path:
        """Where a file of the package goes; its folder is made."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def write_meshes(self) -> Notes:
        """The animated mesh, and in the mode per_frame every frame's mesh beside it."""
        gltf, surface = self.pack.gltf, self.surface
        if isinstance(surface, Asset4D):
            named = replace(surface, extras={**surface.extras, **self.extras})
            self.place(packages.ASSET).write_bytes(write_glb(named, gltf))
            return ()
        self.place(packages.ASSET).write_bytes(write_frames_glb(surface, self.fps, self.extras, gltf))
        for frame, mesh in enumerate(surface):
            self.place(f"{packages.MESHES}/{frame:03d}.glb").write_bytes(write_mesh_glb(mesh, gltf))
        return ()

    def write_levels(self) -> Notes:
        """The tracked mesh with fewer triangles."""
        surface, notes = self.surface, []
        if not isinstance(surface, Asset4D):
            return ()
        for level, share in enumerate(self.pack.lods, 1):
            mesh, offsets = simplified(surface.mesh, surface.offsets, max(1, round(share * len(surface.mesh.faces))))
            name = f"{packages.LEVELS}/{level}.glb"
            less = replace(surface, mesh=mesh, offsets=offsets, extras={**surface.extras, **self.extras})
            self.place(name).write_bytes(write_glb(less, self.pack.gltf))
            notes.append(f"{name} has {len(mesh.faces)} of {len(surface.mesh.faces)} triangles")
        return notes

    def write_rig(self) -> Notes:
        """The tracked mesh on a skeleton, where one follows it."""
        pack, surface = self.pack, self.surface
        if not pack.rig or not isinstance(surface, Asset4D):
            return ()
        rig, note = rig_of(surface, pack.rig_bones, pack.rig_error)
        if rig is not None:
            named = replace(surface, extras={**surface.extras, **self.extras})
            self.place(packages.RIGGED).write_bytes(write_rigged_glb(named, rig, pack.gltf))
        return (note,)

    def write_usd(self) -> Notes:
        """Mesh and splats in one USDZ."""
        if self.pack.usd:
            path = self.place(packages.USD)
            write_usdz(path, self.surface, self.fps, self.states, self.extras, self.pack.gltf)
        return ()

    def write_splats(self) -> Notes:
        """The cloud at every moment, in the formats that are asked for, and what plays in a browser."""
        pack, states = self.pack, self.states
        self.place(packages.WEB_SPLATS).write_bytes(write_web_splats(states, self.fps))
        folder = self.place(packages.WEB_SPLATS).parent
        if pack.splats:
            write_splats(folder, states)
        if pack.spz:
            write_spz_frames(folder, states)
        if pack.splat_gltf != "none":
            write_splat_glb_frames(folder, states, pack.splat_gltf)
        return ()

    def write_canonical(self) -> Notes:
        """What everything else was made from."""
        for name, port in ((packages.GAUSSIANS, "gaussians"), (packages.SUBJECT, "subject")):
            self.place(name).write_bytes(self.inputs[port].read_bytes())
        video = self.video
        exact = Compact(self.gaussians, self.deformation, self.fitted, len(video), video.fps)
        write_compact(self.place(packages.COMPACT), exact)
        even = video.frames.shape[1] // 2 * 2  # pixels; films of odd sizes do not play everywhere
        write_film(self.place(packages.DRIVING), video.over(torch.ones(3))[:, :even, :even], video.fps)
        return ()

    def write_preview(self) -> Notes:
        """The film in which it moves while the camera goes round."""
        return write_preview(self.place(packages.PREVIEW), *self._moving)

    def write_moving_picture(self) -> Notes:
        """The small one, for pages."""
        write_webp(self.place(packages.MOVING_PICTURE), *self._moving)
        return ()

    @property
    def _moving(self) -> tuple[Gaussians, AnyDeformation, int, float, Rasterizer, PackSettings]:
        video = self.video
        return self.gaussians, self.deformation, len(video), video.fps, self.rasterizer, self.pack

    def write_turntable(self) -> Notes:
        """The film in which it holds still and is turned."""
        return write_turntable(self.place(packages.TURNTABLE), self.states.at(0), self.rasterizer, self.pack)

    def write_sheet(self) -> Notes:
        """The contact sheet."""
        sheet = contact_sheet(self.gaussians, self.deformation, self.video, self.rasterizer, self.pack)
        write_png(self.place(packages.SHEET), sheet)
        return ()


def run(job: Job) -> StepReport:
    """Write the package and the contact sheet.

    Raises:
        BadInput: inputs that do not belong together: other numbers of frames, neither or both kinds of mesh.
        BackendUnavailable: a setting asks for a library that is not here.
    """
    with TemporaryDirectory() as scratch:
        contents = _contents(job, Path(scratch))
        notes: list[str] = []
        writers = (  # those that take longest first
            contents.write_preview,
            contents.write_rig,
            contents.write_moving_picture,
            contents.write_usd,
            contents.write_meshes,
            contents.write_turntable,
            contents.write_levels,
            contents.write_sheet,
            contents.write_splats,
            contents.write_canonical,
        )
        with ThreadPoolExecutor(WRITER_THREADS) as lanes:
            for done, written in enumerate([lanes.submit(write) for write in writers], 1):
                notes += written.result()
                job.progress(done, len(writers), {})
        job.outputs["sheet"].write_bytes((contents.folder / packages.SHEET).read_bytes())
        names = sorted(path.relative_to(contents.folder).as_posix() for path in contents.folder.rglob("*.*"))
        manifest = Manifest(
            generator=_generator(),
            mode="tracked" if isinstance(contents.surface, Asset4D) else "per_frame",
            fps=contents.fps,
            frames=len(contents.states.means),
            duration_s=len(contents.states.means) / contents.fps,
            gaussians=len(contents.gaussians),
            vertices=tuple(len(mesh.vertices) for mesh in contents.meshes),
            triangles=tuple(len(mesh.faces) for mesh in contents.meshes),
            files={name: packages.about(name) for name in names},
            notes=(*contents.notes, *notes),
        )
        text = json.dumps(manifest.model_dump(mode="json"), indent=2, ensure_ascii=False) + "\n"
        files = [(name, (contents.folder / name).read_bytes()) for name in names]
        write_zip(job.outputs["package"], [(MANIFEST, text.encode()), *files])
    return StepReport(backend=f"{job.settings.rasterizer} rasterizer", notes=tuple(notes))


def _contents(job: Job, scratch: Path) -> Contents:
    """Read the inputs, at the frame rate that is asked for."""
    pack: PackSettings = job.settings.pack
    about: PackNotes = job.settings
    gaussians = read_ply(job.inputs["gaussians"])
    fit = read_fit(job.inputs["motion"])
    video = read_frames(job.inputs["driving_video"], scratch)
    surface = _surface(job, video.fps)
    frames = len(surface.offsets) if isinstance(surface, Asset4D) else len(surface)
    _check_frames(len(video), {"motion": fit.frames, "mesh": frames})
    fps = pack.fps or video.fps
    if isinstance(surface, Asset4D):
        surface = resampled(surface, gaussians, fit.deformation, fit.frames, fps)
    elif fps != video.fps:
        raise BadInput(
            f"a mesh per frame has the frames of the driving video, {video.fps:g} a second; {fps:g} are asked for: "
            "leave pack.fps at 0, or choose mesh.mode=tracked"
        )
    return Contents(
        folder=scratch / "package",
        pack=pack,
        notes=about.notes,
        surface=surface,
        gaussians=gaussians,
        deformation=fit.deformation,
        fitted=fit.settings,
        video=video,
        states=states(gaussians, fit.deformation, fit.frames, moments(fit.frames, video.fps, fps)),
        fps=fps,
        rasterizer=choose_rasterizer(job.settings.rasterizer),
        inputs=dict(job.inputs),
    )


def _surface(job: Job, fps: float) -> Surface:
    """Read the tracked mesh, which gets the frame rate of the driving video, or a mesh per frame."""
    given = [port for port in ("tracked", "meshes") if port in job.inputs]
    match given:
        case ["tracked"]:
            tracked = read_tracked(job.inputs["tracked"])
            return Asset4D(tracked.mesh, tracked.offsets, fps, textures=tracked.textures, rest=tracked.rest)
        case ["meshes"]:
            return read_meshes(job.inputs["meshes"])
    raise BadInput(f"a package needs one kind of mesh, `tracked` or `meshes`; given {given or 'neither'}")


def _check_frames(expected: int, given: dict[str, int]) -> None:
    wrong = [f"{name} {count}" for name, count in given.items() if count != expected]
    if wrong:
        raise BadInput(f"the driving video has {expected} frames, but: {', '.join(wrong)}; run the steps before again")


def _generator() -> str:
    return f"dg4d {version('dg4d')}"
