import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.mesh.models.model import to_linear, to_srgb
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import Texels, locate_texels
from dg4d_lib.mesh.texturing.delight import delight
from dg4d_lib.mesh.texturing.unwrap import unwrap

SIZE = 128


@pytest.fixture(scope="module")
def ball() -> tuple[TexturedMesh, Texels]:
    """A gray sphere, and its texels."""
    shape = trimesh.creation.icosphere(3)
    unwrapped = unwrap(shape.vertices.astype(np.float32), shape.faces.astype(np.int32), SIZE)
    sources, faces, uvs = map(torch.from_numpy, unwrapped)
    vertices = torch.from_numpy(shape.vertices.astype(np.float32))[sources]
    mesh = TexturedMesh(vertices, faces, uvs, torch.full((SIZE, SIZE, 3), 0.5))
    return mesh, locate_texels(vertices, vertices, faces, uvs, SIZE)


def painted(ball: tuple[TexturedMesh, Texels], albedo: np.ndarray, shading: np.ndarray) -> TexturedMesh:
    """The sphere with linear colors under a shading, both per texel."""
    mesh, texels = ball
    texture = mesh.texture.clone()
    colors = to_srgb((albedo * shading[:, None]).clip(0, 1))
    texture[texels.rows, texels.columns] = torch.from_numpy(colors).float()
    return TexturedMesh(mesh.vertices, mesh.faces, mesh.uvs, texture)


def shown(mesh: TexturedMesh, texels: Texels) -> np.ndarray:
    return to_linear(mesh.texture[texels.rows, texels.columns].double().numpy())


def test_the_light_goes_and_the_markings_stay(ball: tuple[TexturedMesh, Texels]) -> None:
    """A lamp from above on a red ball with dark spots of a quarter of its surface."""
    texels = ball[1]
    places = texels.positions.double().numpy()
    spots = np.prod(np.sin(9 * places), axis=1) > 0.15
    albedo = np.where(spots[:, None], 0.1, np.array([0.5, 0.2, 0.2]))
    lit = painted(ball, albedo, np.exp(0.5 * places[:, 1]))
    found = shown(delight(lit), texels) / albedo
    before = shown(lit, texels) / albedo
    assert np.std(np.log(before)) > 0.25
    assert np.std(np.log(found)) < 0.08


def test_a_texture_without_shading_stays(ball: tuple[TexturedMesh, Texels]) -> None:
    mesh = delight(ball[0])
    torch.testing.assert_close(mesh.texture, ball[0].texture, atol=1e-4, rtol=0)


def test_the_correction_is_bounded(ball: tuple[TexturedMesh, Texels]) -> None:
    texels = ball[1]
    lit = painted(ball, np.full((len(texels.rows), 3), 0.2), np.exp(1.5 * texels.positions[:, 2].double().numpy()))
    ratio = shown(delight(lit), texels) / shown(lit, texels)
    assert ratio.max() == pytest.approx(2, rel=0.01)
    assert ratio.min() > 0.49


def test_srgb_and_linear_are_inverse() -> None:
    values = np.linspace(0, 1, 101)
    np.testing.assert_allclose(to_srgb(to_linear(values)), values, atol=1e-12)
    assert to_linear(np.array(0.5)) == pytest.approx(0.214, abs=1e-3)
