"""Step that checks a package against the quality gates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dg4d_lib.asset_settings import GateSettings
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.assets.placement import Surface
from dg4d_lib.assets.rendering.sheet import draw_tiles
from dg4d_lib.cameras.orbit import OrbitCamera, viewmats
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.fitting.losses import resize_cutouts
from dg4d_lib.images import color_over_white, resize
from dg4d_lib.mesh.extraction.topology import check_topology, join_seams, weld_vertices
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.metrics.gates import MESH, SPLATS, GateInputs, RgbaImages, Turntable, evaluate_gates, fidelity
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.archives import unpack
from steps.artifacts.gates import gates_as_json, read_rows, write_gates
from steps.artifacts.media import read_frames, read_png, write_png
from steps.artifacts.package_files import ASSET, COMPACT, MANIFEST, MERGED, MESHES
from steps.artifacts.package_files import SPLATS as SPLATS_FOLDER
from steps.artifacts.packages import read_manifest
from steps.artifacts.rendering import BATCH, States, mesh_at, mesh_renderer, read_states, read_surface
from steps.runtime.job import Job, StepReport

SIZE = 128  # pixels of a side of the renders; the bounds of the gates were calibrated at this size
SUPERSAMPLE = 2  # of splats: at this size the rasterizer's low-pass filter widens small ones by a pixel
MOST_FRAMES = 32  # frames of the video that are compared, evenly spaced
TIMESTAMPS = 4  # number of frames that are rendered from other sides
SIDES = ((0.0, 45.0), (10.0, 90.0), (0.0, 180.0), (10.0, 270.0))  # elevation and azimuth, degrees
TURN = 24  # renders of one turn
COLUMNS = 4  # frames in the picture
DrawAt = Callable[[Tensor, Sequence[OrbitCamera]], Tensor]  # renders of positions of the animation, a camera for each


@dataclass(frozen=True)
class LoadedAsset:
    """An asset in memory.

    Attributes:
        states: Gaussians at positions of the animation.
        surface: tracked mesh, or a mesh per frame.
        frames: number of frames.
        own_model: the mesh is a model of the user's own, which may have flaws and folds at rest.
    """

    states: States
    surface: Surface
    frames: int
    own_model: bool = False


def run(job: Job) -> StepReport:
    """Write the gates as JSON, and a picture of the worst frames beside those of the video.

    Raises:
        BadInput: the package is broken.
        BackendUnavailable: the rasterizer cannot run here.
    """
    bounds: GateSettings = job.settings.gates
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        asset = read_asset(job.inputs["package"], folder / "package")
        video = read_frames(job.inputs["driving_video"], folder)
    rasterizer = get_rasterizer(job.settings.rasterizer)
    evidence = collect_evidence(asset, video, read_png(job.inputs["subject"]), rasterizer)
    earlier = job.inputs.get("cutout_gates")
    answer = gates_as_json(evaluate_gates(evidence, bounds), read_rows(earlier) if earlier else ())
    write_gates(job.outputs["gates"], answer)
    write_png(job.outputs["picture"], picture(evidence, (_spread(len(video), MOST_FRAMES) / video.fps).tolist()))
    failing = answer["failing"]
    notes = (f"Not accepted: {', '.join(failing)}. The report says what to do.",) if failing else ()
    return StepReport(backend=f"{job.settings.rasterizer} rasterizer", notes=notes)


def read_asset(package: Path, folder: Path) -> LoadedAsset:
    """Read the parts of a package that the gates need; `folder` is for unpacking.

    Raises:
        BadInput: files are missing or broken.
    """
    wanted = (MANIFEST, ASSET, MERGED, COMPACT, f"{MESHES}/", f"{SPLATS_FOLDER}/")
    unpack(package, folder, "the package", lambda name: name.startswith(wanted))
    manifest = read_manifest(folder)
    states, surface = read_states(folder, manifest), read_surface(folder, manifest)
    return LoadedAsset(states, surface, manifest.frames, manifest.mode == "own")


def collect_evidence(
    asset: LoadedAsset, video: DrivingVideo, cutout: Float[Tensor, "h w 4"], rasterizer: Rasterizer
) -> GateInputs:
    """Render an asset from the input view, from four sides at four timestamps, and all around.

    Args:
        asset: asset to check.
        video: driving video of its motion, of the same duration.
        cutout: input picture.
        rasterizer: rasterizer for the splats.
    """
    frames = _spread(len(video), MOST_FRAMES)
    positions = frames * asset.frames / len(video)
    front = OrbitCamera(width=SIZE, height=SIZE)
    timestamps = positions[_spread(len(frames), TIMESTAMPS).long()]
    sides = [OrbitCamera(elevation_deg, azimuth_deg, width=SIZE, height=SIZE) for elevation_deg, azimuth_deg in SIDES]
    ring = turntable(TURN, front)
    mesh = mesh_renderer(asset.surface)

    def splats(positions: Float[Tensor, " b"], cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b s s 5"]:
        with torch.no_grad():
            rendering = rasterizer(asset.states(positions), cameras, torch.ones(3))
        depth = rendering.depth / rendering.alpha.clamp_min(torch.finfo(rendering.alpha.dtype).tiny)
        return torch.cat([rendering.color, rendering.alpha, depth], -1)

    def triangles(positions: Float[Tensor, " b"], cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b s s 4"]:
        rendering = mesh(positions, cameras)
        color, alpha = rendering[..., :3], rendering[..., 3:]
        return torch.cat([color_over_white(color, alpha), alpha], -1)

    seen, around = {}, {}
    for form, draw in ((SPLATS, splats), (MESH, triangles)):
        finer = SUPERSAMPLE if form == SPLATS else 1
        seen[form] = _pictures(draw, positions, [front] * len(positions), finer)
        around[form] = _pictures(draw, timestamps.repeat_interleave(len(sides)), sides * len(timestamps), finer)
    turn = _render(splats, positions[:1].repeat(TURN), ring)
    flaws, folds = _worst_defects(asset, timestamps)
    return GateInputs(
        picture=_resized(cutout[None]),
        video=_resized(torch.cat([video.frames, video.alpha], -1)[frames.long()]),
        input_views=seen,
        side_views=around,
        turntable=Turntable(turn[..., 3:4], turn[..., 4:], viewmats(ring), front.focal),
        flaws=flaws,
        folds=folds,
        own_model=asset.own_model,
        per_frame=not isinstance(asset.surface, Asset4D),
    )


def picture(evidence: GateInputs, seconds: Sequence[float]) -> Float[Tensor, "h w 3"]:
    """Compose a picture of the video, splats and mesh, and their differences, in [0, 1].

    Columns are frames: the first, and the worst one of every third of the video.

    Args:
        evidence: renders of the asset and frames of the video.
        seconds: timestamps of the frames.
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
    return draw_tiles(torch.stack(list(rows.values())), list(rows), headings)


