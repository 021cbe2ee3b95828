from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.textured import TexturedMesh, TrackedMesh
from steps.artifacts.meshes import read_meshes, read_tracked, write_meshes, write_tracked


def some_mesh(seed: int = 0) -> TexturedMesh:
    generator = torch.Generator().manual_seed(seed)
    texture = torch.randint(0, 256, (8, 8, 3), generator=generator) / 255
    return TexturedMesh(
        torch.randn(5, 3, generator=generator),
        torch.randint(0, 5, (4, 3), generator=generator, dtype=torch.int32),
        torch.rand(5, 2, generator=generator),
        texture,
    )


def assert_same(first: TexturedMesh, second: TexturedMesh) -> None:
    for name, value in vars(first).items():
        assert value is vars(second)[name] or torch.equal(value, vars(second)[name]), name


def test_a_tracked_mesh_comes_back_as_it_was(tmp_path: Path) -> None:
    asset = TrackedMesh(some_mesh(), torch.randn(3, 5, 3), reference_frame=2)
    write_tracked(tmp_path / "a.safetensors", asset)
    back = read_tracked(tmp_path / "a.safetensors")
    assert_same(back.mesh, asset.mesh)
    assert torch.equal(back.offsets, asset.offsets)
    assert (back.textures, back.reference_frame) == (None, 2)


def test_smoothing_groups_come_back(tmp_path: Path) -> None:
    mesh = replace(some_mesh(), smoothing_groups=torch.arange(5, dtype=torch.int32))
    write_tracked(tmp_path / "a", TrackedMesh(mesh, torch.zeros(2, 5, 3)))
    assert_same(read_tracked(tmp_path / "a").mesh, mesh)


def test_a_texture_per_frame_comes_back_in_eight_bits(tmp_path: Path) -> None:
    textures = torch.stack([some_mesh(seed).texture for seed in range(3)])
    write_tracked(tmp_path / "a", TrackedMesh(some_mesh(), torch.randn(3, 5, 3), textures))
    back = read_tracked(tmp_path / "a").textures
    assert back is not None and torch.equal(back, textures)
    assert (tmp_path / "a").stat().st_size < 4 * textures.numel()  # a byte per number


def test_equal_meshes_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_tracked(tmp_path / name, TrackedMesh(some_mesh(), torch.zeros(2, 5, 3)))
        write_meshes(tmp_path / f"{name}.zip", {0: some_mesh(), 1: some_mesh(1)})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_a_mesh_per_frame_comes_back_in_the_order_of_the_frames(tmp_path: Path) -> None:
    write_meshes(tmp_path / "m.zip", {11: some_mesh(11), 9: some_mesh(9), 10: some_mesh(10)})
    for seed, mesh in zip((9, 10, 11), read_meshes(tmp_path / "m.zip"), strict=True):
        assert_same(mesh, some_mesh(seed))


def test_a_gap_between_the_frames_is_refused(tmp_path: Path) -> None:
    write_meshes(tmp_path / "m.zip", {0: some_mesh(), 2: some_mesh()})
    with pytest.raises(BadInput, match=r"every frame.*\[0, 2\]"):
        read_meshes(tmp_path / "m.zip")


@pytest.mark.parametrize("content", [b"", b"PK\x05\x06" + bytes(18), b"nonsense" * 9])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    with pytest.raises(BadInput, match="tracked"):
        read_tracked(path)
    with pytest.raises(BadInput, match="mesh"):
        read_meshes(path)


def test_a_single_mesh_is_no_tracked_mesh(tmp_path: Path) -> None:
    from safetensors.torch import save_file

    mesh = some_mesh()
    save_file({name: value.contiguous() for name, value in vars(mesh).items() if value is not None}, tmp_path / "m")
    with pytest.raises(BadInput, match="not a tracked mesh"):
        read_tracked(tmp_path / "m")


def test_colors_outside_of_the_range_are_clipped(tmp_path: Path) -> None:
    bright = replace(some_mesh(), texture=torch.full((2, 2, 3), 1.5))
    write_tracked(tmp_path / "a", TrackedMesh(bright, torch.zeros(1, 5, 3)))
    assert (read_tracked(tmp_path / "a").mesh.texture == 1).all()
