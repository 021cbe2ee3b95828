"""Small animated assets for tests of USDZ."""

from dataclasses import replace

import torch
import trimesh

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh

FRAMES, FPS = 4, 12.0


def ball(subdivisions: int = 1) -> TexturedMesh:
    """A sphere whose triangles share no vertex, as if every edge were a seam."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    vertices = torch.tensor(sphere.triangles.reshape(-1, 3), dtype=torch.float32)
    generator = torch.Generator().manual_seed(subdivisions)
    return TexturedMesh(
        vertices,
        torch.arange(len(vertices)).reshape(-1, 3),
        torch.rand(len(vertices), 2, generator=generator),
        torch.randint(0, 256, (16, 8, 3), generator=generator) / 255,
    )


def growing_ball(frames: int = FRAMES) -> Asset4D:
    """Every frame is the ball again, larger by a quarter of its first size."""
    mesh = ball()
    return Asset4D(mesh, torch.arange(frames)[:, None, None] * mesh.vertices / 4, 7.0)


def torn_ball() -> Asset4D:
    """Copies of a vertex part."""
    offsets = torch.randn(FRAMES, len(ball().vertices), 3, generator=torch.Generator().manual_seed(1))
    return Asset4D(ball(), offsets, 7.0)


def colorful_ball() -> Asset4D:
    textures = torch.randint(0, 256, (FRAMES, 16, 8, 3), generator=torch.Generator().manual_seed(2)) / 255
    return replace(growing_ball(), textures=textures)


def cloud(frames: int = FRAMES, count: int = 5, bases: int = 4) -> Gaussians:
    generator = torch.Generator().manual_seed(3)

    def rand(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        rand(frames, count, 3), rand(frames, count, 3) - 3, rand(frames, count, 4), rand(count), rand(count, bases, 3)
    )


def balls(frames: int = FRAMES) -> list[TexturedMesh]:
    """Unrelated meshes: a coarse and a fine one in turn, every one larger than the one before."""
    meshes = [ball(frame % 2) for frame in range(frames)]
    return [
        replace(
            mesh,
            vertices=mesh.vertices * (1 + frame),
            texture=torch.full((4, 4, 3), frame / 255),
        )
        for frame, mesh in enumerate(meshes)
    ]