def _spread(count: int, most: int) -> Float[Tensor, " n"]:
    """Return at most `most` indices below `count`, evenly spaced from the first to the last."""
    return torch.linspace(0, count - 1, min(count, most), dtype=torch.float64).round()


def _render(draw: DrawAt, positions: Tensor, cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b s s c"]:
    parts = [slice(start, start + BATCH) for start in range(0, len(cameras), BATCH)]
    return torch.cat([draw(positions[part], cameras[part]) for part in parts])


def _pictures(draw: DrawAt, positions: Tensor, cameras: Sequence[OrbitCamera], finer: int) -> RgbaImages:
    """Render an asset at a multiple of the resolution, then reduce the pictures to the size of the cameras."""
    size = (cameras[0].height, cameras[0].width)
    fine = [replace(camera, width=finer * camera.width, height=finer * camera.height) for camera in cameras]
    rendering = resize(_render(draw, positions, fine)[..., :4], size)
    return RgbaImages(rendering[..., :3].clamp(0, 1).contiguous(), rendering[..., 3:4].clamp(0, 1).contiguous())


def _resized(cutouts: Float[Tensor, "b h w 4"]) -> RgbaImages:
    return RgbaImages(*(part.contiguous() for part in resize_cutouts(cutouts, SIZE)))


@dataclass(frozen=True)
class _Rest:
    """Rest pose of a mesh, the baseline for defects in other frames.

    Attributes:
        joined: vertices without copies along seams.
        finder: of crossings, flips and folds; its faces join these vertices.
        flaws: of the mesh at rest that do not count.
        folded: triangles that do not count, for they have such defects at rest.
    """

    joined: Int[np.ndarray, " n"]
    finder: DefectFinder
    flaws: float
    folded: Bool[np.ndarray, " f"]

    @classmethod
    def of(cls, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], own_model: bool) -> "_Rest":
        """Measure the defects of a mesh at rest; those of a user's own model do not count."""
        rest = vertices.numpy()
        joined, corners = join_seams(rest, faces.numpy())
        finder = DefectFinder(corners, rest[joined])
        if own_model:
            return cls(joined, finder, _broken(vertices, faces), finder.defective(rest[joined]))
        return cls(joined, finder, 0.0, np.zeros(len(corners), bool))

    def added(self, vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> tuple[float, float]:
        """Return flaws per triangle, and the share of triangles that cross others, are flipped or folded."""
        folded = self.finder.defective(vertices.numpy()[self.joined]) & ~self.folded
        return max(0.0, _broken(vertices, faces) - self.flaws), float(folded.mean())


def _worst_defects(asset: LoadedAsset, positions: Float[Tensor, " b"]) -> tuple[float, float]:
    """Return the most flaws and folds at some positions; of a model, those that the motion adds.

    A mesh per frame has its own rest, so none of its triangles is flipped.
    """
    rest, found = None, []
    for position in positions:
        mesh = mesh_at(asset.surface, position)
        if not isinstance(asset.surface, Asset4D):
            rest = _Rest.of(mesh.vertices, mesh.faces, asset.own_model)
        elif rest is None:
            rest = _Rest.of(asset.surface.mesh.vertices, mesh.faces, asset.own_model)
        found.append(rest.added(mesh.vertices, mesh.faces))
    flaws, folds = zip(*found, strict=True)
    return max(flaws), max(folds)


def _broken(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> float:
    """Return the broken edges and triangles per triangle, and the share of inverted pieces."""
    check = check_topology(*weld_vertices(vertices.numpy(), faces.numpy()))
    broken = check.boundary_edges + check.nonmanifold_edges + check.inconsistent_edges + check.degenerate_faces
    return broken / max(1, check.triangles) + check.inverted_components / max(1, check.components)
