"""Pictures of a painted skin: the project's own z-buffer, soft light, three by three samples a pixel."""

from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh
from dg4d_lib.video.framing import extend_color
from examples.shapes import Skin, normals

SAMPLES = 3  # a side of a pixel
KEY = np.array((0.35, 0.75, 0.56))  # where the light comes from, a unit vector
AMBIENT = 0.52
SHINE = 0.16


class Creature(Protocol):
    """Something that can be drawn at a moment of its motion."""

    @property
    def skin(self) -> Skin:
        """The surface at rest."""
        ...

    @property
    def features(self) -> ndarray:
        """Inputs of its paint at every vertex, "v k"."""
        ...

    def at(self, moment: float) -> ndarray:
        """Vertices at a moment, "v 3"; 0 and 1 are the same."""
        ...

    def color(self, p: ndarray, features: ndarray) -> ndarray:
        """Paint at points of the skin at rest, "p 3" in [0, 1]."""
        ...


def draw(creature: Creature, moment: float, camera: OrbitCamera) -> Float[Tensor, "h w 4"]:
    """Draw a cut-out of the creature, straight alpha."""
    rest, points = creature.skin, creature.at(moment)
    fine = replace(camera, width=SAMPLES * camera.width, height=SAMPLES * camera.height)
    faces = torch.from_numpy(rest.faces.astype(np.int64))
    fragments = rasterize_mesh(torch.from_numpy(points), faces, [fine])
    values = np.concatenate([rest.points, normals(points, rest.faces), rest.openness[:, None], creature.features], 1)
    pixels = interpolate(fragments, faces, torch.from_numpy(values))[0].numpy()
    covered = (fragments.faces[0] >= 0).numpy()
    place, normal, openness, features = np.split(pixels[covered], (3, 6, 7), axis=1)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    color = _shade(creature.color(place, features), normal, openness, camera.position().numpy() / camera.radius)
    picture = np.zeros((*covered.shape, 4))
    picture[covered] = np.concatenate([color, np.ones((len(color), 1))], 1)
    small = picture.reshape(camera.height, SAMPLES, camera.width, SAMPLES, 4).mean((1, 3))
    small[..., :3] /= np.maximum(small[..., 3:], 1e-9)
    return extend_color(torch.from_numpy(small.clip(0, 1).astype(np.float32)))


def _shade(color: ndarray, normal: ndarray, openness: ndarray, towards_eye: ndarray) -> ndarray:
    """Shade with wrapped light from above, light of sky and ground, a soft highlight, and darker folds."""
    wrapped = np.clip((normal @ KEY + 0.35) / 1.35, 0, 1)[:, None]
    sky = 0.5 + 0.5 * normal[:, 1:2]
    light = openness * (AMBIENT + 0.10 * sky + 0.62 * wrapped)
    half = KEY + towards_eye
    gloss = np.clip(normal @ (half / np.linalg.norm(half)), 0, 1)[:, None] ** 24
    return (color * light + SHINE * gloss * openness).clip(0, 1)
