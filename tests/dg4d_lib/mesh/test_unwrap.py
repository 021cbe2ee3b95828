import subprocess
import sys

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from dg4d_lib.errors import DG4DError
from dg4d_lib.mesh.extraction.clean import drop_small_components
from dg4d_lib.mesh.texturing.chart_packing import THOROUGH, _Chart
from dg4d_lib.mesh.texturing.charts import find_charts
from dg4d_lib.mesh.texturing.smoothing import taubin_smooth
from dg4d_lib.mesh.texturing.unwrap import SMOOTHING, unwrap

Mesh = tuple[np.ndarray, np.ndarray]
SIZE = 256


def charts(faces: np.ndarray) -> np.ndarray:
    """Return the chart index of every face."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).T
    graph = coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(faces.max() + 1,) * 2)
    return connected_components(graph, directed=False)[1][faces[:, 0]]


def drawn(faces: np.ndarray, uvs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of triangles that contain each texel center, and the chart of the last one."""
    count, chart = np.zeros((SIZE, SIZE), int), np.full((SIZE, SIZE), -1)
    places, names = uvs.astype(np.float64) * SIZE - 0.5, charts(faces)
    for face, name in zip(faces, names, strict=True):
        corners = places[face]
        low, high = np.ceil(corners.min(0)).astype(int), np.floor(corners.max(0)).astype(int)
        columns, rows = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
        edges = np.stack([corners[1] - corners[0], corners[2] - corners[0]], 1)
        if columns.size == 0 or abs(np.linalg.det(edges)) < 1e-9:
            continue
        b, c = np.linalg.solve(edges, np.stack([columns.ravel() - corners[0, 0], rows.ravel() - corners[0, 1]]))
        inside = (b > 1e-4) & (c > 1e-4) & (b + c < 1 - 1e-4)
        count[rows.ravel()[inside], columns.ravel()[inside]] += 1
        chart[rows.ravel()[inside], columns.ravel()[inside]] = name
    return count, chart


@pytest.fixture(scope="module")
def torus() -> Mesh:
    mesh = trimesh.creation.torus(0.5, 0.2, major_sections=48, minor_sections=24)
    return mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)


@pytest.fixture(scope="module")
def flat(torus: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return unwrap(*torus, SIZE)


def test_every_triangle_stays_where_it_was(torus: Mesh, flat: tuple[np.ndarray, ...]) -> None:
    copied, faces, _ = flat
    np.testing.assert_array_equal(copied[faces], torus[1])


def test_places_lie_in_the_texture_and_fill_it(flat: tuple[np.ndarray, ...]) -> None:
    uvs = flat[2]
    assert uvs.min() >= 0
    assert uvs.max() <= 1
    assert (uvs.max(0) > 0.95).all(), "the charts reach from side to side"


def test_no_two_triangles_share_a_texel(flat: tuple[np.ndarray, ...]) -> None:
    count, _ = drawn(*flat[1:])
    assert count.max() == 1
    assert (count > 0).mean() > 0.5


def test_charts_keep_two_texels_apart(flat: tuple[np.ndarray, ...]) -> None:
    _, chart = drawn(*flat[1:])
    assert chart.max() > 0
    for rows, columns in ((1, 0), (0, 1), (1, 1), (1, -1)):
        other = np.roll(chart, (rows, columns), (0, 1))[1:-1, 1:-1]
        mine = chart[1:-1, 1:-1]
        assert not ((mine >= 0) & (other >= 0) & (mine != other)).any()


def test_the_same_mesh_is_unwrapped_the_same(torus: Mesh, flat: tuple[np.ndarray, ...]) -> None:
    for first, second in zip(flat, unwrap(*torus, SIZE), strict=True):
        assert first.tobytes() == second.tobytes()


def test_more_effort_covers_more_of_the_texture_and_overlaps_nothing(torus: Mesh, flat: tuple[np.ndarray, ...]) -> None:
    _, faces, uvs = unwrap(*torus, SIZE, effort=THOROUGH)
    areas = [-np.linalg.det(found[faces[:, 1:]] - found[faces[:, :1]]).sum() / 2 for found in (flat[2], uvs)]
    assert areas[1] >= areas[0] + 0.01
    assert (drawn(faces, uvs)[0] <= 1).all()


def test_a_chart_keeps_the_cells_of_one_scale_only() -> None:
    chart = _Chart(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]]), np.array([[0, 1, 2]]), 8, 1)
    small = list(chart.shapes(10.0, 2))
    assert len(small) == 4 and small[0] is next(chart.shapes(10.0, 1))
    large = list(chart.shapes(20.0, 1))
    assert set(chart.known.values()) == set(large) and len(large) == 8
    assert next(chart.shapes(10.0, 1)).height == small[0].height < large[0].height


