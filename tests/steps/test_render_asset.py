"""Pictures of a package: right side, right moment, straight alpha, clear refusals."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from shutil import copytree, rmtree

import pytest
import torch
from small_package import BLUE, FPS, FRAMES, REACH, packed

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from steps.artifacts.media import read_png
from steps.artifacts.rendering import Renders, render_package

SIZE = 64


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("tracked"))


@pytest.fixture(scope="module")
def per_frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("per_frame"), "per_frame", splats=False)


def renders(folder: Path, out: Path, azimuths: tuple[float, ...] = (0.0,), **changes: object) -> Renders:
    wanted = {"elevation_deg": 0.0, "size": SIZE, "frames": None, "mesh": False, "rasterizer": "reference"} | changes
    return render_package(folder, azimuths, out=out, **wanted)  # type: ignore[arg-type]


def render(folder: Path, out: Path, azimuths: tuple[float, ...] = (0.0,), **changes: object) -> list[Path]:
    return renders(folder, out, azimuths, **changes).views


def pictures(view: Path) -> torch.Tensor:
    return torch.stack([read_png(path) for path in sorted(view.iterdir())])


def column(picture: torch.Tensor) -> float:
    """Center of the coverage, in pixels right of the middle."""
    weights = picture[..., 3].sum(0)
    return float((weights * (torch.arange(SIZE) - (SIZE - 1) / 2)).sum() / weights.sum())


def expected_column(azimuth_deg: float, share: float) -> float:
    camera = OrbitCamera(azimuth_deg=azimuth_deg, width=SIZE, height=SIZE)
    place = camera.viewmat() @ torch.tensor([REACH * share, 0, 0, 1], dtype=torch.float64)
    return camera.focal * float(place[0] / place[2])


def test_every_view_has_its_folder_and_every_frame_its_picture(package: Path, tmp_path: Path) -> None:
    views = render(package, tmp_path / "a/b", (-75.0, 15, 22.5, -0.0))
    assert [view.name for view in views] == ["view_-75", "view_15", "view_22.5", "view_0"]
    for view in views:
        assert [path.name for path in sorted(view.iterdir())] == [f"{i:03d}.png" for i in range(FRAMES)]
        assert pictures(view).shape == (FRAMES, SIZE, SIZE, 4)


def test_a_view_with_pictures_of_more_frames_is_refused_and_stays(package: Path, tmp_path: Path) -> None:
    render(package, tmp_path, (0.0, 90.0))
    before = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.png"))}
    with pytest.raises(BadInput, match=r"view_90 holds 1 picture beyond the 2 of this render; choose another folder"):
        render(package, tmp_path, (15.0, 90.0), frames=2)
    assert {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.png"))} == before


def test_other_files_of_a_view_do_not_matter(package: Path, tmp_path: Path) -> None:
    stay = [tmp_path / "view_0" / name for name in ("notes.txt", "04.png", "0007.png", "x007.png", "007.jpg")]
    stay.append(tmp_path / "view_90" / "007.png")  # of a view that is not written
    for path in stay:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (view,) = render(package, tmp_path, frames=2)
    assert all(path.exists() for path in stay)
    assert {"000.png", "001.png"} <= {path.name for path in view.iterdir()}


@pytest.mark.parametrize("mesh", [False, True])
@pytest.mark.parametrize("azimuth_deg", [0.0, 180.0, 40.0])
def test_the_object_is_where_the_motion_takes_it(package: Path, tmp_path: Path, mesh: bool, azimuth_deg: float) -> None:
    (view,) = render(package, tmp_path, (azimuth_deg,), mesh=mesh)
    seen = [column(picture) for picture in pictures(view)]
    assert seen == pytest.approx([expected_column(azimuth_deg, share) for share in (0, 0.5, 1)], abs=1)


@pytest.mark.parametrize("mesh", [False, True])
def test_color_is_straight_wherever_something_is(package: Path, tmp_path: Path, mesh: bool) -> None:
    (view,) = render(package, tmp_path, mesh=mesh)
    picture = pictures(view)[0]
    half_covered = (picture[..., 3] > 0.2) & (picture[..., 3] < 0.9)
    assert half_covered.any()
    for covered in (half_covered, picture[..., 3] > 0.9):
        torch.testing.assert_close(picture[..., :3][covered], BLUE.expand(int(covered.sum()), 3), atol=0.02, rtol=0)
    assert picture[0, 0].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("mesh", [False, True])
def test_other_numbers_of_frames_are_spread_from_first_to_last(package: Path, tmp_path: Path, mesh: bool) -> None:
    (view,) = render(package, tmp_path, frames=5, mesh=mesh)
    seen = [column(picture) for picture in pictures(view)]
    assert seen == pytest.approx([expected_column(0, share) for share in (0, 0.25, 0.5, 0.75, 1)], abs=0.5)


@pytest.mark.parametrize("mesh", [False, True])
def test_frames_of_another_rate_are_spread_over_the_fit(tmp_path: Path, mesh: bool) -> None:
    """The last states of a resampled package lead back to its first frame."""
    (view,) = render(packed(tmp_path, fps=4 * FPS), tmp_path / "views", frames=FRAMES, mesh=mesh)
    seen = [column(picture) for picture in pictures(view)]
    assert seen == pytest.approx([expected_column(0, share) for share in (0, 0.5, 1)], abs=0.5)


def test_one_frame_is_the_first(package: Path, tmp_path: Path) -> None:
    (view,) = render(package, tmp_path, frames=1)
    (picture,) = pictures(view)
    assert column(picture) == pytest.approx(0, abs=0.1)


def test_elevation_looks_from_above(package: Path, tmp_path: Path) -> None:
    """The eight small balls lie in two planes; from above the upper one is nearer, so it is seen lower and larger."""
    (level,), (above,) = render(package, tmp_path / "0"), render(package, tmp_path / "1", elevation_deg=40.0)
    assert (pictures(level)[0] - pictures(above)[0]).abs().max() > 0.3
    upside_down = pictures(above)[0].flip(0)
    assert (pictures(level)[0] - pictures(level)[0].flip(0)).abs().max() < 0.02
    assert (pictures(above)[0] - upside_down).abs().max() > 0.05


def enlarged(package: Path, folder: Path, whole_fov_y_deg: float | None) -> Path:
    """Copy a package as if its fit were 2.5 times as large."""
    manifest = json.loads((copytree(package, folder) / "asset.json").read_text())
    manifest["placement"]["scale"] = 0.4
    manifest["camera"]["whole_fov_y_deg"] = whole_fov_y_deg
    (folder / "asset.json").write_text(json.dumps(manifest))
    return folder


@pytest.mark.parametrize("mesh", [False, True])
def test_cropped_pictures_are_counted_and_the_whole_field_of_view_holds_the_asset(
    package: Path, tmp_path: Path, mesh: bool
) -> None:
    large = enlarged(package, tmp_path / "large", whole_fov_y_deg=120.0)
    assert renders(package, tmp_path / "0", (0.0, 90.0), mesh=mesh).cropped == 0
    assert 0 < renders(large, tmp_path / "1", (0.0, 180.0), mesh=mesh).cropped < 2 * FRAMES
    assert renders(large, tmp_path / "2", (0.0, 180.0), mesh=mesh, fit=True).cropped == 0


def test_a_package_that_does_not_know_its_extent_is_not_fitted(package: Path, tmp_path: Path) -> None:
    older = enlarged(package, tmp_path / "older", whole_fov_y_deg=None)
    with pytest.raises(BadInput, match="older dg4d made it"):
        render(older, tmp_path / "out", fit=True)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("angle", [0.0, -5.0, 180.0, float("nan")])
def test_a_field_of_view_out_of_range_is_refused(package: Path, tmp_path: Path, angle: float) -> None:
    with pytest.raises(BadInput, match=r"camera.whole_fov_y_deg: Input should be"):
        render(enlarged(package, tmp_path / "bent", whole_fov_y_deg=angle), tmp_path / "out", fit=True)


def test_a_pipe_in_place_of_the_mesh_is_refused(package: Path, tmp_path: Path) -> None:
    piped = copytree(package, tmp_path / "piped")
    (piped / "asset.glb").unlink()
    os.mkfifo(piped / "asset.glb")
    with pytest.raises(BadInput, match=r"asset.glb cannot be read \(not a regular file\)"):
        render(piped, tmp_path / "out", mesh=True)


def test_without_splats_the_fitted_motion_is_drawn(package: Path, tmp_path: Path) -> None:
    bare = copytree(package, tmp_path / "bare")
    rmtree(bare / "splats")
    (with_splats,) = render(package, tmp_path / "0", frames=4)
    (without,) = render(bare, tmp_path / "1", frames=4)
    torch.testing.assert_close(pictures(with_splats), pictures(without), atol=1.5 / 255, rtol=0)


def test_meshes_per_frame_are_shown_one_after_the_other(per_frame: Path, tmp_path: Path) -> None:
    (view,) = render(per_frame, tmp_path, mesh=True, frames=5)
    areas = [float(picture[..., 3].sum()) for picture in pictures(view)]
    assert areas[0] == areas[1] < areas[2] == areas[3] < areas[4]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"azimuths": ()}, "azimuths"),
        ({"azimuths": (float("nan"),)}, "azimuths"),
        ({"elevation_deg": 91.0}, "elevation"),
        ({"size": 8}, "size"),
        ({"size": 5000}, "size"),
        ({"frames": 0}, "at least one frame"),
        ({"rasterizer": "none"}, "unknown rasterizer"),
    ],
)
def test_numbers_out_of_range_are_refused(package: Path, tmp_path: Path, changes: dict[str, object], says: str) -> None:
    with pytest.raises(BadInput, match=says):
        render(package, tmp_path / "out", **changes)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def without(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


@pytest.mark.parametrize(
    ("damage", "mesh", "says"),
    [
        (without("asset.json"), False, "is not an asset"),
        (lambda folder: (folder / "asset.json").write_text("{"), False, "cannot be used"),
        (without("splats/002.ply"), False, "2 frames, the package 3"),
        (without("asset.glb"), True, r"asset\.glb cannot be read"),
        (lambda folder: (folder / "asset.glb").write_bytes(b"glTF"), True, "GLB is corrupt"),
    ],
)
def test_a_damaged_package_is_refused(
    package: Path, tmp_path: Path, damage: Callable[[Path], None], mesh: bool, says: str
) -> None:
    broken = copytree(package, tmp_path / "broken")
    damage(broken)
    with pytest.raises(BadInput, match=says):
        render(broken, tmp_path / "out", mesh=mesh)


def test_a_folder_that_is_no_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="is not an asset"):
        render(tmp_path / "nowhere", tmp_path / "out")
