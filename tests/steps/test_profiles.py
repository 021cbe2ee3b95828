"""Settings as requests carry them."""

import re

import pytest
from pydantic import ValidationError

from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.imagedream import RING
from dg4d_lib.rasterizer import backends
from dg4d_lib.reconstruction.lgm import WORLD_SCALE
from dg4d_lib.settings import Zero123PriorSettings
from steps.profiles import (
    IMAGEDREAM_RING,
    PREVIEW,
    PROFILES,
    RENAMED_SETTINGS,
    PipelineSettings,
    profile,
    revise,
    step_settings,
)
from steps.runtime.weights import license_of, weights_in


@pytest.mark.parametrize(("lack", "backend"), [("no GPU", "cpu"), ("", "cuda_gsplat")])
def test_a_request_says_what_will_draw(lack: str, backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "gsplat_unavailable_reason", lambda: lack)
    for step in ("fit_gaussians", "fit_motion", "plan_mesh", "extract_mesh", "pack_asset", "check_asset"):
        for asked, draws in (("auto", backend), ("reference", "reference")):
            made = step_settings(step, PREVIEW.model_copy(update={"rasterizer": asked}))
            assert made.model_dump(mode="json")["rasterizer"] == draws


@pytest.mark.parametrize("name", ["driving.motion", "prior.weight", "static.start.points", "refiner.texture.lr"])
def test_a_refused_setting_has_its_own_name(name: str) -> None:
    kinds = {"static.start.kind": "blob", "refiner.kind": "video_to_video"}
    with pytest.raises(BadInput, match=rf"refused: {re.escape(name)} = 'walk'"):
        revise(PREVIEW, {**kinds, name: "walk"})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("pack.lods", 0.5, "0.5 is not a list; write for example `--set 'pack.lods=[0.5]'`"),
        ("subject.box", "1,2,3", "'1,2,3' is not a list; write for example `--set 'subject.box=[1,2,3]'`"),
        (
            "deformation.scales",
            {"a": 1},
            "{'a': 1} is not a list; write for example `--set 'deformation.scales=[...]'`",
        ),
        ("subject.box", [1, 2, 3], "[1, 2, 3]: a box is X,Y,W,H in pixels"),
    ],
)
def test_a_refused_list_is_told_how_it_is_written(name: str, value: object, message: str) -> None:
    with pytest.raises(BadInput, match=re.escape(f"refused: {name} = {message}")):
        revise(PREVIEW, {name: value})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"prior.kind": "geometrc"}, "prior.kind = 'geometrc': use geometric, learned, zero123, imagedream or oracle"),
        ({"views.kind": 5}, "views.kind = '5': use none or image_edit"),
        ({"static.start.kind": "x"}, "static.start.kind = 'x': use blob, surface or lgm"),
    ],
)
def test_an_unknown_kind_is_told_the_known_ones(changes: dict[str, object], message: str) -> None:
    with pytest.raises(BadInput) as refusal:
        revise(PREVIEW, changes)
    assert str(refusal.value) == f"settings refused: {message}"


SHOWN = "; `dg4d settings motion.iterations` shows what is allowed"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"motion.iterations": 0}, "motion.iterations = 0: Input should be greater than or equal to 1" + SHOWN),
        ({"motion.iterations": "ten"}, "motion.iterations = 'ten' is not a whole number" + SHOWN),
        ({"motion.iterations": 1.5}, "motion.iterations = 1.5 is not a whole number" + SHOWN),
        ({"motion.iterations": None}, "motion.iterations = None is not a whole number" + SHOWN),
        (
            {"prior.weight": "x"},
            "prior.weight = 'x' is not a number; `dg4d settings prior.weight` shows what is allowed",
        ),
        (
            {"subject.box": [0, -1, "x", 4]},
            "subject.box.1 = -1: Input should be greater than or equal to 0; subject.box.2 = 'x' is not a whole "
            "number; `dg4d settings subject.box` shows what is allowed",
        ),
        (
            {"motion.iterations": "ten", "static.iterations": -1},
            "static.iterations = -1: Input should be greater than or equal to 0; motion.iterations = 'ten' is not a "
            "whole number; `dg4d settings NAME` shows what is allowed",
        ),
    ],
)
def test_a_refused_number_is_told_where_its_range_stands(changes: dict[str, object], message: str) -> None:
    with pytest.raises(BadInput) as refusal:
        revise(PREVIEW, changes)
    assert str(refusal.value) == f"settings refused: {message}"