def test_a_texture_without_room_is_refused(torus: Mesh) -> None:
    with pytest.raises(DG4DError, match=r"do not fit into a texture of 8 x 8 texels; raise mesh\.texture_size"):
        unwrap(*torus, 8)


def test_charts_are_shown_as_seen_from_outside(flat: tuple[np.ndarray, ...]) -> None:
    """Counter-clockwise on the picture, whose v runs down: no chart is mirrored."""
    _, faces, uvs = flat
    sides = uvs[faces[:, 1:]] - uvs[faces[:, :1]]
    assert (np.linalg.det(sides.astype(np.float64)) < 0).all()


@pytest.mark.parametrize("fewer", [1, 3])
def test_above_the_limit_charts_are_merged_down_to_it(
    torus: Mesh, flat: tuple[np.ndarray, ...], monkeypatch: pytest.MonkeyPatch, fewer: int
) -> None:
    count = int(charts(flat[1]).max()) + 1
    monkeypatch.setattr("dg4d_lib.mesh.texturing.charts.MANY", count)
    assert np.array_equal(unwrap(*torus, SIZE)[2], flat[2])
    monkeypatch.setattr("dg4d_lib.mesh.texturing.charts.MANY", count - fewer)
    sources, faces, uvs = unwrap(*torus, SIZE)
    assert charts(faces).max() + 1 == count - fewer
    np.testing.assert_array_equal(torus[0][sources][faces], torus[0][torus[1]])
    assert (drawn(faces, uvs)[0] <= 1).all()


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_the_texel_density_is_even(noise: float) -> None:
    mesh = trimesh.creation.icosphere(4)
    shift = noise * np.random.default_rng(0).normal(size=(len(mesh.vertices), 1))
    vertices = mesh.vertices * (1 + shift)
    sources, faces, uvs = unwrap(vertices.astype(np.float32), mesh.faces.astype(np.int32), SIZE)
    sides = vertices[sources][faces[:, 1:]] - vertices[sources][faces[:, :1]]
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    flat = np.abs(np.linalg.det((uvs[faces[:, 1:]] - uvs[faces[:, :1]]).astype(np.float64))) / 2
    lowest, highest = np.quantile(np.sqrt(flat / areas), (0.01, 0.99))
    assert highest < 2 * lowest


def test_loose_and_degenerate_triangles_get_charts_too() -> None:
    corners = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
    corners[3:6] = corners[3]  # a triangle without area
    faces = np.concatenate([np.arange(30).reshape(-1, 3), [[0, 1, 6], [0, 1, 9]]]).astype(np.int32)  # an edge of three
    sources, new, uvs = unwrap(corners, faces, SIZE)
    np.testing.assert_array_equal(sources[new], faces)
    assert np.isfinite(uvs).all()


def random_surface(seed: int) -> Mesh:
    """Closed surfaces of 8 to 300 faces."""
    random = np.random.default_rng(seed)
    side = int(random.integers(4, 9))
    field = gaussian_filter(random.standard_normal((side, side, side)), 0.8)
    vertices, faces, _, _ = marching_cubes(np.pad(field / field.std(), 1, constant_values=-5.0), 0.3)
    vertices, faces = drop_small_components(vertices, faces.astype(np.int64), 0.2)
    return vertices.astype(np.float32), faces


@pytest.mark.parametrize("seed", [*range(30, 40), 74, 94, 114, 155, 200, 283])
def test_random_surfaces_of_few_faces_fall_into_charts(seed: int) -> None:
    """Straightening swallows the chart with the highest number on nine of these."""
    vertices, faces = random_surface(seed)
    found = find_charts(vertices, faces, taubin_smooth(vertices, faces, SMOOTHING))
    np.testing.assert_array_equal(found.sources[found.faces], faces)
    assert np.isfinite(found.flat).all()
    sides = found.flat[found.faces[:, 1:]] - found.flat[found.faces[:, :1]]
    assert (np.linalg.det(sides) >= 0).all()


def test_smoothing_takes_noise_away_and_keeps_the_size(sphere: Mesh) -> None:
    vertices, faces = sphere
    noise = 0.01 * torch.randn(vertices.shape, generator=torch.Generator().manual_seed(0)).numpy()
    radii = np.linalg.norm(taubin_smooth(vertices + noise, faces, SMOOTHING), axis=1)
    assert radii.std() < 0.4 * np.linalg.norm(vertices + noise, axis=1).std()
    assert radii.mean() == pytest.approx(0.5, rel=0.01)


def test_xatlas_unwraps_in_a_process_of_its_own() -> None:
    code = """if True:
        import sys
        import numpy as np
        from dg4d_lib.mesh.texturing.unwrap import unwrap
        corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
        faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
        sources, new, uvs = unwrap(corners, faces, 64, "xatlas")
        assert (sources[new] == faces).all() and uvs.min() >= 0 and uvs.max() <= 1
        sys.exit("xatlas" in sys.modules)
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
