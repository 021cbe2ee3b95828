"""Registration to colors: a flow that is known, and a texture that slid along the surface."""

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.images import color_over_white
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