PAPER = {"static.iterations": 500, "static.views": 16, "static.t_max_start": 0.98, "static.t_max_end": 0.02,
         "motion.iterations": 200, "motion.views": 4, "motion.t_max_start": 0.5, "motion.t_max_end": 0.02,
         "static.t_max_limit": 0.98, "motion.t_max_limit": 0.98, "motion.guidance_weight": 1.0,
         "motion.color_weight": 10000.0, "motion.alpha_weight": 1000.0, "static.alpha_weight": 1000.0,
         "motion.length_scale": 1.0, "deformation.half_side": 1.6, "deformation.scales": (1,),
         "motion.frames_per_iteration": 0, "static.start.points": 5000,
         "deformation.temporal": 32, "deformation.spatial": 32, "deformation.features": 32,
         "deformation.endpoint": True, "motion.fine_tune": False,
         "prior.weights": "zero123-xl", "prior.variant": "xl", "prior.guidance_scale": 5.0,
         "driving.kind": "svd", "driving.frames": 14,
         "refiner.kind": "video_to_video", "refiner.strength": 0.3, "static.start.kind": "blob",
         "mesh.mode": "per_frame", "mesh.grid": 128, "mesh.texture_size": 1024}  # fmt: skip
DIFFERENCES = {
    "paper": {},
    "paper-lgm": {"static.start.points": None, "static.start.kind": "lgm", "static.iterations": 0,
                  "deformation.half_side": pytest.approx(1.6 * 4 / 3), "motion.length_scale": pytest.approx(4 / 3)},
    "video": {"subject.max_frames": 32, "motion.iterations": 500},
    "video-fast": {"subject.max_frames": 16, "motion.iterations": 500, "motion.views": 1},
    "release": {"static.t_max_start": 1.0, "static.t_max_end": 0.0,
                "motion.t_max_start": 1.0, "motion.t_max_end": 0.0, "motion.t_max_limit": 0.5,
                "motion.guidance_weight": 4.0, "motion.alpha_weight": 0.0,
                "deformation.spatial": 64, "deformation.temporal": 25, "deformation.scales": (1, 2, 4, 8)},
    "reference": {"static.start.points": None, "motion.iterations": 500,
                  "static.t_max_start": 1.0, "static.t_max_end": 0.0,
                  "motion.t_max_start": 1.0, "motion.t_max_end": 0.0, "deformation.temporal": 12,
                  "motion.fine_tune": True, "deformation.endpoint": False,
                  "deformation.half_side": pytest.approx(1.6 * 4 / 3), "motion.length_scale": pytest.approx(4 / 3),
                  "prior.weights": "stable-zero123", "prior.variant": "stable",
                  "static.start.kind": "lgm", "static.iterations": 0},
}  # fmt: skip


def value_of(name: str, path: str) -> object:
    value: object = profile(name)
    for part in path.split("."):
        value = getattr(value, part, None)
    return value


@pytest.mark.parametrize("name", DIFFERENCES)
def test_profiles_have_the_numbers_that_they_are_named_after(name: str) -> None:
    expected = {**PAPER, **DIFFERENCES[name]}
    assert {path: value_of(name, path) for path in expected} == expected


def test_every_profile_but_the_preview_has_a_trained_prior() -> None:
    trained = {name for name in PROFILES if isinstance(profile(name).prior, Zero123PriorSettings)}
    assert trained == set(PROFILES) - {"preview", "open"}


def test_open_names_weights_that_may_be_sold_and_no_others() -> None:
    named = list(weights_in(profile("open").model_dump(mode="json")))
    assert named == ["wan2.2-ti2v-5b", "qwen-image-edit-2511", "qwen-multiple-angles"]
    assert {license_of(name).commercial for name in named} == {"yes"}


@pytest.mark.parametrize(
    ("changes", "owner"),
    [
        ({"prior.kind": "zero123", "prior.weights": "wan2.2-ti2v-5b"}, "prior.weights"),
        ({"prior.kind": "imagedream", "prior.weights": "Qwen/Qwen-Image-Edit-2511"}, "prior.weights"),
        ({"refiner.kind": "video_to_video", "refiner.model.weights": "ltx-video"}, "refiner.model.weights"),
    ],
)
def test_a_flow_matching_model_is_no_critic(changes: dict[str, str], owner: str) -> None:
    with pytest.raises(
        BadInput,
        match=rf"refused: {re.escape(owner)} = .* is a flow-matching model: it .*zero123-xl",
    ):
        revise(PREVIEW, changes)


@pytest.mark.parametrize(
    ("owner", "kind"),
    [("prior", {"prior.kind": "zero123"}), ("refiner.prior", {"refiner.kind": "image_to_image"})],
)
@pytest.mark.parametrize(
    ("weights", "variant", "right"),
    [("stable-zero123", "xl", "stable"), ("ashawkey/zero123-xl-diffusers", "stable", "xl")],
)
def test_known_weights_with_the_wrong_cameras_are_refused(
    owner: str, kind: dict[str, str], weights: str, variant: str, right: str
) -> None:
    changes = kind | {f"{owner}.weights": weights}
    with pytest.raises(BadInput, match=rf"set {owner}\.variant={right}"):
        revise(PREVIEW, changes | {f"{owner}.variant": variant})
    revise(PREVIEW, changes | {f"{owner}.variant": right})


