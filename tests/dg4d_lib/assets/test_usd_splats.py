"""Animated splats in USDZ: states in float and half, variants."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom, UsdVol
from usd_samples import FPS, FRAMES, cloud, growing_ball

from dg4d_lib.assets.formats.usd import write_usdz
from dg4d_lib.geometry.quaternion import quat_to_rotmat

MOVING = "positions", "orientations", "scales"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.usdz"


def test_splats_are_the_states(path: Path) -> None:
    states = cloud()
    write_usdz(path, growing_ball(), FPS, states)
    stage = Usd.Stage.Open(str(path))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/asset/splats"))
    assert not any(splats.GetPrim().GetAttribute(f"{name}h").HasAuthoredValue() for name in MOVING)
    for frame in range(FRAMES + 1):
        time, state = 24 * frame / FPS, states.at(frame % FRAMES)
        assert np.array_equal(splats.GetPositionsAttr().Get(time), state.means.numpy())
        scales = np.array(splats.GetScalesAttr().Get(time))
        np.testing.assert_allclose(scales, state.log_scales.exp(), rtol=1e-6)
        quats = [(q.GetReal(), *q.GetImaginary()) for q in splats.GetOrientationsAttr().Get(time)]
        np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-6)
        turns = quat_to_rotmat(torch.tensor(quats))
        np.testing.assert_allclose(turns, quat_to_rotmat(state.quats), atol=1e-5)
        low, high = np.array(splats.GetExtentAttr().Get(time))
        reach = 3 * state.covariances.diagonal(dim1=-2, dim2=-1).sqrt()
        np.testing.assert_allclose(low, (state.means - reach).amin(0), rtol=1e-4)
        np.testing.assert_allclose(high, (state.means + reach).amax(0), rtol=1e-4)
    np.testing.assert_allclose(splats.GetOpacitiesAttr().Get(), states.opacity_logits.sigmoid(), rtol=1e-6)
    coefficients = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    assert np.array_equal(coefficients.reshape(5, 4, 3), states.harmonics)
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    colors = UsdGeom.Primvar(splats.GetRadianceSphericalHarmonicsCoefficientsAttr())
    assert (colors.GetInterpolation(), colors.GetElementSize()) == ("vertex", 4)
    assert Usd.ColorSpaceAPI(splats.GetPrim()).GetColorSpaceNameAttr().Get() == Gf.ColorSpaceNames.SRGBRec709


def test_colors_that_are_the_same_from_all_sides_have_degree_zero(path: Path) -> None:
    states = cloud(bases=1)
    write_usdz(path, growing_ball(), FPS, states)
    stage = Usd.Stage.Open(str(path))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/asset/splats"))
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 0
    colors = UsdGeom.Primvar(splats.GetRadianceSphericalHarmonicsCoefficientsAttr())
    assert (len(colors.Get()), colors.GetElementSize()) == (5, 1)


def test_half_splats_are_the_states_to_eleven_bits(path: Path) -> None:
    states = replace(cloud(), log_scales=torch.linspace(-20, 1, FRAMES * 15).reshape(FRAMES, 5, 3))
    write_usdz(path, growing_ball(), FPS, states, half=True)
    stage = Usd.Stage.Open(str(path))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/asset/splats"))
    assert not any(splats.GetPrim().GetAttribute(name).HasAuthoredValue() for name in MOVING)  # or they would win
    for frame in range(FRAMES):
        time, state = 24 * frame / FPS, states.at(frame)
        np.testing.assert_allclose(splats.GetPositionshAttr().Get(time), state.means, rtol=2**-11)
        scales = np.array(splats.GetScaleshAttr().Get(time), np.float32)
        np.testing.assert_allclose(scales, state.scales.clamp(min=2**-20), rtol=2**-11, atol=2**-25)
        quats = [(q.GetReal(), *q.GetImaginary()) for q in splats.GetOrientationshAttr().Get(time)]
        np.testing.assert_allclose(quat_to_rotmat(torch.tensor(quats)), quat_to_rotmat(state.quats), atol=2**-9)
    np.testing.assert_allclose(splats.GetOpacitiesAttr().Get(), states.opacity_logits.sigmoid(), rtol=1e-6)


def test_half_splats_take_half_the_bytes(path: Path) -> None:
    sizes = []
    for states, half in ((None, False), (cloud(8, 5000), False), (cloud(8, 5000), True)):
        write_usdz(path, growing_ball(8), FPS, states, half=half)
        sizes.append(path.stat().st_size)
    mesh, floats, halves = sizes
    assert 0.5 <= (halves - mesh) / (floats - mesh) < 0.62  # opacities and colors stay floats: .55 expected


def test_orientations_of_usd_turn_as_ours(path: Path) -> None:
    quarter = torch.tensor([[[math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)]]])  # around z: x becomes y
    write_usdz(path, growing_ball(1), FPS, replace(cloud(1, 1, 1), quats=quarter))
    stage = Usd.Stage.Open(str(path))
    (quat,) = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/asset/splats")).GetOrientationsAttr().Get(0)
    assert Gf.IsClose(quat.Transform(Gf.Vec3f(1, 0, 0)), Gf.Vec3f(0, 1, 0), 1e-6)


def test_mesh_and_splats_are_never_shown_together(path: Path) -> None:
    write_usdz(path, growing_ball(), FPS, cloud())
    stage = Usd.Stage.Open(str(path))
    shown = {}
    for choice in (None, "splats", "mesh"):
        if choice:
            stage.GetDefaultPrim().GetVariantSet("representation").SetVariantSelection(choice)
        shown[choice] = [prim.GetName() for prim in stage.Traverse() if prim.IsA(UsdGeom.Gprim)]
    assert shown == {None: ["splats"], "splats": ["splats"], "mesh": ["subject"]}
