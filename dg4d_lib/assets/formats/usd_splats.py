"""Moving splats in USD: the schema `ParticleField3DGaussianSplat` of OpenUSD's UsdVol.

Scales and opacities are linear, quaternions have unit length, and the spherical harmonics are those of sRGB colors, as
declared by the color space. Animated values are half floats in the schema's separate attributes, or float32.
"""

import numpy as np
import torch
from pxr import Gf, Usd, UsdGeom, UsdVol, Vt

from dg4d_lib.assets.formats.usd_stage import animate, bounds, quaternions, to_array, vectors
from dg4d_lib.gaussians.cloud import Gaussians

EXTENT_SIGMAS = 3.0  # standard deviations of a Gaussian inside its bounds
MIN_HALF = 2.0**-20  # smallest scale, meters; half floats have steps of 2^-24 there, so the error is at most 3 %


def add_splats_variant(stage: Usd.Stage, states: Gaussians, fps: float, half: bool) -> None:
    """Add the variants "mesh" and "splats" to /asset; the latter, which is selected, deactivates /asset/mesh.

    Args:
        stage: stage with /asset/mesh.
        states: one state per frame.
        fps: frames per second.
        half: half precision for what moves.
    """
    choice = stage.GetDefaultPrim().GetVariantSets().AddVariantSet("representation")
    for name in ("mesh", "splats"):
        choice.AddVariant(name)
    choice.SetVariantSelection("splats")
    with choice.GetVariantEditContext():
        stage.OverridePrim("/asset/mesh").SetActive(False)
        _define_splats(stage, states, fps, half)


def _define_splats(stage: Usd.Stage, states: Gaussians, fps: float, half: bool) -> None:
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/asset/splats")
    means, scales, harmonics = to_array(states.means), to_array(states.scales), to_array(states.harmonics)
    quats = to_array(torch.nn.functional.normalize(states.quats, dim=-1))
    reach = EXTENT_SIGMAS * np.sqrt(to_array(states.covariances.diagonal(dim1=-2, dim2=-1)))
    animate(splats.CreateExtentAttr(), [bounds(m - r, m + r) for m, r in zip(means, reach, strict=True)], fps)
    if half:
        means, quats, scales = (values.astype("<f2") for values in (means, quats, scales.clip(MIN_HALF)))
        create = splats.CreatePositionshAttr, splats.CreateOrientationshAttr, splats.CreateScaleshAttr
    else:
        create = splats.CreatePositionsAttr, splats.CreateOrientationsAttr, splats.CreateScalesAttr
    animate(create[0](), [vectors(mean) for mean in means], fps)
    animate(create[1](), [quaternions(quat) for quat in quats], fps)
    animate(create[2](), [vectors(scale) for scale in scales], fps)
    splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(to_array(states.opacities)))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(round(harmonics.shape[1] ** 0.5) - 1)
    colors = splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(harmonics.reshape(-1, 3)))
    colors.SetMetadata("interpolation", UsdGeom.Tokens.vertex)  # not required by the schema, but by Omniverse
    colors.SetMetadata("elementSize", harmonics.shape[1])
    splats.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
    splats.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)
    Usd.ColorSpaceAPI.Apply(splats.GetPrim()).CreateColorSpaceNameAttr(Gf.ColorSpaceNames.SRGBRec709)
