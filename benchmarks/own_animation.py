"""Rigged models driven by renders of their own animations with `--asset`, against the frozen ground truth.

    python -m benchmarks.own_animation MODEL.glb ... [--animation RUN] [--azimuth DEG] [--frames N] [--sheets DIR]
    python -m benchmarks.own_animation MODEL.glb --set asset.skeleton=false

The model is at rest as in its file; the video shows the animation, given by name or number, from the input camera.
Columns and figures are those of `benchmarks.own_asset`.
"""

import json
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks import own_asset
from benchmarks.measure import parser_of
from benchmarks.own_asset import COLUMNS, FPS, OwnModel, render_model, write_line
from benchmarks.true_views import SIZE, Figures, Subject, mean, write_sheet

import numpy as np  # isort: skip
import torch  # isort: skip
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.assets.formats.foreign_glb import ForeignGlb, read_foreign_glb
from dg4d_lib.assets.formats.foreign_nodes import global_matrices, mesh_matrices, transform_points
from dg4d_lib.assets.formats.gltf import read_accessor
from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.asset_motion import fit_asset_motion
from dg4d_lib.fitting.asset_pose import find_placement
from dg4d_lib.fitting.skeleton_motion import fit_skeleton_motion
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from flows.inputs.manifest import parse_changes
from steps.animate_asset import attach_controls, moved_vertices
from steps.prepare_asset import cover, posed_model
from steps.profiles import PREVIEW, revise
from steps.sources.models import embed_files

AZIMUTHS = (-75.0, 15.0, 105.0, 195.0)
SPAN = 0.75  # share of the frame that the animation fills
VIDEO_SIZE = 2 * SIZE  # pixels of the video


def read_mesh(path: Path, settings: AssetSettings) -> ForeignGlb:
    """Read a GLB or glTF beside its files.

    Raises:
        BadInput: it cannot be used.
    """
    return read_foreign_glb(embed_files(path), settings.max_faces)


def played(glb: ForeignGlb, animation: str, frames: int) -> Float[np.ndarray, "t v 3"]:
    """Return the vertices of a model at evenly spaced times of an animation, in its own coordinates.

    Args:
        glb: the model; its nodes are moved.
        animation: name or number.
        frames: number of times.

    Raises:
        BadInput: there is no such animation.
    """
    animations = glb.reader.tree.get("animations", [])
    names = [str(one.get("name", number)) for number, one in enumerate(animations)]
    if animation not in names and not (animation.isdigit() and int(animation) < len(animations)):
        raise BadInput(f"the model has no animation {animation!r}; given are {', '.join(names) or 'none'}")
    selected = animations[names.index(animation) if animation in names else int(animation)]
    tracks = [
        _track(glb, selected, channel) for channel in selected["channels"] if channel["target"]["path"] != "weights"
    ]
    end = max(float(times[-1]) for _, _, times, _ in tracks)
    poses = []
    for frame in range(frames):
        for node, path, times, values in tracks:
            glb.reader.tree["nodes"][node].pop("matrix", None)
            glb.reader.tree["nodes"][node][path] = _between(times, values, end * frame / frames, path).tolist()
        poses.append(_moved_pieces(glb))
    return np.stack(poses)


def _moved_pieces(glb: ForeignGlb) -> Float[np.ndarray, "v 3"]:
    """Return the vertices of all pieces where the nodes of the file are now, in the coordinates of the model."""
    globals_ = global_matrices(glb.reader.tree)
    places = [
        transform_points(
            mesh_matrices(glb.reader, piece.node, piece.primitive, globals_), piece.local.astype(np.float64)
        )
        for piece in glb.pieces
    ]
    return np.concatenate(places).astype(np.float32)


def _track(glb: ForeignGlb, animation: dict[str, Any], channel: dict[str, Any]) -> tuple[int, str, Any, Any]:
    sampler = animation["samplers"][channel["sampler"]]
    times, values = read_accessor(glb.reader, sampler["input"])[:, 0], read_accessor(glb.reader, sampler["output"])
    if sampler.get("interpolation") == "CUBICSPLINE":
        values = values.reshape(len(times), 3, -1)[:, 1]  # without the tangents
    return channel["target"]["node"], channel["target"]["path"], times, values.astype(np.float64)


def _between(
    times: Float[np.ndarray, " k"], values: Float[np.ndarray, "k c"], time: float, path: str
) -> Float[np.ndarray, " c"]:
    """Interpolate linearly between two keys."""
    after = int(np.searchsorted(times, time).clip(1, max(len(times) - 1, 1)))
    first, second = values[after - 1], values[min(after, len(times) - 1)]
    if path == "rotation" and first @ second < 0:
        second = -second
    gap = float(times[min(after, len(times) - 1)] - times[after - 1])
    share = float(np.clip((time - times[after - 1]) / gap, 0, 1)) if gap > 0 else 0.0
    mixed: Float[np.ndarray, " c"] = (1 - share) * first + share * second
    return mixed / np.linalg.norm(mixed) if path == "rotation" else mixed


