"""Scenes of whole packages, and their films."""

from pathlib import Path

import av
import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom
from small_package import FPS, FRAMES, REACH, gem, packed, tracked

from dg4d_lib.assets.animated import Asset4D, interpolate_frames
from dg4d_lib.assets.formats.usd import write_usdz
from dg4d_lib.assets.scenes.compose import AnimatedGlb
from dg4d_lib.assets.scenes.scene import Scene, SceneItem
from dg4d_lib.errors import BadInput
from steps.compose_scene import SceneWriter, _MovingGaussians

SECONDS = FRAMES / FPS


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = packed(tmp_path_factory.mktemp("package"))
    write_usdz(folder / "asset.usdz", tracked(), FPS)
    return folder


def cast_of(package: Path, *items: SceneItem) -> SceneWriter:
    return SceneWriter([package] * len(items), items, [item.name for item in items])


def item(name: str, **where: object) -> SceneItem:
    return SceneItem(package="p", name=name, **where)


def resampled(times: int) -> Asset4D:
    """Return the asset with so many keys per frame, also on the way back to the first frame."""
    asset = tracked()
    offsets = interpolate_frames(asset.offsets, torch.arange(times * FRAMES, dtype=torch.float64) / times)
    return Asset4D(asset.mesh, offsets, times * FPS)


