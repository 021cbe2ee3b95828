"""Splats as glTF: three.js, the Khronos validator and round trips."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
from splat_readers import read_splat_glb

from dg4d_lib.assets.formats.gltf import GlbReader
from dg4d_lib.assets.formats.splat_glb import EXTENSION, write_splat_glb
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from tests.clients.node import run_node

NEW = {f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0")}


def cloud(count: int = 40) -> Gaussians:
    generator = torch.Generator().manual_seed(3)
    means, log_scales, quats, logits, harmonics = (
        torch.randn(shape, generator=generator) for shape in ((count, 3), (count, 3), (count, 4), (count,), (count, 3))
    )
    return Gaussians(means, log_scales - 4, 2 * quats, 3 * logits, harmonics[:, None])


def column(content: bytes, name: str) -> Any:
    parsed = GlbReader(content)
    return parsed.accessor(parsed.tree["meshes"][0]["primitives"][0]["attributes"][name])


@pytest.mark.parametrize("version", ["ratified", "rc1"])
def test_a_cloud_comes_back(version: Any) -> None:
    given = cloud()
    back = read_splat_glb(write_splat_glb(given, version), version)
    assert torch.equal(back.means, given.means)
    assert torch.equal(back.harmonics, given.harmonics)
    torch.testing.assert_close(back.log_scales, given.log_scales, rtol=0, atol=1e-6)
    torch.testing.assert_close(back.opacities, given.opacities, rtol=1e-6, atol=0)
    torch.testing.assert_close(back.covariances, given.covariances, rtol=1e-4, atol=1e-9)


def test_three_js_sees_the_same_ellipsoids(tmp_path: Path) -> None:
    given = cloud()
    (tmp_path / "a.glb").write_bytes(write_splat_glb(given))
    seen = run_node("read_splat_glb.mjs", str(tmp_path / "a.glb"))
    rows, columns = np.triu_indices(3)
    np.testing.assert_array_equal(np.float32(seen["centers"]), given.means.numpy())
    np.testing.assert_allclose(seen["covariances"], given.covariances[:, rows, columns], rtol=1e-4, atol=1e-7)
    shown = torch.cat([given.colors, given.opacities[:, None]], 1)
    np.testing.assert_allclose(seen["colors"], 255 * shown, atol=0.51)  # bytes


def test_the_khronos_validator_objects_to_the_new_attributes_alone(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(write_splat_glb(cloud()))
    report = run_node("validate.mjs", str(tmp_path / "a.glb"))
    errors = [message for message in report["messages"] if message["severity"] == 0]
    assert {error["code"] for error in errors} == {"MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert {error["pointer"].rpartition("/")[2] for error in errors} == NEW
    assert (report["errors"], report["warnings"]) == (4, 0)


def test_another_gltf_library_finds_points_with_the_extension() -> None:
    tree = pygltflib.GLTF2().load_from_bytes(write_splat_glb(cloud()))
    (primitive,) = tree.meshes[0].primitives
    assert tree.extensionsUsed == [EXTENSION]
    assert not tree.extensionsRequired  # those who do not know it show points
    assert primitive.mode == 0
    assert primitive.extensions[EXTENSION]["kernel"] == "ellipse"


def test_scales_are_lengths_in_the_ratified_text_and_logarithms_in_the_candidate() -> None:
    given = cloud()
    assert (column(write_splat_glb(given), f"{EXTENSION}:SCALE") > 0).all()
    np.testing.assert_array_equal(column(write_splat_glb(given, "rc1"), f"{EXTENSION}:SCALE"), given.log_scales)


def test_rotations_are_of_unit_length_with_the_real_part_last() -> None:
    given = replace(cloud(1), quats=torch.tensor([[0.0, 0.0, 6.0, 8.0]]))
    np.testing.assert_allclose(column(write_splat_glb(given), f"{EXTENSION}:ROTATION"), [[0, 0.6, 0.8, 0]], atol=1e-7)


def test_points_without_the_extension_have_linear_light_and_the_opacity() -> None:
    """A display value of one half is 21.4 % of the light of white (IEC 61966-2-1)."""
    given = replace(cloud(1), harmonics=torch.tensor([[[-9.0, 0.0, 9.0]]]), opacity_logits=torch.tensor([0.0]))
    np.testing.assert_allclose(column(write_splat_glb(given), "COLOR_0"), [[0, 0.214041, 1, 0.5]], atol=1e-6)


def test_equal_clouds_give_equal_bytes() -> None:
    assert write_splat_glb(cloud()) == write_splat_glb(cloud())


def test_no_gaussians_are_refused() -> None:
    with pytest.raises(BadInput, match="at least one Gaussian"):
        write_splat_glb(cloud(0))


def test_numbers_that_are_not_finite_are_refused() -> None:
    with pytest.raises(BadInput, match="non-finite numbers; given some in quats"):
        write_splat_glb(replace(cloud(1), quats=torch.full((1, 4), torch.inf)))
