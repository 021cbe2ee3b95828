"""Whether a package is good enough to be handed on: every gate, and a picture of where it falls short."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.asset_settings import GateSettings
from dg4d_lib.assets.rendering.sheet import page
from dg4d_lib.cameras.orbit import OrbitCamera, world_to_camera
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.fitting.losses import resize_cutouts
from dg4d_lib.images import color_over_white
from dg4d_lib.mesh.extraction.check import checked, welded
from dg4d_lib.metrics.gates import MESH, SPLATS, Gate, GateInputs, RgbaImages, Turntable, evaluate_gates, fidelity
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.archives import unpack
from steps.artifacts.media import read_frames, read_png, write_png
from steps.artifacts.packages import ASSET, COMPACT, MANIFEST, MESHES, read_manifest
from steps.artifacts.packages import SPLATS as SPLATS_FOLDER
from steps.artifacts.rendering import BATCH, States, Surface, drawn_mesh, mesh_at, read_states, read_surface
from steps.runtime.job import Job, StepReport

SIZE = 128  # pixels of the pictures; the bounds of the gates belong to it
MOST_FRAMES = 32  # of the video, evenly spread
MOMENTS = 4  # at which the asset is looked at from other sides
SIDES = ((0.0, 45.0), (10.0, 90.0), (0.0, 180.0), (10.0, 270.0))  # elevation and azimuth, degrees
TURN = 24  # pictures of one turn
COLUMNS = 4  # moments in the picture
DIGITS = 4  # after the point, of every number


@dataclass(frozen=True)
class Parts:
    """An asset in memory.

    Attributes:
        states: the cloud at positions of the animation.
        surface: the mesh that moves, or a mesh per frame.
        frames: of the animation.
    """

    states: States
    surface: Surface
    frames: int


def run(job: Job) -> StepReport:
    """Write the gates as JSON, and a picture of the worst moments beside the video's.

    Raises:
        BadInput: the package is broken.
        BackendUnavailable: the rasterizer cannot run here.
    """
    bounds: GateSettings = job.settings.gates
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        parts = read_parts(job.inputs["package"], folder / "package")
        video = read_frames(job.inputs["driving_video"], folder)
    evidence = gather(parts, video, read_png(job.inputs["subject"]), get_rasterizer(job.settings.rasterizer))
    gates = evaluate_gates(evidence, bounds)
    job.outputs["gates"].write_text(json.dumps(verdict(gates), ensure_ascii=False, allow_nan=False), encoding="utf-8")
    write_png(job.outputs["picture"], picture(evidence, (_spread(len(video), MOST_FRAMES) / video.fps).tolist()))
    failing = [gate.name for gate in gates if not gate.passed]
    notes = (f"Not accepted: {', '.join(failing)}. The report says what to do.",) if failing else ()
    return StepReport(backend=f"{job.settings.rasterizer} rasterizer", notes=notes)


def read_parts(package: Path, folder: Path) -> Parts:
    """What the gates need of a package; `folder` is where that is unpacked.

    Raises:
        BadInput: files are missing or broken.
    """
    wanted = (MANIFEST, ASSET, COMPACT, f"{MESHES}/", f"{SPLATS_FOLDER}/")
    unpack(package, folder, "the package", lambda name: name.startswith(wanted))
    manifest = read_manifest(folder)
    return Parts(read_states(folder, manifest), read_surface(folder, manifest), manifest.frames)


def gather(parts: Parts, video: DrivingVideo, cutout: Float[Tensor, "h w 4"], rasterizer: Rasterizer) -> GateInputs:
    """Look at an asset from the input view, from four sides at four moments, and all around.

    Args:
        parts: the asset.
        video: what it was fitted to; lasts as long as its animation.
        cutout: the input picture.
        rasterizer: draws the splats.
    """
    frames = _spread(len(video), MOST_FRAMES)
    positions = frames * parts.frames / len(video)
    front = OrbitCamera(width=SIZE, height=SIZE)
    moments = positions[_spread(len(frames), MOMENTS).long()]
    sides = [OrbitCamera(elevation_deg, azimuth_deg, width=SIZE, height=SIZE) for elevation_deg, azimuth_deg in SIDES]
    ring = turntable(TURN, front)
    mesh = drawn_mesh(parts.surface)

    def splats(positions: Float[Tensor, " b"], cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b s s 5"]:
        with torch.no_grad():
            drawn = rasterizer(parts.states(positions), cameras, torch.ones(3))
        depth = drawn.depth / drawn.alpha.clamp_min(torch.finfo(drawn.alpha.dtype).tiny)
        return torch.cat([drawn.color, drawn.alpha, depth], -1)

    def triangles(positions: Float[Tensor, " b"], cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b s s 4"]:
        drawn = mesh(positions, cameras)
        color, coverage = drawn[..., :3], drawn[..., 3:]
        return torch.cat([color_over_white(color, coverage), coverage], -1)

    seen, around = {}, {}
    for form, draw in ((SPLATS, splats), (MESH, triangles)):
        seen[form] = _pictures(_drawn(draw, positions, [front] * len(positions)))
        around[form] = _pictures(_drawn(draw, moments.repeat_interleave(len(sides)), sides * len(moments)))
    turn = _drawn(splats, positions[:1].repeat(TURN), ring)
    return GateInputs(
        picture=_resized(cutout[None]),
        video=_resized(torch.cat([video.frames, video.coverage], -1)[frames.long()]),
        input_views=seen,
        side_views=around,
        turntable=Turntable(turn[..., 3:4], turn[..., 4:], world_to_camera(ring), front.focal),
        flaws=max(_flaws(parts.surface, moment) for moment in moments),
    )


def verdict(gates: Sequence[Gate]) -> dict[str, Any]:
    """What the gates say, as JSON."""
    return {
        "accepted": all(gate.passed for gate in gates),
        "failing": [gate.name for gate in gates if not gate.passed],
        "gates": [
            {
                "name": gate.name,
                "passed": gate.passed,
                "value": round(gate.value, DIGITS),
                "unit": gate.unit,
                "least": gate.least,
                "most": gate.most,
                "form": gate.form,
                "values": {form: round(value, DIGITS) for form, value in gate.values.items()},
                "meaning": gate.meaning,
                "advice": gate.advice,
            }
            for gate in gates
        ],
    }


def picture(evidence: GateInputs, seconds: Sequence[float]) -> Float[Tensor, "h w 3"]:
    """The video, both forms of the asset and where they are off, in [0, 1].

    Columns are moments: the first, and of three equal parts of the video the one that is shown worst.

    Args:
        evidence: what was seen.
        seconds: when the frames of the evidence are.
    """
    scores = torch.stack([fidelity(pictures, evidence.video) for pictures in evidence.input_views.values()]).amin(0)
    thirds = torch.arange(len(scores)).tensor_split(COLUMNS - 1)
    worst = [int(part[scores[part].argmin()]) for part in thirds if len(part)]
    columns = sorted({0, *worst})
    rows = {"input": evidence.video.color[columns]}
    for form, pictures in evidence.input_views.items():
        rows[form] = pictures.color[columns]
        rows[f"{form} off by"] = 1 - (pictures.color - evidence.video.color)[columns].abs()
    headings = [f"{seconds[column]:.2f} s: {scores[column]:.1f} dB" for column in columns]
    return page(torch.stack(list(rows.values())), list(rows), headings)


def _spread(count: int, most: int) -> Float[Tensor, " n"]:
    """Numbers of so many things at most, evenly from the first to the last."""
    return torch.linspace(0, count - 1, min(count, most), dtype=torch.float64).round()


def _drawn(
    draw: Callable[[Tensor, Sequence[OrbitCamera]], Tensor], positions: Tensor, cameras: Sequence[OrbitCamera]
) -> Float[Tensor, "b s s c"]:
    parts = [slice(start, start + BATCH) for start in range(0, len(cameras), BATCH)]
    return torch.cat([draw(positions[part], cameras[part]) for part in parts])


def _pictures(drawn: Float[Tensor, "b s s c"]) -> RgbaImages:
    return RgbaImages(drawn[..., :3].clamp(0, 1).contiguous(), drawn[..., 3:4].clamp(0, 1).contiguous())


def _resized(cutouts: Float[Tensor, "b h w 4"]) -> RgbaImages:
    return RgbaImages(*(part.contiguous() for part in resize_cutouts(cutouts, SIZE)))


def _flaws(surface: Surface, position: Float[Tensor, ""]) -> float:
    """What is broken about the mesh of a moment: edges and triangles per triangle, and the share of inverted pieces."""
    mesh = mesh_at(surface, position)
    facts = checked(*welded(mesh.vertices.numpy(), mesh.faces.numpy()))
    broken = facts.boundary + facts.crowded + facts.twisted + facts.flat
    return broken / max(1, facts.triangles) + facts.inverted / max(1, facts.components)
