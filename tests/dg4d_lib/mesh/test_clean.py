import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from skimage.measure import marching_cubes

from dg4d_lib.errors import BackendUnavailable, BadInput, DG4DError
from dg4d_lib.mesh.extraction.clean import clean, drop_small_components
from dg4d_lib.mesh.extraction.topology import check_topology
from dg4d_lib.settings import MeshSettings

COARSE = MeshSettings(edge_length=0.08)
Mesh = tuple[np.ndarray, np.ndarray]


def both(a: Mesh, b: Mesh) -> Mesh:
    return np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1] + len(a[0])])


def test_a_sphere_comes_back_closed_even_and_as_large(sphere: Mesh) -> None:
    mesh = trimesh.Trimesh(*clean(*sphere, COARSE), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.5**3, rel=0.03)
    assert np.median(mesh.edges_unique_length) == pytest.approx(0.08, rel=0.2)
    assert mesh.edges_unique_length.max() < 3 * mesh.edges_unique_length.min()


def test_the_same_mesh_gives_the_same_bytes(sphere: Mesh) -> None:
    first, second = clean(*sphere, COARSE), clean(*sphere, COARSE)
    assert first[0].tobytes() == second[0].tobytes()
    assert first[1].tobytes() == second[1].tobytes()


def test_the_edge_length_is_in_units_of_the_box(sphere: Mesh) -> None:
    vertices, faces = clean(10 * sphere[0], sphere[1], COARSE, unit=10.0)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert np.median(mesh.edges_unique_length) == pytest.approx(0.8, rel=0.2)


def test_there_are_no_more_faces_than_allowed(sphere: Mesh) -> None:
    _, faces = clean(*sphere, MeshSettings(edge_length=0.02, max_faces=500))
    assert 350 < len(faces) <= 500


def test_the_longest_edges_keep_a_sphere_and_longer_ones_are_refused(sphere: Mesh) -> None:
    longest = MeshSettings.model_json_schema()["properties"]["edge_length"]["maximum"]
    vertices, _ = clean(*sphere, MeshSettings(edge_length=longest))
    assert (np.ptp(vertices, axis=0) >= 0.8 * np.ptp(sphere[0], axis=0)).all()
    with pytest.raises(DG4DError, match=r"shrank the surface to .*; lower mesh\.edge_length"):
        clean(*sphere, MeshSettings.model_construct(**dict(MeshSettings()) | {"edge_length": 0.45}))


def test_a_small_sphere_that_collapses_is_refused(sphere: Mesh) -> None:
    with pytest.raises(DG4DError, match=r"shrank the surface to [\d.]+% of its size, at least 50% is allowed"):
        clean(0.2 * sphere[0], sphere[1], MeshSettings(edge_length=0.3))


def test_a_far_speck_that_is_dropped_after_remeshing_is_no_collapse() -> None:
    """It has 6 % of the faces before remeshing and 1 % afterwards."""
    speck = trimesh.creation.icosphere(2, 0.025).apply_translation([0.9, 0, 0])
    ball = trimesh.creation.icosphere(4, 0.25).apply_translation([-0.7, 0, 0])
    far = both(*((one.vertices, one.faces.astype(np.int32)) for one in (ball, speck)))
    vertices, _ = clean(*far, MeshSettings(edge_length=0.04))
    assert vertices[:, 0].max() < 0 and np.ptp(vertices, axis=0).min() > 0.48


def test_sheets_that_almost_touch_stay_apart() -> None:
    """Merging the ends of their edges would leave an edge of four triangles."""
    box = trimesh.creation.box(bounds=[[-0.5, -0.5, -0.5], [0, 0, 0.5]])
    other = trimesh.creation.box(bounds=[[5e-5, 5e-5, -0.5], [0.5, 0.5, 0.5]])
    cleaned = clean(*both(*((one.vertices, one.faces.astype(np.int32)) for one in (box, other))), COARSE)
    assert check_topology(*cleaned).valid and check_topology(*cleaned).components == 2


