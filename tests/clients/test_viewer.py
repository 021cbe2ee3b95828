"""The viewer page in a real browser: it plays, shows what our own renderers show, and asks nobody for anything."""

import io
import json
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from node import CLIENTS, run_node
from numpy.typing import NDArray
from PIL import Image

from dg4d_lib.asset_settings import GltfSettings
from dg4d_lib.assets.animated import Asset4D, interpolate_frames
from dg4d_lib.assets.formats.glb import write_frames_glb, write_glb
from dg4d_lib.assets.formats.web_splats import write_web_splats
from dg4d_lib.assets.placement import Placement
from dg4d_lib.assets.rendering.preview import write_mp4
from dg4d_lib.assets.rendering.viewer_page import build_viewer_page
from dg4d_lib.cameras.orbit import FOV_Y_DEG, OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.rasterizer.interface import get_rasterizer
from flows.packages.html_pages import render
from flows.packages.report import report_page
from flows.packages.summary import Row, Writer

VIEWER = CLIENTS.parents[1] / "dg4d_lib" / "assets" / "viewer"
FRAMES, FPS = 4, 4.0
PAGE_BYTES = 1_000_000  # without data
WINDOW = {"width": 800, "height": 400}
TIMES = (0.0, 0.375)  # a frame, and the middle between two


@dataclass(frozen=True)
class Tried:
    """What the script said, and its pictures by mode and moment."""

    said: dict[str, Any]
    pictures: dict[tuple[str, float], NDArray[np.float64]]

    def camera(self) -> OrbitCamera:
        """The product's camera of the input, as wide as the canvas."""
        width, height = self.said["size"]
        return OrbitCamera(width=width, height=height)


def ball() -> TexturedMesh:
    """An egg with a bright and a dark side."""
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    vertices = torch.tensor(sphere.vertices, dtype=torch.float32) * torch.tensor([1.0, 0.7, 0.8])
    uvs = torch.stack([0.5 + vertices[:, 0] / 1.3, 0.5 - vertices[:, 1] / 1.3], 1)
    ramp = torch.linspace(0, 1, 32)
    texture = torch.stack([ramp.expand(32, 32), ramp[:, None].expand(32, 32), torch.full((32, 32), 0.3)], -1)
    return TexturedMesh(vertices, torch.tensor(sphere.faces), uvs, texture)


def stretches(vertices: torch.Tensor) -> torch.Tensor:
    """Offsets that make it taller and thinner, and back."""
    sway = torch.sin(torch.arange(FRAMES) / FRAMES * 2 * torch.pi)[:, None, None]
    return sway * vertices * torch.tensor([-0.3, 0.4, 0.0])


def egg() -> Asset4D:
    mesh = ball()
    return Asset4D(mesh, stretches(mesh.vertices), FPS)


def splats() -> Gaussians:
    """Slanted leaves of many colors, some of them faint, which move, turn and grow."""
    generator = torch.Generator().manual_seed(0)
    count = 300
    places = torch.randn(count, 3, generator=generator) * torch.tensor([0.35, 0.25, 0.2])
    turns = torch.randn(count, 4, generator=generator)
    scales = torch.rand(count, 3, generator=generator) * torch.tensor([0.12, 0.06, 0.01]) + 0.01
    wave = torch.sin(torch.arange(FRAMES) / FRAMES * 2 * torch.pi)[:, None, None]
    return Gaussians(
        places + stretches(places),
        scales.log() + 0.2 * wave,
        torch.nn.functional.normalize(turns, dim=-1) + 0.3 * wave * torch.randn(count, 4, generator=generator),
        torch.randn(count, generator=generator) * 2,
        rgb_to_sh(torch.rand(count, 3, generator=generator)),
    )


Try = Callable[..., Tried]


