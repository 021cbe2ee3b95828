"""Everything that leaves the house, in one package."""

import json
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from dg4d_lib.assets.animated import Asset4D, moved
from dg4d_lib.assets.glb import write_frames_glb, write_glb, write_mesh_glb
from dg4d_lib.assets.preview import write_preview
from dg4d_lib.assets.sheet import contact_sheet
from dg4d_lib.assets.splats import write_splats
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.ply import read_ply
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.interface import choose_rasterizer
from steps.job import Facts, Job
from steps.media import read_frames, write_png, write_zip
from steps.meshfiles import read_meshes, read_tracked
from steps.motions import read_motion
from steps.packages import (
    ASSET,
    GAUSSIANS,
    MANIFEST,
    MESHES,
    MOTION,
    PREVIEW,
    SHEET,
    SPLATS,
    SUBJECT,
    Manifest,
)
from steps.profiles import PackAssetSettings


def run(job: Job) -> Facts:
    """Write the package and the contact sheet.

    Raises:
        BadInput: inputs that do not belong together: other numbers of frames, neither or both kinds of mesh.
    """
    settings: PackAssetSettings = job.settings
    rasterizer = choose_rasterizer(settings.rasterizer)
    gaussians = read_ply(job.inputs["gaussians"])
    deformation, frames = read_motion(job.inputs["motion"])
    with TemporaryDirectory() as scratch:
        video = read_frames(job.inputs["driving_video"], Path(scratch))
        surface = _surface(job)
        _check_frames(len(video), {"motion": frames, "mesh": _frames_of(surface)})
        entries = list(_meshes(surface, video.fps, _extras(settings)))
        if settings.pack.splats:
            states = moved(gaussians, deformation, frames, torch.arange(float(frames)))
            paths = write_splats(Path(scratch), states)
            entries += [(f"{SPLATS}/{path.name}", path.read_bytes()) for path in paths]
        film = Path(scratch) / PREVIEW
        notes = write_preview(
            film,
            gaussians,
            deformation,
            frames,
            video.fps,
            rasterizer,
            settings.pack,
            lambda done, total: job.progress(done, total, {}),
        )
        entries.append((PREVIEW, film.read_bytes()))
    write_png(job.outputs["sheet"], contact_sheet(gaussians, deformation, video, rasterizer, settings.pack))
    entries.append((SHEET, job.outputs["sheet"].read_bytes()))
    for name, port in ((GAUSSIANS, "gaussians"), (MOTION, "motion"), (SUBJECT, "subject")):
        entries.append((name, job.inputs[port].read_bytes()))
    meshes = [surface.mesh] if isinstance(surface, Asset4D) else surface
    manifest = Manifest(
        generator=_generator(),
        mode="tracked" if isinstance(surface, Asset4D) else "per_frame",
        fps=video.fps,
        frames=frames,
        duration_s=frames / video.fps,
        gaussians=len(gaussians),
        vertices=tuple(len(mesh.vertices) for mesh in meshes),
        triangles=tuple(len(mesh.faces) for mesh in meshes),
        files={name: _about(name) for name, _ in entries},
        notes=(*settings.notes, *notes),
    )
    text = json.dumps(manifest.model_dump(mode="json"), indent=2, ensure_ascii=False) + "\n"
    write_zip(job.outputs["package"], [(MANIFEST, text.encode()), *entries])
    return Facts(backend=f"{settings.rasterizer} rasterizer", notes=notes)


def _surface(job: Job) -> Asset4D | list[TexturedMesh]:
    """The tracked mesh, or a mesh per frame: whichever was given."""
    given = [port for port in ("tracked", "meshes") if port in job.inputs]
    match given:
        case ["tracked"]:
            return read_tracked(job.inputs["tracked"])
        case ["meshes"]:
            return read_meshes(job.inputs["meshes"])
    raise BadInput(f"a package needs one kind of mesh, `tracked` or `meshes`; given {given or 'neither'}")


def _frames_of(surface: Asset4D | list[TexturedMesh]) -> int:
    return len(surface.offsets) if isinstance(surface, Asset4D) else len(surface)


def _check_frames(expected: int, given: dict[str, int]) -> None:
    wrong = [f"{name} {count}" for name, count in given.items() if count != expected]
    if wrong:
        raise BadInput(f"the driving video has {expected} frames, but: {', '.join(wrong)}; run the steps before again")


def _meshes(surface: Asset4D | list[TexturedMesh], fps: float, extras: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    """The animated mesh, and in the mode per_frame every frame's mesh beside it."""
    if isinstance(surface, Asset4D):
        yield ASSET, write_glb(Asset4D(surface.mesh, surface.offsets, fps, {**surface.extras, **extras}))
        return
    yield ASSET, write_frames_glb(surface, fps, extras)
    for frame, mesh in enumerate(surface):
        yield f"{MESHES}/{frame:03d}.glb", write_mesh_glb(mesh)


def _generator() -> str:
    return f"dg4d {version('dg4d')}"


def _extras(settings: PackAssetSettings) -> dict[str, Any]:
    """What the GLB says about itself."""
    return {"generator": _generator(), "notes": list(settings.notes)}


def _about(name: str) -> str:
    """One line on a file of the package."""
    single = {
        ASSET: "animated textured mesh, core glTF 2.0",
        GAUSSIANS: "Gaussians at rest, 3DGS PLY",
        MOTION: "their deformation over time, safetensors",
        SUBJECT: "the cut-out input",
        PREVIEW: "turntable film",
        SHEET: "moments by angles",
    }
    folders = {SPLATS: "Gaussians of one frame, 3DGS PLY", MESHES: "textured mesh of one frame, core glTF 2.0"}
    return single.get(name) or folders[name.partition("/")[0]]