def test_handles_do_not_stand_in_the_way_of_the_limit() -> None:
    """A sponge of more than a hundred handles, each of which needs some triangles, and too few of them."""
    axis = np.linspace(-1, 1, 40)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    sponge = np.maximum(np.abs(x), np.maximum(np.abs(y), np.abs(z))) < 0.9
    waves = np.cos(12 * x) + np.cos(12 * y) + np.cos(12 * z) + 0.5
    vertices, faces, _, _ = marching_cubes(np.where(sponge, waves, -1.0), 0.0)
    mesh = trimesh.Trimesh(vertices / 20 - 1, faces[:, ::-1])
    assert mesh.euler_number < -200
    cleaned = clean(mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32), MeshSettings(max_faces=400))
    assert 100 < len(cleaned[1]) <= 400
    assert check_topology(*cleaned).watertight


def test_what_is_inside_out_is_turned(sphere: Mesh) -> None:
    inverted = sphere[0] + 1.5, sphere[1][:, ::-1]
    cleaned = clean(*both(sphere, inverted), COARSE)
    facts = check_topology(*cleaned)
    assert (facts.components, facts.inverted_components, facts.watertight) == (2, 0, True)


def test_specks_go_and_a_hole_is_closed(sphere: Mesh) -> None:
    speck = 0.02 * sphere[0][:4] + 0.9, np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    holed = sphere[0], sphere[1][20:]
    mesh = trimesh.Trimesh(*clean(*both(holed, speck), COARSE), process=False)
    assert mesh.body_count == 1
    assert mesh.is_watertight


def test_the_largest_piece_stays_however_small_its_share(sphere: Mesh) -> None:
    small, far = 0.1 * sphere[0], 0.1 * sphere[0] + 1
    smaller = far, sphere[1][:-1]
    kept = drop_small_components(*both((small, sphere[1]), smaller), share=0.9)
    np.testing.assert_array_equal(kept[0][kept[1]], small[sphere[1]])


def test_a_mesh_without_faces_is_refused(sphere: Mesh) -> None:
    with pytest.raises(BadInput, match=r"mesh\.density_threshold"):
        clean(sphere[0], sphere[1][:0], COARSE)


def test_pymeshlab_stays_out_of_the_calling_process() -> None:
    code = """if True:
        import sys
        import trimesh
        from dg4d_lib.mesh.extraction.clean import clean
        from dg4d_lib.settings import MeshSettings
        ball = trimesh.creation.icosphere(3)
        clean(ball.vertices.astype("f4"), ball.faces.astype("i4"), MeshSettings(edge_length=0.2))
        sys.exit("pymeshlab" in sys.modules or "torch" in sys.modules)
    """
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.fixture
def fake_pymeshlab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that the child imports in place of the real library."""
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    return tmp_path / "pymeshlab.py"


def test_missing_filters_name_the_system_libraries(sphere: Mesh, fake_pymeshlab: Path) -> None:
    fake_pymeshlab.write_text("def filter_list(): return ['meshing_close_holes']")
    with pytest.raises(BackendUnavailable, match=r"lacks the filter .* and 11 other required ones.*libgl1 libopengl0"):
        clean(*sphere, COARSE)


def test_a_library_that_cannot_be_imported_is_named(sphere: Mesh, fake_pymeshlab: Path) -> None:
    fake_pymeshlab.write_text("raise ImportError('libGL.so.1: cannot open shared object file')")
    with pytest.raises(BackendUnavailable, match=r"libGL\.so\.1.*apt-get install libgl1 libopengl0"):
        clean(*sphere, COARSE)


def test_a_child_that_crashes_says_how(sphere: Mesh, fake_pymeshlab: Path) -> None:
    fake_pymeshlab.write_text("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    with pytest.raises(DG4DError, match=r"SIGSEGV.*run it again"):
        clean(*sphere, COARSE)


def test_a_child_that_fails_passes_its_last_words_on(sphere: Mesh, fake_pymeshlab: Path) -> None:
    fake_pymeshlab.write_text("raise RuntimeError('the disk is on fire')")
    with pytest.raises(DG4DError, match=r"status 1.*the disk is on fire"):
        clean(*sphere, COARSE)
