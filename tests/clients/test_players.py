"""What three.js and Babylon.js show of a GLB is what our own renderer shows, in a headless Chromium."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D, interpolate_frames
from dg4d_lib.assets.formats.foreign_glb import read_foreign_glb
from dg4d_lib.assets.formats.foreign_motion import MOTION, MOVES, write_moving_glb
from dg4d_lib.assets.formats.glb import write_frames_glb, write_glb, write_mesh_glb
from dg4d_lib.assets.formats.rigged import write_rigged_glb
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.tracking.rig import fit_rig, rig_offsets
from tests.clients.node import run_node

FPS = 8.0
CAMERA = OrbitCamera(elevation_deg=20.0, azimuth_deg=35.0, radius=2.0, width=160, height=160)
PLAYERS = ("three", "babylon")
COMPACT = GltfSettings(image="webp", quantized=True, meshopt=True)


@dataclass(frozen=True)
class Case:
    """A file, the moments to look at in frames, and what is seen there."""

    content: bytes
    asset: Asset4D
    moments: tuple[float, ...]
    held: bool = False  # no motion between frames
    first_texture_in: tuple[str, ...] = ()  # players that do not know how its texture changes


def fish(frames: int, textures: bool = False) -> Asset4D:
    """A long body with a different color at every place, that swims: bends, turns and rises."""
    solid = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    rest = torch.tensor(solid.triangles.reshape(-1, 3) * (0.6, 0.25, 0.15), dtype=torch.float32)
    uvs = torch.stack((rest[:, 0] / 1.2 + 0.5, 0.5 - rest[:, 1] * 2), 1)
    ramp = torch.linspace(0, 1, 64)
    texture = torch.stack((ramp.expand(64, 64), ramp[:, None].expand(64, 64), 1 - ramp.expand(64, 64)), -1)
    x, y, z = rest.T
    phases = torch.arange(frames) / frames * 2 * torch.pi
    poses = [
        torch.stack((p.cos() * x + p.sin() * z, y + 0.3 * p.sin() + x * x * p.sin(), p.cos() * z - p.sin() * x), 1)
        for p in phases / 2
    ]
    changing = torch.stack([texture.roll(frame * 64 // frames, 1) for frame in range(frames)]) if textures else None
    mesh = TexturedMesh(rest, torch.arange(len(rest)).reshape(-1, 3), uvs, texture)
    return Asset4D(mesh, torch.stack(poses) - rest, FPS, {}, changing)


def poses_of(asset: Asset4D) -> list[TexturedMesh]:
    return [replace(asset.mesh, vertices=asset.mesh.vertices + offsets) for offsets in asset.offsets]


def cases() -> dict[str, Case]:
    swim, flicker, long = fish(6), fish(6, textures=True), fish(300)
    step = GltfSettings(interpolation="step")
    return {
        "plain": Case(write_glb(swim), swim, (0.0, 2.5, 4.25)),
        "held": Case(write_glb(swim, step), swim, (0.4, 2.6, 5.5), held=True),
        "compact": Case(write_glb(swim, COMPACT), swim, (0.0, 2.5, 4.25)),
        "pointer": Case(write_glb(flicker), flicker, (0.3, 2.6, 5.2), first_texture_in=("three",)),
        "core": Case(write_glb(flicker, GltfSettings(textures="core")), flicker, (0.3, 2.6, 5.2)),
        "compact core": Case(
            write_glb(flicker, COMPACT.model_copy(update={"textures": "core"})), flicker, (0.3, 2.6, 5.2)
        ),
        "long": Case(write_glb(long, COMPACT), long, (63.5, 128.5, 299.0)),
        "per frame": Case(
            write_frames_glb(poses_of(swim), FPS, {}, COMPACT), replace(swim, fps=FPS), (0.4, 2.6, 5.5), held=True
        ),
    }


def play(player: str, folder: Path, shows: Mapping[str, tuple[bytes, list[float]]], shading: str) -> dict[str, Path]:
    """Give every file to a player; the folders of its pictures."""
    request = {"position": CAMERA.position().tolist(), "fov": CAMERA.fov_y_deg, "size": CAMERA.width}
    folders = {name: folder / player / f"{name} ü" for name in shows}
    for name, (content, _) in shows.items():
        folders[name].mkdir(parents=True)
        (folders[name] / "süß 🦊.glb").write_bytes(content)
    wanted = [
        {"file": str(folders[name] / "süß 🦊.glb"), "folder": str(folders[name]), "times": times}
        for name, (_, times) in shows.items()
    ]
    played = run_node(
        f"play_{player}.mjs", json.dumps({**request, "shading": shading, "shows": wanted}), timeout_s=300
    )["shows"]
    assert all(facts["animations"] in ([], ["motion"], [MOTION]) for facts in played)
    return folders


@pytest.fixture(scope="module")
def all_cases() -> dict[str, Case]:
    return cases()


@pytest.fixture(scope="module", params=PLAYERS)
def played(
    request: pytest.FixtureRequest, all_cases: dict[str, Case], tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, dict[str, Path]]:
    shows = {
        name: (case.content, [moment / case.asset.fps for moment in case.moments]) for name, case in all_cases.items()
    }
    return request.param, play(request.param, tmp_path_factory.mktemp("players"), shows, "color")


def picture(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Colors and coverage, in [0, 1]."""
    with Image.open(path) as file:
        pixels = np.array(file.convert("RGBA")) / 255
    return pixels[..., :3], pixels[..., 3]


