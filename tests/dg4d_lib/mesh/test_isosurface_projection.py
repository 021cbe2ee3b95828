import torch
import trimesh

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface
from dg4d_lib.mesh.tracking.isosurface_projection import project_to_isosurface
from dg4d_lib.settings import MeshSettings

SETTINGS = MeshSettings(grid=48)
LEVEL = 0.5


def ball(scale: float) -> Gaussians:
    """Gaussians in a ball of radius 0.5, blown up by a factor."""
    places = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    radii = 0.45 * torch.rand(2000, 1, generator=torch.Generator().manual_seed(1)) ** (1 / 3)
    return isotropic(places * radii * scale, torch.full((2000,), 0.05 * scale), torch.full((2000, 3), 0.5), 0.9)


def test_vertices_that_stayed_behind_reach_the_surface_of_their_moment():
    rest, grown = ball(1.0), ball(1.06)
    states = Gaussians(
        torch.stack([rest.means, grown.means]),
        torch.stack([rest.log_scales, grown.log_scales]),
        torch.stack([rest.quats, grown.quats]),
        rest.opacity_logits,
        rest.harmonics,
    )
    vertices, faces = (torch.from_numpy(a) for a in extract_surface(density_field(rest, SETTINGS), LEVEL))
    nothing = torch.zeros(2, len(vertices), 3)
    snapped = vertices + project_to_isosurface(vertices, nothing, faces, states, LEVEL, SETTINGS)
    assert (snapped[0] - vertices).norm(dim=-1).max() < 0.02  # it was on the surface, and is drawn in a little
    grown_by = snapped[1].norm(dim=-1).mean() / snapped[0].norm(dim=-1).mean()
    assert abs(grown_by - 1.06) < 0.01
    assert trimesh.Trimesh(snapped[1].numpy(), faces.numpy(), process=False).is_watertight


def test_a_vertex_without_a_surface_near_stays():
    cloud = ball(1.0)
    states = Gaussians(
        cloud.means[None] + 5, cloud.log_scales[None], cloud.quats[None], cloud.opacity_logits, cloud.harmonics
    )
    vertices, faces = (torch.from_numpy(a) for a in extract_surface(density_field(cloud, SETTINGS), LEVEL))
    nothing = torch.zeros(1, len(vertices), 3)
    assert torch.equal(project_to_isosurface(vertices, nothing, faces, states, LEVEL, SETTINGS), nothing)