@pytest.fixture
def tried(tmp_path: Path) -> Try:
    """Writes a page of these parts and tries it out in a browser."""

    def run(
        glb: bytes | None,
        cloud: Gaussians | None = None,
        video: bytes | None = None,
        facts: dict[str, Any] | None = None,
        shots: tuple[tuple[str, float], ...] = (),
        view: dict[str, Any] | None = None,
        **request: Any,
    ) -> Tried:
        packed = None if cloud is None else write_web_splats(cloud, FPS)
        page = tmp_path / "viewer with ümlaut.html"
        page.write_text(build_viewer_page("Egg", glb, packed, None, video, facts or {}, view or {}), encoding="utf-8")
        files = {shot: tmp_path / f"{number}.png" for number, shot in enumerate(shots)}
        asked = [{"show": show, "time": time, "file": str(files[show, time])} for show, time in shots]
        said = run_node("view.mjs", json.dumps({"page": str(page), "shots": asked, **WINDOW, **request}))
        return Tried(said, {shot: np.asarray(Image.open(path), float) / 255 for shot, path in files.items()})

    return run


def over_white(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    color, alpha = picture[..., :3], picture[..., 3:]
    white: NDArray[np.float64] = color * alpha + 1 - alpha
    return white


def overlap(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Intersection over union of two coverages."""
    one, two = first > 0.5, second > 0.5
    return float((one & two).sum() / (one | two).sum())


def psnr(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    return float(-10 * np.log10(np.square(first - second).mean()))


@pytest.mark.parametrize(
    "placement",
    [pytest.param(Placement(0.02, (0.0, 0.01, 0.3)), marks=pytest.mark.slow), Placement(40.0, (3.0, 20.0, 0.0))],
)
def test_the_input_camera_follows_a_placed_asset(placement: Placement, tried: Try) -> None:
    """Show a tiny and a huge asset as the one in the coordinates of the fit."""
    view = {"radius": 2 * placement.scale, "target": placement.translation}
    shots = (("mesh", 0.375), ("splats", 0.375))
    plain = tried(write_glb(egg()), splats(), shots=shots)
    asset = placement.surface(egg())
    placed = tried(write_glb(asset), placement.gaussians(splats()), view=view, shots=shots)
    for shot in shots:
        assert psnr(over_white(placed.pictures[shot]), over_white(plain.pictures[shot])) > 40


def test_an_asset_that_leaves_the_input_picture_is_seen_from_farther_away(tried: Try) -> None:
    page = tried(write_glb(egg()), shots=(("mesh", 0.0),), view={"whole_fov_y_deg": 90.0})
    camera = replace(page.camera(), radius=2 / math.tan(math.radians(FOV_Y_DEG / 2)))
    _, coverage = render_mesh(egg().mesh, [camera], egg().offsets[:1])
    assert overlap(page.pictures["mesh", 0.0][..., 3] > 0.5, coverage[0, ..., 0].numpy() > 0.5) > 0.98


def test_splats_look_as_our_rasterizer_draws_them(tried: Try) -> None:
    cloud = splats()
    page = tried(write_glb(egg()), cloud, shots=tuple(("splats", time) for time in TIMES))
    for time in TIMES:
        position = torch.tensor([time * FPS])
        state = replace(
            cloud,
            means=interpolate_frames(cloud.means, position),
            log_scales=interpolate_frames(cloud.log_scales, position),
            quats=interpolate_frames(torch.nn.functional.normalize(cloud.quats, dim=-1), position),
        )
        drawn = get_rasterizer("cpu")(state, [page.camera()], torch.ones(3))
        theirs = page.pictures["splats", time]
        assert overlap(theirs[..., 3], drawn.alpha[0, ..., 0].numpy()) > 0.98
        assert psnr(over_white(theirs), drawn.color[0].numpy()) > 35  # 8-bit blending and the compact file
    assert psnr(*(over_white(page.pictures["splats", time]) for time in TIMES)) < 30


def test_splats_without_a_mesh_stand_still_and_can_be_turned(tried: Try) -> None:
    cloud = splats()
    still = replace(cloud, means=cloud.means[:1], log_scales=cloud.log_scales[:1], quats=cloud.quats[:1])
    page = tried(None, still, shots=(("splats", 0.0),), deeds=[["drag", 120, 40], ["press", "r"]])
    ready = page.said["states"][0]
    assert (ready["modes"], ready["frames"], ready["playing"]) == (["splats"], 1, False)
    first, turned, reset = page.said["drawn"]
    assert turned != first == reset
    drawn = get_rasterizer("cpu")(still.at(0), [page.camera()], torch.ones(3))
    assert psnr(over_white(page.pictures["splats", 0.0]), drawn.color[0].numpy()) > 35


VARIANTS = {
    "core": GltfSettings(),
    "compressed": GltfSettings(image="webp", quantized=True, meshopt=True),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_mesh_looks_as_our_renderer_draws_it(tried: Try, variant: str) -> None:
    asset, settings = egg(), VARIANTS[variant]
    if settings.meshopt:
        pytest.importorskip("meshoptimizer", reason="meshoptimizer is not installed: make clients")
    page = tried(write_glb(asset, settings), shots=tuple(("mesh", time) for time in TIMES))
    for time in TIMES:
        offsets = interpolate_frames(asset.offsets, torch.tensor([time * FPS]))
        color, coverage = (part[0].numpy() for part in render_mesh(asset.mesh, [page.camera()], offsets))
        theirs = page.pictures["mesh", time]
        assert overlap(theirs[..., 3], coverage[..., 0]) > 0.98
        assert psnr(over_white(theirs), color * coverage + 1 - coverage) > 30


def test_frames_with_meshes_of_their_own_are_shown_one_at_a_time(tried: Try) -> None:
    mesh = ball()
    moved = [replace(mesh, vertices=mesh.vertices + torch.tensor([x, 0.0, 0.0])) for x in (-0.5, 0.5)]
    page = tried(write_frames_glb(moved, FPS), shots=(("mesh", 0.1), ("mesh", 0.3), ("wireframe", 0.1)))
    assert page.said["states"][0] | {"frames": 2, "fps": FPS, "duration": 0.5} == page.said["states"][0]
    for mode, time, frame in (("mesh", 0.1, 0), ("mesh", 0.3, 1), ("wireframe", 0.1, 0)):
        _, coverage = render_mesh(moved[frame], [page.camera()])
        assert overlap(page.pictures[mode, time][..., 3], coverage[0, ..., 0].numpy()) > 0.95


def test_the_time_of_a_frame_shows_that_frame(tried: Try) -> None:
    """Times of keys have the precision of float32: 0.1 is later there than in the page."""
    mesh, fps, frames = ball(), 10.0, 8
    moved = [replace(mesh, texture=torch.full_like(mesh.texture, k / (frames - 1))) for k in range(frames)]
    times = [k / fps for k in range(frames)]
    page = tried(
        write_frames_glb(moved, fps, settings=GltfSettings(image="png")), shots=tuple(("mesh", t) for t in times)
    )
    for k, time in enumerate(times):
        picture = page.pictures["mesh", time]
        middle = picture[picture.shape[0] // 2, picture.shape[1] // 2]
        np.testing.assert_allclose(middle[:3], k / (frames - 1), atol=0.02)


def test_a_texture_that_changes_is_seen_to_change(tried: Try) -> None:
    colors = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0]])
    asset = replace(egg(), textures=colors[:, None, None].expand(FRAMES, 16, 16, 3))
    times = [(frame + 0.1) / FPS for frame in range(FRAMES)]
    page = tried(write_glb(asset, GltfSettings(image="png")), shots=tuple(("mesh", time) for time in times))
    for color, time in zip(colors, times, strict=True):
        picture = page.pictures["mesh", time]
        middle = picture[picture.shape[0] // 2, picture.shape[1] // 2]
        np.testing.assert_allclose(middle, [*color, 1.0], atol=0.02)


def test_it_plays_at_once_answers_hands_and_keys_and_asks_no_network(tried: Try) -> None:
    deeds = [
        ["wait", 0.3], ["press", "Space"], ["wait", 0.2], ["press", "Home"], ["press", "ArrowRight"],
        ["press", "ArrowLeft"], ["press", "ArrowUp"], ["press", "2"], ["press", "3"], ["press", "1"], ["press", "b"],
        ["drag", 120, 40], ["press", "r"], ["wheel", 300], ["press", "r"], ["press", "Shift+ArrowLeft"],
        ["press", "Shift+ArrowUp"], ["press", "+"], ["press", "-"], ["press", "-"], ["press", "r"],
    ]  # fmt: skip
    page = tried(write_glb(egg()), splats(), facts={"Steps": {"1. fit": {"seed": 7}}}, deeds=deeds)
    told = [
        {**state, "picture": picture} for state, picture in zip(page.said["states"], page.said["drawn"], strict=True)
    ]
    ready, played, stopped, later, home, forward, back, faster, cloud, wires, mesh, dark, *moved = told
    turned, reset, far, again, aside, above, nearer, _, farther, last = moved
    assert ready["playing"]
    assert ready["modes"] == ["mesh", "splats", "wireframe"]
    assert played["time"] != ready["time"]
    assert not stopped["playing"]
    assert later["time"] == stopped["time"]
    assert later["picture"] == stopped["picture"]
    assert [state["frame"] for state in (home, forward, back)] == [0, 1, 0]
    assert home["picture"] == back["picture"] != forward["picture"]
    assert (home["speed"], faster["speed"]) == (1, 1.5)
    assert [state["shown"] for state in (cloud, wires, mesh)] == ["splats", "wireframe", "mesh"]
    assert len({state["picture"] for state in (cloud, wires, mesh)}) == 3
    assert dark["dark"] != mesh["dark"]
    assert len({state["picture"] for state in (mesh, turned, far)}) == 3
    assert mesh["picture"] == reset["picture"] == again["picture"] == last["picture"]
    by_keys = (mesh, aside, above, nearer, farther)
    assert len({state["picture"] for state in by_keys}) == len(by_keys)
    assert {(state["time"], state["speed"]) for state in by_keys} == {(mesh["time"], mesh["speed"])}
    (address,) = page.said["requests"]
    assert address.startswith("file://")
    assert "1. fit" in page.said["facts"]


def test_a_still_page_stays_still_answers_space_on_buttons_and_survives_a_lost_context(tried: Try) -> None:
    deeds = [["wait", 0.2], ["focus", "button[data-show=splats]"], ["press", "Space"], ["lose"],
             ["focus", "#play"], ["press", "Space"]]  # fmt: skip
    page = tried(write_glb(egg()), splats(), deeds=deeds, reducedMotion="reduce")
    ready, *_, cloud, lost, _, played = page.said["states"]
    assert [state["playing"] for state in (ready, cloud, lost, played)] == [False, False, False, True]
    assert (ready["time"], cloud["time"], cloud["shown"]) == (0, 0, "splats")


GATE = {
    "name": "fidelity", "form": "mesh", "value": 24.6, "unit": "dB", "least": 16.5, "most": None,
    "passed": True, "meaning": "agreement with the video from the input camera: PSNR on the subject",
}  # fmt: skip
CURVES = {"title": "static fit", "x": [0, 10, 20], "series": {str(n): [100.0, 1.0, 1 / (n + 1)] for n in range(8)}}
REPORT = {
    "item": "Egg", "source": "egg.png", "profile": "preview", "seed": 0, "banner": "Preview.",
    "notes": ["sha256:" + "a" * 64], "wall_s": 2.0, "compute_s": 3.0,
    "acceptance": {
        "accepted": False,
        "failing": ["silhouette"],
        "gates": [GATE, GATE | {"name": "silhouette", "passed": False, "advice": "Choose a plain backdrop."}],
    },
    "steps": [{"step": "fit_gaussians", "compute_s": 3.0, "peak_memory_mb": 600, "cached": True, "curves": [CURVES],
               "backend": "cpu rasterizer, pymeshlab", "flops": {"UNet2DConditionModel": 10**12}}],
    "licenses": {"zero123-xl": "MIT License with terms of which there are many words " * 3},
    "files": {f"{'long_name_' * 6}.glb": 1, "splats/000.ply": 7}, "settings": {"name": "x" * 200},
}  # fmt: skip

SCORES: dict[str, Any] = {
    "title": "Scores", "metrics": [{"heading": f"metric {n}"} for n in range(9)], "ours": 0, "quote": str,
    "table": [{str(n): "0.123" for n in range(10)}], "missing": {"LPIPS": "no weights"},
    "objects": [
        {"name": "fox", "error": "", "facts": ["PSNR 30"], "views": ["input", "view_90"],
         "videos": {"truth": {}, "ours": {}}},
        {"name": "owl", "error": "The package is damaged."},
    ],
}  # fmt: skip


def test_pages_are_for_everybody_on_a_phone_and_on_a_desk(tmp_path: Path) -> None:
    """Check axe's rules, WCAG AA contrast among them, at 390 and 1280 pixels in light and dark."""
    (tmp_path / "viewer.html").write_text(build_viewer_page("Egg", write_glb(egg()), None, None, None, {"Steps": {}}))
    picture = io.BytesIO()
    Image.new("RGB", (900, 300)).save(picture, "PNG")
    (tmp_path / "report.html").write_text(report_page(REPORT, picture.getvalue(), picture.getvalue()))
    failed, skipped = (Row(item=state, status=state, message="why " * 30) for state in ("failed", "skipped"))
    Writer(tmp_path).write([Row(item="egg", status="done", seconds=3), failed, skipped], 1.0)
    (tmp_path / "scores.html").write_text(render("scores.html", **SCORES))
    pages = [str(tmp_path / name) for name in ("report.html", "index.html", "scores.html", "viewer.html")]
    seen = run_node("pages.mjs", json.dumps({"pages": pages}))
    assert len(seen) == 4 * len(pages)
    embedded = {name: name.startswith("report") or None for name in seen}
    expected = {"violations": [], "wide": False, "mains": 1}
    assert seen == {name: expected | {"embedded": embedded[name]} for name in seen}


def test_the_page_is_small() -> None:
    assert len(build_viewer_page("", b"", None, None, None, {}).encode()) < PAGE_BYTES


def test_the_canvas_has_the_pixels_of_the_screen_that_the_window_is_on(tried: Try) -> None:
    before, sharp, after = tried(write_glb(egg()), deeds=[["screen", 2], ["screen", 1]]).said["sizes"]
    assert sharp == [2 * pixels for pixels in before] and after == before


def test_the_driving_video_follows_the_clock(tried: Try, tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    write_mp4(film, torch.linspace(0, 1, FRAMES)[:, None, None, None].expand(FRAMES, 32, 32, 3), FPS)
    deeds = [["wait", 0.5], ["press", "Home"], ["press", "ArrowRight"], ["press", "ArrowRight"], ["wait", 0.3]]
    page = tried(write_glb(egg()), None, film.read_bytes(), deeds=deeds)
    assert page.said["states"][-1]["frame"] == 2
    assert page.said["states"][-1]["modes"] == ["mesh", "wireframe"]
    assert page.said["video"] == pytest.approx(2 / FPS, abs=0.02)


def test_a_browser_that_cannot_draw_is_told_so(tried: Try) -> None:
    page = tried(write_glb(egg()), splats(), facts={"Licenses": "none"}, webgl2=False)
    assert "WebGL 2" in page.said["notice"]
    assert "Licenses" in page.said["facts"]


def test_the_page_is_what_its_sources_make(tmp_path: Path) -> None:
    if not (VIEWER / "node_modules").is_dir() or shutil.which("node") is None:
        pytest.skip("dg4d_lib/assets/viewer/node_modules is not here; `make clients` installs it")
    run_node("../../dg4d_lib/assets/viewer/build.mjs", str(tmp_path / "page.html"))
    assert (tmp_path / "page.html").read_bytes() == (VIEWER / "page.html").read_bytes()
