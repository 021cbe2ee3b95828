"""An asymmetric creature of ellipsoids, seen from any side."""

import torch
import trimesh
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.visual_hull.known import KnownView
from dg4d_lib.visual_hull.probable import Predict
from dg4d_lib.visual_hull.shape import known_volume
from dg4d_lib.visual_hull.surface import colored_surface

SIZE = 96
PARTS = (  # center, radii, color
    ((0.0, 0.0, 0.0), (0.22, 0.25, 0.45), (0.8, 0.2, 0.1)),
    ((0.12, 0.35, 0.35), (0.16, 0.16, 0.16), (0.1, 0.3, 0.9)),
    ((-0.3, 0.05, -0.2), (0.25, 0.07, 0.07), (0.1, 0.8, 0.2)),
    ((0.1, -0.4, 0.25), (0.08, 0.25, 0.08), (0.9, 0.8, 0.1)),
)


def creature(shift: tuple[float, float, float] = (0, 0, 0)) -> InflatedSurface:
    """Return its surface."""
    vertices, faces, colors, count = [], [], [], 0
    for center, radii, color in PARTS:
        ball = trimesh.creation.icosphere(subdivisions=3)
        place = torch.tensor(ball.vertices).float() * torch.tensor(radii) + torch.tensor(center) + torch.tensor(shift)
        vertices.append(place)
        faces.append(torch.tensor(ball.faces).long() + count)
        colors.append(torch.tensor(color).expand(len(place), 3))
        count += len(place)
    every = torch.cat(vertices)
    return InflatedSurface(every, torch.cat(faces), torch.cat(colors), torch.ones(len(every), dtype=torch.bool))


def icosphere(radius: float) -> InflatedSurface:
    """Return the surface of a gray ball."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    vertices = torch.tensor(ball.vertices).float()
    gray = torch.full_like(vertices, 0.5)
    return InflatedSurface(vertices, torch.tensor(ball.faces).long(), gray, torch.ones(len(gray), dtype=torch.bool))


def seen(surface: InflatedSurface, azimuth: float, elevation: float = 0.0, size: int = SIZE) -> KnownView:
    """Return the true view of a surface."""
    camera = OrbitCamera(elevation, azimuth, width=size, height=size)
    color, alpha = render_surface(surface, [camera])
    return KnownView(camera, torch.cat([color, alpha], -1)[0], f"{azimuth:g}.png")


def ring(count: int, surface: InflatedSurface | None = None) -> list[KnownView]:
    """Return views at equal steps of azimuth, the front first."""
    return [seen(surface or creature(), 360 * i / count) for i in range(count)]


def alpha_of(surface: InflatedSurface, azimuth: float) -> Tensor:
    """Return the alpha of a surface from an azimuth."""
    return seen(surface, azimuth).cutout[None, ..., 3:]


def known_surface(views: list[KnownView], predict: Predict | None = None) -> InflatedSurface:
    """Return the colored surface of views."""
    return colored_surface(known_volume(views, predict), views)
