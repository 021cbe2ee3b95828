"""Remedies of failed gates: allowed settings, on the right side of the bounds."""

from typing import Any

import pytest

from flows.inputs.manifest import parse_changes
from flows.studio.remedies import HIGH, LOW, remedies
from steps.profiles import PROFILES, profile, revise


def gate(name: str, low: bool) -> dict[str, Any]:
    return {"name": name, "passed": False, "value": 0.0 if low else 9.0, "least": 1.0, "most": 2.0}


@pytest.mark.parametrize("name", PROFILES)
def test_every_gate_has_a_remedy_that_the_profile_allows(name: str) -> None:
    settings = profile(name)
    for table, low in ((LOW, True), (HIGH, False)):
        for title in table:
            found = remedies(gate(title, low), settings)
            assert found
            for remedy in found:
                changed = revise(settings, parse_changes(remedy.lines()))
                assert changed != settings, remedy


def test_a_remedy_goes_to_the_side_on_which_the_value_is_missing() -> None:
    settings = profile("preview")
    low, high = (remedies(gate("motion", side), settings)[0].changes for side in (True, False))
    assert low == {"motion.iterations": 500}
    assert set(high) == {"motion.plane_lr", "motion.network_lr"}


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({}, "mesh.source=gaussians"),  # the network's surface has no threshold
        ({"mesh.source": "gaussians"}, "mesh.density_threshold=0.25"),
        ({"mesh.mode": "per_frame"}, "mesh.density_threshold=0.25"),
    ],
)
def test_the_threshold_is_a_remedy_for_surfaces_of_gaussians_alone(changes: dict[str, str], line: str) -> None:
    settings = revise(profile("preview"), changes)
    assert remedies(gate("agreement", True), settings)[0].lines() == [line]
    assert remedies(gate("flaws", False), settings)[0].lines() == [line]


def test_what_passed_needs_none_and_a_value_at_its_bound_is_left_out() -> None:
    settings = profile("preview")
    assert remedies({**gate("folds", False), "passed": True}, settings) == []
    largest = revise(settings, {"mesh.texture_size": 8192})
    labels = {remedy.label for remedy in remedies(gate("sharpness", True), largest)}
    assert labels == {"twice the shape iterations"}
