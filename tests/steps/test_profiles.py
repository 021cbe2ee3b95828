"""Settings as requests carry them."""

import pytest

from dg4d_lib.rasterizer import choice
from dg4d_lib.settings import Zero123PriorSettings
from steps.profiles import (
    PREVIEW,
    PROFILES,
    ExtractMeshSettings,
    FitGaussiansSettings,
    FitMotionSettings,
    PackAssetSettings,
    profile,
    revise,
)


@pytest.mark.parametrize(("lack", "backend"), [("no GPU", "cpu"), ("", "cuda_gsplat")])
def test_a_request_says_what_will_draw(lack: str, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choice, "what_gsplat_lacks", lambda: lack)
    stages = {name: getattr(PREVIEW, name) for name in ("prior", "static", "deformation", "motion", "mesh", "pack")}
    for kind in (FitGaussiansSettings, FitMotionSettings, ExtractMeshSettings, PackAssetSettings):
        own = {name: stage for name, stage in stages.items() if name in kind.model_fields}
        assert kind(rasterizer=PREVIEW.rasterizer, **own).model_dump(mode="json")["rasterizer"] == backend
        assert kind(rasterizer="reference", **own).model_dump(mode="json")["rasterizer"] == "reference"


PAPER = {"static.iterations": 500, "static.views": 16, "static.noise_start": 0.98, "static.noise_end": 0.02,
         "motion.iterations": 200, "motion.views": 4, "motion.noise_start": 0.5, "motion.noise_end": 0.02,
         "motion.frames_per_iteration": 0, "static.points": 5000, "deformation.temporal": 32, "deformation.spatial": 32,
         "deformation.features": 32, "deformation.endpoint": True, "motion.fine_tune": False,
         "prior.weights": "zero123-xl", "prior.variant": "xl", "prior.guidance_scale": 5.0,
         "driving.kind": "svd", "driving.frames": 14,
         "refiner.kind": "video_to_video", "refiner.skipped": 0.7, "static.start": "blob",
         "mesh.mode": "per_frame", "mesh.grid": 128, "mesh.texture_size": 1024}  # fmt: skip
DIFFERENCES = {
    "paper": {},
    "video": {"subject.max_frames": 32, "motion.iterations": 500},
    "video-fast": {"subject.max_frames": 16, "motion.iterations": 500, "motion.views": 1},
    "reference": {"motion.iterations": 500, "static.noise_start": 1.0, "static.noise_end": 0.0,
                  "motion.noise_start": 1.0, "motion.noise_end": 0.0, "deformation.temporal": 12,
                  "motion.fine_tune": True, "deformation.endpoint": False, "deformation.half_side": 1.6,
                  "prior.weights": "stable-zero123", "prior.variant": "stable",
                  "static.start": "lgm", "static.iterations": 0},
}  # fmt: skip


def value_of(name: str, path: str) -> object:
    value: object = profile(name)
    for part in path.split("."):
        value = getattr(value, part)
    return value


@pytest.mark.parametrize("name", DIFFERENCES)
def test_profiles_have_the_numbers_that_they_are_named_after(name: str) -> None:
    expected = {**PAPER, **DIFFERENCES[name]}
    assert {path: value_of(name, path) for path in expected} == expected


def test_every_profile_but_the_preview_has_a_trained_prior() -> None:
    trained = {name for name in PROFILES if isinstance(profile(name).prior, Zero123PriorSettings)}
    assert trained == set(PROFILES) - {"preview"}


@pytest.mark.parametrize("turned", [False, True])
def test_another_kind_is_chosen_before_its_knobs_are_set(turned: bool) -> None:
    changes = {"prior.kind": "zero123", "prior.memory_gb": 12}
    if turned:
        changes = dict(reversed(changes.items()))
    assert revise(PREVIEW, changes).prior == Zero123PriorSettings(memory_gb=12)


def test_the_same_kind_again_changes_nothing() -> None:
    twelve = revise(profile("paper"), {"prior.memory_gb": 12})
    assert revise(twelve, {"prior.kind": "zero123"}) == twelve