def read_rigged(path: Path, animation: str, frames: int, azimuth: float) -> tuple[OwnModel, ForeignGlb]:
    """Return a model at rest, with the video and the true views of one of its animations."""
    glb, rest = read_mesh(path, PREVIEW.asset), read_mesh(path, PREVIEW.asset)
    moved = played(glb, animation, frames)
    turn = math.radians(-azimuth) / 2
    turned = moved @ quat_to_rotmat(torch.tensor([math.cos(turn), 0.0, math.sin(turn), 0.0])).numpy().T
    low, high = turned.reshape(-1, 3).min(0), turned.reshape(-1, 3).max(0)
    half = math.tan(math.radians(OrbitCamera().fov_y_deg) / 2) * RADIUS * SPAN
    world = torch.from_numpy((turned - (low + high) / 2) * (half / (0.5 * max((high - low)[:2]))))
    model, cameras = rest.model, [OrbitCamera(0, one, width=SIZE, height=SIZE) for one in AZIMUTHS]
    footage = render_model(model, world, OrbitCamera(width=VIDEO_SIZE, height=VIDEO_SIZE))
    views = {one: render_model(model, world, camera) for one, camera in zip(AZIMUTHS, cameras, strict=True)}
    faces = torch.from_numpy(model.faces).long()
    own = OwnModel(Subject(path.stem, footage, views), model, world.float(), faces, torch.ones(len(faces)))
    return own, rest


def animate(own: OwnModel, glb: ForeignGlb, settings: AssetSettings) -> tuple[Float[Tensor, "t v 3"], str]:
    """Place the model, pose it and fit its motion, as the steps do; also return a summary."""
    rasterize, generator = get_rasterizer("auto"), torch.Generator().manual_seed(0)
    footage, covered = own.subject.footage, cover(glb, settings, 0)
    placement = find_placement(covered.cloud, footage[0], rasterize)
    said = f"outlines {placement.agreement:.3f}"
    posed = posed_model(glb, covered, placement, footage[0], rasterize, settings, ("y",))
    if posed is not None:
        placement = posed.placement
        said += f" at rest, {placement.agreement:.3f} posed"
    surface = covered.placed(placement.quat, placement.scale, placement.shift)
    mesh = attach_controls(glb, placement, surface, settings)
    video = DrivingVideo(footage[..., :3].contiguous(), footage[..., 3:].contiguous(), FPS)
    if mesh.joints is None:
        bound = mesh.graph.of(surface.nearest)
        motion = fit_asset_motion(surface.cloud, bound, video, rasterize, settings, generator)
    else:
        joints = mesh.joints.of(surface.nearest)
        motion = fit_skeleton_motion(surface.cloud, joints, video, rasterize, settings, generator)
    return moved_vertices(surface, mesh.graph, motion)[0], said


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure models, each by one of its animations."""
    parser = parser_of(__doc__)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--animation", default="0", help="name or number")
    parser.add_argument("--azimuth", type=float, default=30.0, help="of the model, from which the video shows it")
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--set", nargs="+", default=(), metavar="KEY=VALUE", help="settings of the fit")
    parser.add_argument("--sheets", type=Path, metavar="DIR", help="folder for a contact sheet of each")
    given = parser.parse_args(arguments)
    settings = revise(PREVIEW, parse_changes(list(given.set))).asset
    found: dict[str, Figures] = {}
    write_line(f"{'':24}" + "".join(f"{column:>10}" for column in COLUMNS))
    for path in given.models:
        own, glb = read_rigged(path, given.animation, given.frames, given.azimuth)
        begun = time.perf_counter()
        vertices, said = animate(own, glb, settings)
        seconds = time.perf_counter() - begun
        found[path.stem] = {**own_asset.score(own, vertices, own.faces), "flipped": 0.0}
        write_line(own_asset.row(path.stem, found[path.stem]) + f"   {seconds:.0f} s, {said}")
        write_line(own_asset.row("  truth, frozen", own_asset.frozen(own)))
        if given.sheets is not None:
            given.sheets.mkdir(parents=True, exist_ok=True)
            write_sheet(given.sheets / f"{path.stem}.png", [own_asset.sheet(own, vertices)])
    write_line(own_asset.row("mean", mean(list(found.values()))))
    if given.json:
        given.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