@pytest.mark.parametrize(
    ("name", "changes", "wrong"),
    [
        ("video-fast", {}, "motion.views = 1"),
        ("preview", {"prior.memory_gb": 12}, "motion.views = 1"),
        ("open", {}, "motion.views = 1"),
        ("paper", {"static.views": 3}, "static.views = 3"),
    ],
)
def test_views_that_form_no_rings_for_imagedream_are_refused(name: str, changes: dict[str, object], wrong: str) -> None:
    changes = {"prior.kind": "imagedream", **changes}
    with pytest.raises(BadInput, match=rf"{re.escape(wrong)} does not fit prior\.kind = imagedream.*multiple of 4"):
        revise(profile(name), changes)
    settings = revise(profile(name), {**changes, "static.views": 4, "motion.views": 8})
    assert (settings.static.views, settings.motion.views) == (4, 8)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("paper", {}),
        ("video-fast", {"motion.guidance_weight": 0}),
        ("paper", {"static.views": 3, "static.iterations": 0}),
    ],
)
def test_imagedream_takes_views_that_form_rings_or_are_not_scored(name: str, changes: dict[str, object]) -> None:
    assert revise(profile(name), {"prior.kind": "imagedream", **changes}).prior.kind == "imagedream"


def test_the_rings_of_imagedream_are_those_of_the_library() -> None:
    assert IMAGEDREAM_RING == RING


def test_the_scale_of_lgm_is_that_of_the_library() -> None:
    assert value_of("reference", "motion.length_scale") == pytest.approx(WORLD_SCALE)


@pytest.mark.parametrize("name", ["preview", "quality"])
def test_our_own_profiles_fit_the_planes_to_the_gaussians(name: str) -> None:
    assert value_of(name, "deformation.half_side") == 0


def test_the_preview_keeps_the_strength_of_its_smoothness() -> None:
    weight = value_of("preview", "deformation.smoothness_weight")
    assert isinstance(weight, float) and 3 * weight == 0.01  # a mean over three planes, as it was measured


@pytest.mark.parametrize("turned", [False, True])
def test_another_kind_is_chosen_before_its_knobs_are_set(turned: bool) -> None:
    changes = {"prior.kind": "zero123", "prior.memory_gb": 12}
    if turned:
        changes = dict(reversed(changes.items()))
    assert revise(PREVIEW, changes).prior == Zero123PriorSettings(memory_gb=12)


def test_the_same_kind_again_changes_nothing() -> None:
    twelve = revise(profile("paper"), {"prior.memory_gb": 12})
    assert revise(twelve, {"prior.kind": "zero123"}) == twelve


@pytest.mark.parametrize(
    ("changed", "again"),
    [({"meshopt": True, "quality": 60}, False), ({"interpolation": "step"}, True), ({"moving_normals": False}, True)],
)
def test_only_options_that_the_motion_of_a_model_is_written_with_make_it_again(
    changed: dict[str, object], again: bool
) -> None:
    revised = revise(PREVIEW, {f"pack.gltf.{name}": value for name, value in changed.items()})
    assert (step_settings("animate_asset", revised) != step_settings("animate_asset", PREVIEW)) == again


def test_a_step_gets_its_sections_and_values_of_the_run_and_nothing_else() -> None:
    turned = revise(PREVIEW, {"subject.turn_deg": 12.5})
    assert step_settings("drive_video", turned).model_dump() == {
        "driving": turned.driving.model_dump(),
        "turn_deg": 12.5,
    }
    assert step_settings("pack_asset", turned, notes=("so",)).model_dump()["notes"] == ("so",)
    with pytest.raises(ValidationError, match="first_frame"):
        step_settings("pack_asset", turned, first_frame=3)
    with pytest.raises(ValidationError, match="less than or equal to 60"):
        step_settings("drive_video", turned).model_validate({"driving": {"kind": "warp"}, "turn_deg": 61})
    with pytest.raises(ValidationError, match="prior"):  # sections have no defaults: a request has them all
        type(step_settings("fit_gaussians", turned)).model_validate({"rasterizer": "cpu"})


@pytest.mark.parametrize(("old", "new"), RENAMED_SETTINGS.items())
def test_the_old_name_of_a_knob_is_refused_with_the_new_one(old: str, new: str) -> None:
    with pytest.raises(BadInput, match=re.escape(f"the setting {old} is {f'now {new}' if new else 'gone'}")):
        revise(PREVIEW, {old: 1})
    *path, last = old.split(".")
    tree: dict[str, object] = {last: 1}  # as in a record
    for name in reversed(path):
        tree = {name: tree}
    with pytest.raises(ValidationError, match=re.escape(f"the setting {old} is")):
        PipelineSettings.model_validate(tree)


def test_new_names_are_knobs_of_some_profile() -> None:
    svd_lgm = revise(profile("reference"), {})
    image = revise(profile("paper"), {"refiner.kind": "image_to_image"})
    for new in filter(None, RENAMED_SETTINGS.values()):
        path = new.split(" ")[0]
        found = []
        for settings in (PREVIEW, svd_lgm, image):
            value: object = settings
            for part in path.split("."):
                value = getattr(value, part, None)
            found.append(value)
        assert any(value is not None for value in found), path
