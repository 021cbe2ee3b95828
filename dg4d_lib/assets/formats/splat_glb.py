"""Splats of one frame as GLB, with the Khronos extension KHR_gaussian_splatting.

Viewers without the extension show colored points. World axes and units equal those of glTF.
"""

from typing import Literal

import torch

from dg4d_lib.assets.formats.gltf import VERTEX_DATA, GltfDocument
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import check_storable
from dg4d_lib.mesh.models.model import to_linear

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0  # primitive mode
KERNEL = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "sortingMethod": "cameraDistance",
    "projection": "perspective",
}

# Version of the extension: the ratified one (June 2026), or the release candidate of February 2026, whose scales are
# logarithms. Files do not record the version; current readers expect the ratified one.
SplatGlbVersion = Literal["ratified", "rc1"]


def write_splat_glb(gaussians: Gaussians, version: SplatGlbVersion = "ratified") -> bytes:
    """Encode one cloud (no leading batch, color of degree 0) as GLB; equal clouds give equal bytes.

    Raises:
        BadInput: no Gaussians, a batch, color of a higher degree, or numbers that are not finite.
    """
    check_storable(gaussians, "a splat GLB")
    if len(gaussians) == 0:
        raise BadInput("a splat GLB needs at least one Gaussian; given none")
    scales = gaussians.scales if version == "ratified" else gaussians.log_scales
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1).roll(-1, -1)  # xyzw
    linear = torch.from_numpy(to_linear(gaussians.colors.detach().cpu().numpy()))  # as glTF prescribes
    rgba = torch.cat([linear, gaussians.opacities[:, None].detach().cpu()], 1)
    columns = {
        "POSITION": gaussians.means,
        "COLOR_0": rgba,
        f"{EXTENSION}:ROTATION": quats,
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": gaussians.opacities,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": gaussians.harmonics[:, 0],
    }
    document = GltfDocument({})
    document.use_extension(EXTENSION)
    attributes = {
        name: document.add_accessor(name, values.detach().cpu().numpy().astype("<f4"), VERTEX_DATA)
        for name, values in columns.items()
    }
    primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: KERNEL}}
    mesh = document.add("meshes", name="splats", primitives=[primitive])
    node = document.add("nodes", name="splats", mesh=mesh)
    document.tree["scene"] = document.add("scenes", name="asset", nodes=[node])
    return document.to_bytes()
