import torch
import trimesh

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface
from dg4d_lib.mesh.extraction.silhouettes import cameras_of, render_silhouettes, silhouette_iou
from dg4d_lib.mesh.tracking.nonrigid_registration import MIN_IOU, register_nonrigid
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import MeshSettings

SETTINGS = MeshSettings(grid=48)
LEVEL = 0.5


def ball(stretch: tuple[float, float, float]) -> Gaussians:
    """Opaque Gaussians in a ball of radius 0.4 that is stretched along the axes."""
    places = torch.nn.functional.normalize(torch.randn(2500, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    radii = 0.36 * torch.rand(2500, 1, generator=torch.Generator().manual_seed(1)) ** (1 / 3)
    return isotropic(places * radii * torch.tensor(stretch), torch.full((2500,), 0.04), torch.full((2500, 3), 0.5), 0.9)


def test_vertices_that_were_left_behind_come_to_the_outlines_and_others_stay():
    rest, stretched = ball((1, 1, 1)), ball((1.9, 0.6, 1))
    both = {name: torch.stack([getattr(rest, name), getattr(stretched, name)]) for name in ("means", "quats")}
    states = Gaussians(
        log_scales=torch.stack([rest.log_scales] * 2),
        opacity_logits=rest.opacity_logits,
        harmonics=rest.harmonics,
        **both,
    )
    rasterize = get_rasterizer("cpu")
    vertices, faces = (torch.from_numpy(a) for a in extract_surface(density_field(rest, SETTINGS), LEVEL))
    nothing = torch.zeros(2, len(vertices), 3)
    outlines = render_silhouettes(states, [0, 1], rasterize)
    offsets = register_nonrigid(vertices, nothing, faces, states, outlines, LEVEL, SETTINGS)
    before, after = (silhouette_iou(vertices + offset, faces, outlines) for offset in (nothing, offsets))
    assert before[0] > MIN_IOU > before[1]
    assert torch.equal(offsets[0], nothing[0])
    assert before[1] < 0.65
    assert after[1] > 0.93
    moved = trimesh.Trimesh((vertices + offsets[1]).numpy(), faces.numpy(), process=False)
    aim = trimesh.Trimesh(*extract_surface(density_field(stretched, SETTINGS), LEVEL), process=False)
    assert moved.is_watertight
    assert abs(moved.extents / aim.extents - 1).max() < 0.1


def test_a_mesh_agrees_with_itself_outside_of_the_picture():
    mesh = trimesh.creation.icosphere(2, 0.3)
    faces = torch.from_numpy(mesh.faces.astype("int32"))
    vertices = torch.from_numpy(mesh.vertices).float() + torch.tensor([[[0.0, 0, 0]], [[9.0, 0, 0]]])
    views = [rasterize_mesh(vertices, faces, cameras).faces >= 0 for cameras in cameras_of(2)]
    assert views[0][0].any() and not views[0][1].any()
    assert silhouette_iou(vertices, faces, torch.stack(views, 1)).tolist() == [1, 1]
