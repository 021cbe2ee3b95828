"""Images and the texture atlas."""

import numpy as np
import pytest
import torch

from dg4d_lib.assets.formats.materials import GUTTER, Atlas
from dg4d_lib.errors import BadInput


def noise(frames: int, height: int, width: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (frames, height, width, 3), generator=generator) / 255


@pytest.mark.parametrize(("frames", "height", "width"), [(1, 4, 4), (5, 6, 9), (14, 1, 1), (16, 3, 2)])
def test_textures_come_back_from_their_cells(frames: int, height: int, width: int) -> None:
    textures = noise(frames, height, width)
    atlas = Atlas.of(textures, 512)
    page = atlas.pack(textures)
    assert page.shape == (*atlas.size[::-1], 3)
    assert np.array_equal(atlas.unpack(page), (textures * 255).round().byte().numpy())


def test_a_cell_is_surrounded_by_its_own_border() -> None:
    textures = noise(4, 5, 5)
    page = Atlas.of(textures, 512).pack(textures)
    cell = (textures[3] * 255).round().byte().numpy()
    around = np.pad(cell, ((GUTTER, GUTTER), (GUTTER, GUTTER), (0, 0)), "edge")
    assert np.array_equal(page[-len(around) :, -len(around) :], around)


def test_an_offset_leads_from_the_first_cell_to_the_same_place_of_another() -> None:
    textures = noise(7, 6, 9)
    atlas = Atlas.of(textures, 512)
    page = atlas.pack(textures)
    pixels = np.array([[0.5, 0.5], [8.5, 0.5], [4.5, 3.5], [8.5, 5.5]])
    for frame, offset in enumerate(atlas.offsets()):
        x, y = ((atlas.to_atlas_uvs((pixels / (9, 6)).astype(np.float32)) + offset) * atlas.size).T.astype(int)
        expected = (textures[frame] * 255).round().byte().numpy()[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
        assert np.array_equal(page[y, x], expected)


def test_coordinates_come_back_from_the_first_cell() -> None:
    atlas = Atlas.of(noise(14, 100, 90), 4096)
    uvs = np.random.default_rng(0).random((50, 2)).astype(np.float32)
    np.testing.assert_allclose(atlas.from_atlas_uvs(atlas.to_atlas_uvs(uvs)), uvs, atol=1e-6)


def test_an_atlas_that_would_be_too_large_has_smaller_cells() -> None:
    textures = torch.full((9, 64, 64, 3), 0.25)
    atlas = Atlas.of(textures, 150)
    assert max(atlas.size) <= 150
    assert atlas.width == 34
    assert np.unique(atlas.unpack(atlas.pack(textures))).tolist() == [64]


def test_frames_that_do_not_fit_at_all_are_refused() -> None:
    with pytest.raises(BadInput, match="atlas_size"):
        Atlas.of(torch.zeros(100, 4, 4, 3), 64)
