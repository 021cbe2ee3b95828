"""Registration to colors: a flow that is known, and a texture that slid along the surface."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.images import color_over_white
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.tracking.color_registration import register_to_colors, steps_of_flow

CAMERA = OrbitCamera(width=96, height=96)


def ball() -> TexturedMesh:
    """A ball with a soft pattern, projected along the axis of view."""
    sphere = trimesh.creation.icosphere(4, 0.5)
    vertices = torch.from_numpy(sphere.vertices.astype(np.float32))
    faces = torch.from_numpy(sphere.faces.astype(np.int32))
    uvs = (vertices[:, :2] * torch.tensor([1.0, -1.0]) + 0.5).clamp(0, 1)
    along = torch.linspace(0, 4 * np.pi, 64)
    pattern = 0.5 + 0.25 * torch.sin(along)[:, None] + 0.25 * torch.cos(along)[None]
    return TexturedMesh(vertices, faces, uvs, pattern[..., None].expand(-1, -1, 3).contiguous())


def test_a_uniform_flow_moves_what_is_shown_parallel_to_the_picture() -> None:
    mesh = ball()
    flow = np.zeros((2, 96, 96))
    flow[1] = 2.0  # columns to the right
    steps, share = steps_of_flow(mesh.vertices, mesh.faces, flow, CAMERA)
    nearest = int(mesh.vertices[:, 2].argmax())
    assert share[nearest] > 0
    assert steps[nearest] == pytest.approx([2 * 1.5 / CAMERA.focal, 0, 0], abs=2e-3)  # at a distance of 1.5
    hidden = mesh.vertices[:, 2].numpy() < -0.1
    assert not steps[hidden].any() and not share[hidden].any()


def test_a_face_that_turned_is_turned_back() -> None:
    mesh = ball()
    turn = torch.tensor(trimesh.transformations.rotation_matrix(0.08, [0, 1, 0])[:3, :3], dtype=torch.float32)
    turned = mesh.vertices @ turn.T
    color, alpha = render_mesh(TexturedMesh(turned, mesh.faces, mesh.uvs, mesh.texture), [CAMERA])
    pictures = color_over_white(color, alpha)
    everyone = torch.arange(len(turned))
    still = torch.zeros(1, len(turned), 3)
    offsets = register_to_colors(mesh, everyone, mesh.vertices, still, mesh.faces, pictures)
    front = mesh.vertices[:, 2] > 0.4
    expected, got = (turned - mesh.vertices)[front], offsets[0][front]
    assert float((got - expected).norm(dim=1).mean()) < 0.5 * float(expected.norm(dim=1).mean())
    assert torch.equal(offsets, register_to_colors(mesh, everyone, mesh.vertices, still, mesh.faces, pictures))


def test_frames_that_look_like_nothing_get_no_defects() -> None:
    mesh = ball()
    thin = mesh.vertices * torch.tensor([1.0, 1.0, 0.02])
    noise = torch.rand(1, 96, 96, 1, generator=torch.Generator().manual_seed(0)).expand(-1, -1, -1, 3).contiguous()
    everyone, still = torch.arange(len(thin)), torch.zeros(1, len(thin), 3)
    finder = DefectFinder(mesh.faces.numpy(), thin.double().numpy())
    flat = replace(mesh, vertices=thin)

    def defects(sound: bool) -> int:
        offsets = register_to_colors(flat, everyone, thin, still, mesh.faces, noise, sound)
        assert offsets.any()
        return int(finder.defective((thin + offsets[0]).double().numpy()).sum())

    assert not finder.defective(thin.double().numpy()).any()
    assert defects(sound=False) > 0 and defects(sound=True) == 0


def test_large_pictures_move_the_mesh_as_small_ones_do() -> None:
    mesh = ball()
    shift = torch.tensor([0.02, 0.0, 0.0])
    everyone, still = torch.arange(len(mesh.vertices)), torch.zeros(1, len(mesh.vertices), 3)
    front = mesh.vertices[:, 2] > 0.4
    for size in (256, 400):
        color, alpha = render_mesh(
            replace(mesh, vertices=mesh.vertices + shift), [OrbitCamera(width=size, height=size)]
        )
        offsets = register_to_colors(mesh, everyone, mesh.vertices, still, mesh.faces, color_over_white(color, alpha))
        assert offsets[0][front].mean(0).tolist() == pytest.approx(shift.tolist(), abs=0.004)


def test_empty_pictures_move_nothing_of_an_invisible_mesh() -> None:
    mesh = ball()
    away = torch.full((1, len(mesh.vertices), 3), 10.0)
    offsets = register_to_colors(
        mesh, torch.arange(len(mesh.vertices)), mesh.vertices, away, mesh.faces, torch.ones(1, 96, 96, 3)
    )
    torch.testing.assert_close(offsets, away, atol=1e-4, rtol=0)
