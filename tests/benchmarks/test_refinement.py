from pathlib import Path

import pytest
import torch
from tiny_svd import save_tiny_svd
from tiny_weights import write_zero123

from benchmarks.refinement import measure_textures, run_refinement, variants
from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.refiner_settings import TextureSettings
from dg4d_lib.video.driving import DrivingVideo

FRAMES = 3
TEXTURE = TextureSettings(iterations=1, size=64, frame_size=8)


def board() -> tuple[Asset4D, DrivingVideo]:
    corners = torch.tensor([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = torch.tensor([[0, 3, 2], [0, 2, 1]], dtype=torch.int32)
    mesh = TexturedMesh(corners, faces, uvs, torch.full((16, 16, 3), 0.5))
    red = torch.tensor([0.9, 0.1, 0.1]).expand(FRAMES, 64, 64, 3)
    return Asset4D(mesh, torch.zeros(FRAMES, 4, 3), 8.0), DrivingVideo(red, torch.ones(FRAMES, 64, 64, 1), 8.0)


@pytest.mark.slow
def test_every_variant_runs_and_gives_a_texture_per_frame(tmp_path: Path) -> None:
    asset, video = board()
    svd, zero123 = save_tiny_svd(tmp_path / "svd"), write_zero123(tmp_path / "zero123")
    chosen = variants(TEXTURE, str(svd), str(zero123))
    assert "video to video, 0.3 to 0.05" in chosen
    for name in (next(iter(chosen)), "video to video, 0.3 to 0.05", "image to image"):
        after = run_refinement(asset, video, chosen[name], 0)
        assert after.textures is not None and after.textures.shape == (FRAMES, 8, 8, 3)


def test_missing_weights_are_named_with_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path))
    with pytest.raises(BackendUnavailable, match="dg4d weights pull svd"):
        run_refinement(*board(), next(iter(variants(TEXTURE, "svd", "zero123-xl").values())), 0)


def test_flicker_is_the_mean_change_of_what_was_refined() -> None:
    before = torch.full((8, 8, 3), 0.5)
    textures = before.repeat(4, 1, 1, 1)
    textures[:, :4] += 0.1  # refined, and still
    assert measure_textures("still", before, textures).flicker == 0
    textures[1::2, :4] += 10 / 255
    assert measure_textures("flickering", before, textures).flicker == pytest.approx(10.0, rel=1e-4)


def test_sharpness_counts_in_units_of_what_it_was() -> None:
    before = 0.5 + 0.05 * torch.eye(8)[..., None].expand(8, 8, 3)
    textures = (0.5 + 3 * (before - 0.5)).repeat(2, 1, 1, 1)
    assert measure_textures("sharper", before, textures).sharpness == pytest.approx(3.0)
