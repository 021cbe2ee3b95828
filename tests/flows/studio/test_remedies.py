"""Remedies of failed gates: allowed settings, on the right side of the bounds."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import pytest

from flows.engine.versions import VersionStep
from flows.inputs.manifest import parse_changes
from flows.studio.remedies import HIGH, LOW, remedies
from steps.contract import Digest
from steps.profiles import PROFILES, profile, revise

DIGEST = "sha256:" + 64 * "0"
FITTED = ("prepare_subject", "drive_video", "fit_gaussians", "fit_motion", "plan_mesh", "extract_mesh", "pack_asset")
OWN_MESH = ("prepare_subject", "prepare_asset", "drive_video", "animate_asset", "pack_asset")
OWN_SPLATS = (*OWN_MESH, "plan_mesh", "extract_mesh")


def gate(title: str, low: bool, **values: float) -> dict[str, Any]:
    """Return a failed row; the form of a title such as `sharpness mesh` fails."""
    name, _, form = title.partition(" ")
    value = 0.0 if low else 9.0
    found = values or {form or "mesh": value}
    return {"name": name, "passed": False, "value": value, "least": 1.0, "most": 2.0, "values": found}


def version(*labels: str, outputs: Mapping[str, Digest] = MappingProxyType({})) -> list[VersionStep]:
    return [VersionStep(label=label, record=DIGEST, inputs={}, outputs=dict(outputs)) for label in labels]


@pytest.mark.parametrize("name", PROFILES)
def test_every_gate_has_a_remedy_that_the_profile_allows(name: str) -> None:
    settings = profile(name)
    for table, low in ((LOW, True), (HIGH, False)):
        for title in table:
            found = remedies(gate(title, low), settings, version(*FITTED))
            assert found
            for remedy in found:
                assert not any(change.startswith("asset.") for change in remedy.changes)
                changed = revise(settings, parse_changes(remedy.lines()))
                assert changed != settings, remedy


@pytest.mark.parametrize(
    ("steps", "effective"), [(OWN_MESH, ("asset.", "mesh.texture_size")), (OWN_SPLATS, ("asset.", "mesh."))]
)
def test_remedies_for_a_model_change_what_its_steps_read(steps: tuple[str, ...], effective: tuple[str, ...]) -> None:
    settings, count = profile("preview"), 0
    for table, low in ((LOW, True), (HIGH, False)):
        for title in table:
            for remedy in remedies(gate(title, low), settings, version(*steps)):
                assert all(change.startswith(effective) for change in remedy.changes), remedy
                count += 1
    assert count > 8
    (texture,) = remedies(gate("sharpness mesh", True), settings, version(*OWN_MESH))
    assert texture.changes == {"mesh.texture_size": 2048}


def test_a_remedy_goes_to_the_side_on_which_the_value_is_missing() -> None:
    settings = profile("preview")
    low, high = (remedies(gate("motion", side), settings, version(*FITTED))[0].changes for side in (True, False))
    assert low == {"motion.iterations": 500}
    assert set(high) == {"motion.plane_lr", "motion.network_lr"}


@pytest.mark.parametrize(
    ("values", "labels"),
    [
        ({"splats": 0.35, "mesh": 1.1}, ["twice the shape iterations"]),
        ({"splats": 1.1, "mesh": 0.35}, ["a larger texture"]),
        ({"splats": 0.6, "mesh": 0.35}, ["twice the shape iterations", "a larger texture"]),
    ],
)
def test_a_remedy_is_for_the_form_that_fails(values: dict[str, float], labels: list[str]) -> None:
    found = remedies(gate("sharpness", True, **values), profile("preview"), version(*FITTED))
    assert [remedy.label for remedy in found] == labels


@pytest.mark.parametrize(
    ("changes", "steps", "line"),
    [
        ({}, FITTED, "mesh.source=gaussians"),  # the network's surface has no threshold
        ({"mesh.source": "gaussians"}, FITTED, "mesh.density_threshold=0.25"),
        ({"mesh.mode": "per_frame"}, FITTED, "mesh.density_threshold=0.25"),
        ({}, OWN_SPLATS, "mesh.density_threshold=0.25"),
    ],
)
def test_the_threshold_is_a_remedy_for_surfaces_of_gaussians_alone(
    changes: dict[str, str], steps: tuple[str, ...], line: str
) -> None:
    settings = revise(profile("preview"), changes)
    assert remedies(gate("agreement", True), settings, version(*steps))[0].lines() == [line]
    assert remedies(gate("flaws", False), settings, version(*steps))[0].lines() == [line]


def test_a_mesh_per_frame_is_no_remedy_where_frames_have_their_own() -> None:
    settings = profile("preview")  # mesh.mode=auto
    per_frame = version(*FITTED[:-2], "extract_mesh 1", "extract_mesh 2", outputs={"meshes": DIGEST})
    labels = [
        {remedy.label for remedy in remedies(gate("folds", False), settings, steps)}
        for steps in (version(*FITTED), per_frame)
    ]
    assert labels == [{"a mesh per frame", "a coarser mesh grid"}, {"a coarser mesh grid"}]


def test_what_passed_needs_none_and_a_value_at_its_bound_is_left_out() -> None:
    settings = profile("preview")
    assert remedies({**gate("folds", False), "passed": True}, settings, version(*FITTED)) == []
    failed = gate("sharpness", True, splats=0.0, mesh=0.0)
    largest = revise(settings, {"mesh.texture_size": 8192})
    labels = {remedy.label for remedy in remedies(failed, largest, version(*FITTED))}
    assert labels == {"twice the shape iterations"}