def pictures(film: Path) -> np.ndarray:
    with av.open(str(film)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def blue(picture: np.ndarray) -> np.ndarray:
    """Columns in which the blue cloud is seen."""
    return np.flatnonzero((picture[..., 2].astype(int) - picture[..., 0] > 60).any(0))


def test_a_glb_holds_every_asset_where_it_was_put(package: Path, tmp_path: Path) -> None:
    cast = cast_of(package, item("left", position=(-1, 0, 0)), item("right", position=(1, 0, 0), scale=2))
    assert cast.write_glb(tmp_path / "scene.glb", None) == ()
    scene = AnimatedGlb((tmp_path / "scene.glb").read_bytes())
    width = REACH + 2 * tracked().mesh.vertices[:, 0].max().item()
    np.testing.assert_allclose((scene.box_min[0], scene.box_max[0]), (-1 - width / 2, 1 + width), atol=1e-5)
    assert scene.box_min[1] == pytest.approx(0, abs=1e-6)


def test_a_usdz_agrees_with_the_glb(package: Path, tmp_path: Path) -> None:
    cast = cast_of(
        package, item("turned", position=(1, 2, 3), rotation_deg=(20, 60, 0), scale=1.5, start_s=0.5, speed=0.5)
    )
    cast.write_glb(tmp_path / "scene.glb", None)
    cast.write_usdz(tmp_path / "scene.usdz", None)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdz"))
    (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    for seconds, frame in ((0.2, 0), (0.5 + 1 / (0.5 * FPS), 1)):
        time = seconds * stage.GetTimeCodesPerSecond()
        matrix = np.array(mesh.ComputeLocalToWorldTransform(time))
        points = np.array(mesh.GetPointsAttr().Get(time)) @ matrix[:3, :3] + matrix[3, :3]
        asset, transform = tracked(), cast.actors[0].transform
        given = (asset.mesh.vertices + asset.offsets[frame]).numpy() @ transform[:3, :3].T + transform[:3, 3]
        np.testing.assert_allclose(sorted(points[:, 1]), sorted(given[:, 1]), atol=1e-5)


@pytest.mark.parametrize("duration_s", [1.0, 6.0])
def test_a_usdz_lasts_as_long_as_the_scene(duration_s: float, package: Path, tmp_path: Path) -> None:
    cast = cast_of(package, item("slow", speed=SECONDS / 2, loop=False))  # plays for 2 seconds
    cast.write_usdz(tmp_path / "scene.usdz", duration_s)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdz"))
    assert stage.GetEndTimeCode() / stage.GetTimeCodesPerSecond() == pytest.approx(duration_s)


def test_an_asset_that_plays_once_stands_in_its_last_pose(package: Path, tmp_path: Path) -> None:
    fine = packed(tmp_path / "fine", fps=4 * FPS)  # its files have keys on the way back to the first frame
    write_usdz(fine / "asset.usdz", resampled(4), 4 * FPS)
    for folder in (package, fine):
        cast = cast_of(folder, item("once", loop=False), item("again"))
        once, again = cast.actors
        cast.write_usdz(folder / "scene.usdz", 2.0)
        stage = Usd.Stage.Open(str(folder / "scene.usdz"))
        for actor, reach in ((once, REACH), (again, 0.0)):
            mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/scene/{actor.name}/mesh/subject"))
            points = np.array(mesh.GetPointsAttr().Get(2.0 * stage.GetTimeCodesPerSecond()))
            assert points[:, 0].mean() - reach == pytest.approx(gem().vertices[:, 0].mean().item(), abs=1e-6)
        states = _MovingGaussians(folder).at(once, torch.tensor([0.0, 2.0], dtype=torch.float64))
        assert (states.means[1] - states.means[0])[:, 0].numpy() == pytest.approx(REACH, abs=1e-5)


def test_a_usdz_says_what_would_loop_in_a_glb(package: Path, tmp_path: Path) -> None:
    cast = cast_of(package, item("again"), item("once", loop=False))
    (note,) = cast.write_usdz(tmp_path / "scene.usdz", 3 * SECONDS)
    assert "again" in note
    assert "once," not in note


def test_a_package_without_usdz_is_named(package: Path, tmp_path: Path) -> None:
    folder = packed(tmp_path / "older")
    (folder / "asset.usdz").unlink(missing_ok=True)
    with pytest.raises(BadInput, match=r"has no asset\.usdz"):
        SceneWriter([folder], [item("a")], ["a"]).write_usdz(tmp_path / "scene.usdz", None)


def test_a_film_shows_every_asset(package: Path, tmp_path: Path) -> None:
    cast = cast_of(package, item("a"), item("b"), item("c"))
    cast.in_a_row(1.0)
    cast.write_preview(tmp_path / "scene.mp4", Scene(items=(item("a"),), fps=12, duration_s=0.5), "reference")
    film = pictures(tmp_path / "scene.mp4")
    assert len(film) == 6
    groups = np.split(blue(film[0]), np.flatnonzero(np.diff(blue(film[0])) > 1) + 1)
    assert len(groups) == 3


def test_a_film_waits_for_an_asset_to_start(package: Path, tmp_path: Path) -> None:
    cast = cast_of(package, item("late", start_s=0.5, loop=False))
    plan = Scene(items=(item("late"),), fps=FPS, duration_s=0.5 + SECONDS)
    cast.write_preview(tmp_path / "scene.mp4", plan, "reference")
    film = pictures(tmp_path / "scene.mp4")
    middles = [blue(picture).mean() for picture in film]
    assert abs(middles[6] - middles[0]) < 6 < abs(middles[-1] - middles[6])  # pixels; the camera swings a little


def test_a_film_does_not_depend_on_how_often_the_package_has_the_motion(package: Path, tmp_path: Path) -> None:
    films = []
    for folder in (package, packed(tmp_path / "fine", fps=4 * FPS)):
        film, scene = tmp_path / f"{len(films)}.mp4", Scene(items=(item("a"),), fps=2 * FPS, duration_s=SECONDS)
        cast_of(folder, *scene.items).write_preview(film, scene, "reference")
        films.append([blue(picture).mean() for picture in pictures(film)])
    assert np.ptp(films[0]) > 6  # pixels; it moves
    np.testing.assert_allclose(*films, atol=1)


def test_a_film_has_an_end(package: Path, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="1 to 300 frames"):
        cast_of(package, item("a")).write_preview(
            tmp_path / "scene.mp4", Scene(items=(item("a"),), fps=100, duration_s=600), "reference"
        )


def test_a_broken_asset_is_named(tmp_path: Path) -> None:
    folder = packed(tmp_path)
    (folder / "asset.glb").write_bytes(b"no GLB")
    with pytest.raises(BadInput, match=r"asset\.glb: this is not a GLB"):
        SceneWriter([folder], [item("a")], ["a"])