def expected(case: Case, player: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """What our renderer shows at the moments of a case."""
    moments = torch.tensor(case.moments, dtype=torch.float64)
    offsets = interpolate_frames(case.asset.offsets, moments.floor() if case.held else moments)
    pictures = []
    for moment, offset in zip(case.moments, offsets, strict=True):
        mesh = case.asset.mesh
        if case.asset.textures is not None:
            frame = 0 if player in case.first_texture_in else int(moment)
            mesh = replace(mesh, texture=case.asset.textures[frame])
        color, coverage = render_mesh(mesh, [CAMERA], offset[None])
        pictures.append((color[0].numpy(), coverage[0, ..., 0].numpy()))
    return pictures


@pytest.mark.parametrize("name", cases())
def test_players_show_what_our_renderer_shows(
    name: str, played: tuple[str, dict[str, Path]], all_cases: dict[str, Case]
) -> None:
    player, folders = played
    for number, (color, coverage) in enumerate(expected(all_cases[name], player)):
        their_color, their_coverage = picture(folders[name] / f"{number:03d}.png")
        ours, theirs = coverage > 0.5, their_coverage > 0.5
        assert (ours & theirs).sum() / (ours | theirs).sum() > 0.95
        inside = (coverage == 1) & (their_coverage == 1)
        assert np.abs(color - their_color)[inside].mean() < 0.03  # webp keeps hues at half the resolution


@pytest.mark.parametrize("quantized", [False, True])
def test_normals_turn_with_the_surface_and_stay_where_asked(quantized: bool, tmp_path: Path) -> None:
    asset, settings, frames = fish(6), GltfSettings(quantized=quantized), (0, 2, 5)
    times = [frame / FPS for frame in frames]
    shows = {
        "moving": (write_glb(asset, settings), times),
        "resting": (write_glb(asset, settings.model_copy(update={"moving_normals": False})), times),
        **{f"pose {frame}": (write_mesh_glb(poses_of(asset)[frame]), [0.0]) for frame in frames},
    }
    folders = play("three", tmp_path, shows, "normals")
    errors: dict[str, list[float]] = {"moving": [], "resting": []}
    for number, frame in enumerate(frames):
        truth, coverage = picture(folders[f"pose {frame}"] / "000.png")
        for name, found in errors.items():
            normals, there = picture(folders[name] / f"{number:03d}.png")
            found.append(float(np.abs(normals - truth)[(coverage == 1) & (there == 1)].mean()))
    assert max(errors["moving"]) < 0.005
    assert min(errors["resting"][1:]) > 0.05


@pytest.mark.parametrize("player", PLAYERS)
def test_players_undo_the_quantization_of_a_skin(player: str, tmp_path: Path) -> None:
    asset, frames = fish(6), (0.0, 2.0, 5.0)
    rig = fit_rig(asset.mesh.vertices, asset.offsets, 0.02, 12)
    skinned = replace(asset, offsets=rig_offsets(rig, asset.mesh.vertices))
    case = Case(b"", skinned, frames)
    shows = {
        name: (write_rigged_glb(asset, rig, settings), [frame / FPS for frame in frames])
        for name, settings in (("quantized", GltfSettings()), ("compressed", COMPACT))
    }
    folders = play(player, tmp_path, shows, "color")
    for name, folder in folders.items():
        for number, (_, coverage) in enumerate(expected(case, player)):
            ours, theirs = coverage > 0.5, picture(folder / f"{number:03d}.png")[1] > 0.5
            assert (ours & theirs).sum() / (ours | theirs).sum() > 0.95, name


@pytest.mark.parametrize("player", PLAYERS)
def test_players_move_the_skeleton_of_a_given_model(player: str, tmp_path: Path) -> None:
    """At keys they show the given vertices, which joints and morph targets lead to together."""
    asset, frames = fish(6), (0.0, 2.0, 5.0)
    rig = fit_rig(asset.mesh.vertices, asset.offsets, 0.1, 6)
    given = read_foreign_glb(write_rigged_glb(asset, rig, GltfSettings()), 10_000)
    moved = given.model.vertices + asset.offsets.numpy()
    content, notes = write_moving_glb(given, np.eye(4), moved, FPS, {})
    assert MOVES in notes
    folder = play(player, tmp_path, {"moving": (content, [frame / FPS for frame in frames])}, "color")["moving"]
    for number, (_, coverage) in enumerate(expected(Case(b"", asset, frames), player)):
        ours, theirs = coverage > 0.5, picture(folder / f"{number:03d}.png")[1] > 0.5
        assert (ours & theirs).sum() / (ours | theirs).sum() > 0.97
