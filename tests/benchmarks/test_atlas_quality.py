import pytest
import torch

from benchmarks.atlas_quality import atlas_quality
from dg4d_lib.mesh.textured import TexturedMesh
from tests.dg4d_lib.mesh.test_seams import SIZE, two_squares


def test_the_atlas_of_two_squares_is_measured() -> None:
    vertices, faces, uvs = two_squares()
    texture = torch.full((SIZE, SIZE, 3), 0.4)
    texture[:, SIZE // 2 :] = 0.6
    quality = atlas_quality(TexturedMesh(vertices, faces, uvs, texture))
    assert (quality.islands, quality.small_islands, quality.mirrored) == (2, 2, 0)
    assert quality.coverage == pytest.approx(2 * 0.4 * 0.6)
    assert quality.density_ratio == pytest.approx(1)
    assert quality.seam_mean == pytest.approx(0.2 * 255)
    mirrored = uvs.clone()
    mirrored[4:, 1] = 1 - mirrored[4:, 1]
    mirrored[4:] = 0.5 * mirrored[4:]
    quality = atlas_quality(TexturedMesh(vertices, faces, mirrored, texture))
    assert quality.mirrored == 0.5
    assert quality.density_ratio == pytest.approx(2)
