"""Reference of settings: complete, true, and a help for misspelt names."""

import json
import re

import pytest

from dg4d_lib.errors import BadInput
from flows.inputs import setting_reference
from flows.inputs.manifest import parse_changes
from flows.inputs.setting_reference import (
    Setting,
    all_settings,
    as_json,
    check_changes,
    check_names,
    find_settings,
    value_in,
)
from steps.profiles import PROFILES, PipelineSettings, profile, revise

SETTINGS = [one for one in all_settings() if not one.name.startswith("score.")]


def test_every_setting_has_a_meaning_and_a_range() -> None:
    assert [one.name for one in all_settings() if not one.meaning or not one.allowed] == []


@pytest.mark.parametrize("one", SETTINGS, ids=lambda one: f"{one.name}[{one.only_with}]")
def test_every_setting_can_be_set_to_its_default(one: Setting) -> None:
    choice, _, kind = one.only_with.partition("=")
    settings = revise(PipelineSettings(), {choice: kind} if choice else {})
    assert revise(settings, {one.name: json.loads(one.default)}) == settings


@pytest.mark.parametrize("name", PROFILES)
def test_a_setting_of_another_kind_is_refused_with_its_kind(name: str) -> None:
    """No name of docs/settings.md is unknown, in any profile."""
    for one in SETTINGS:
        choice = one.only_with.partition("=")[0]
        try:
            revise(profile(name), {one.name: json.loads(one.default)})
        except BadInput as error:
            other = rf"{re.escape(one.name)} exists with \S+\.kind=.*; \S+\.kind is \w+\. Add `--set \S+\.kind=\w+`\."
            refused = choice and str(error).startswith("settings refused: ")  # the default of another kind
            assert re.fullmatch(other, str(error)) or refused, error


def test_the_kinds_that_have_a_setting_are_named() -> None:
    with pytest.raises(BadInput, match=r"driving\.height exists with driving\.kind=svd or diffusers; .* is warp\. Add"):
        revise(profile("preview"), {"driving.height": 512})
    with pytest.raises(
        BadInput, match=r"prior\.variant exists with refiner\.kind=image_to_image; refiner\.kind is ident"
    ):
        revise(profile("preview"), {"refiner.prior.variant": "xl"})
    with pytest.raises(BadInput, match=r"unknown setting 'static\.start\.kind\.name'"):
        revise(profile("preview"), {"static.start.kind.name": 1})


@pytest.mark.parametrize("section", [5, None, [1], {}])
def test_a_section_that_was_replaced_by_a_value_has_no_kinds(section: object) -> None:
    with pytest.raises(BadInput, match=r"unknown setting 'driving\.height'"):
        revise(profile("preview"), {"driving": section, "driving.height": 512})


@pytest.mark.parametrize("text", ["\x1b]0;title\x07", "1" * 10_000, "]' ; rm '", "x"])
def test_the_advice_to_write_a_list_repeats_numbers_only(text: str) -> None:
    with pytest.raises(BadInput, match=r"write for example `--set 'subject\.box=\[\.\.\.\]'`$"):
        revise(profile("preview"), {"subject.box": text})


@pytest.mark.parametrize("name", PROFILES)
def test_every_value_of_a_profile_is_in_the_reference(name: str) -> None:
    chosen = profile(name)
    listed = {one.name for one in SETTINGS if value_in(chosen, one)}

    def leaves(tree: object, path: str) -> set[str]:
        if isinstance(tree, dict):
            return {leaf for key, value in tree.items() for leaf in leaves(value, f"{path}.{key}".lstrip("."))}
        return {path}

    assert leaves(chosen.model_dump(mode="json"), "") == listed


@pytest.mark.parametrize(
    ("given", "nearest"),
    [
        ("motion.iteration", "did you mean motion.iterations?"),
        ("mtion.iterations", "did you mean motion.iterations?"),
        ("prior.wieghts", "did you mean prior.weights?"),
        ("iterations", "iterations?"),
        ("max_faces", "did you mean mesh.max_faces?"),
        ("motion.motion", "did you mean driving.motion?"),
        ("qqq", "`dg4d settings` lists the names"),
    ],
)
def test_a_misspelt_setting_gets_the_nearest_name_and_no_list(given: str, nearest: str) -> None:
    with pytest.raises(BadInput) as caught:
        parse_changes([f"{given}=1"])
    assert nearest in str(caught.value) and len(str(caught.value)) < 150


@pytest.mark.parametrize(
    ("given", "example"),
    [
        ("driving=wave", "driving.motion=wave"),
        ("motion=wave", "driving.motion=wave"),
        ("static.start=blob", "static.start.kind=blob"),
        ("score=3", "score."),
    ],
)
def test_a_group_of_settings_takes_no_single_value(given: str, example: str) -> None:
    with pytest.raises(BadInput, match=f"is a group of settings; name one, for example {example}.*lists them$"):
        parse_changes([given])
    assert parse_changes(['driving={"kind":"svd"}']) == {"driving": {"kind": "svd"}}


def test_old_names_pass_to_the_message_that_explains_them() -> None:
    check_names(["motion.ladder", "prior", "static.start"])
    with pytest.raises(BadInput, match=r"motion\.ladder is now motion\.resolution_schedule"):
        revise(profile("preview"), parse_changes(["motion.ladder=3"]))


def test_further_rows_of_a_manifest_do_not_list_all_settings_again(monkeypatch: pytest.MonkeyPatch) -> None:
    changes = {"static.iterations": 200, "prior": {"kind": "learned"}}
    check_changes(changes)
    monkeypatch.setattr(setting_reference, "all_settings", lambda: pytest.fail("listed again"))
    check_changes(changes)


def test_a_section_lists_its_settings_and_a_name_one_per_kind() -> None:
    assert {one.name.split(".")[0] for one in find_settings("mesh")} == {"mesh"}
    assert [one.only_with for one in find_settings("prior.weights")] == ["prior.kind=zero123", "prior.kind=imagedream"]


def test_the_summary_of_a_kind_begins_with_a_small_letter_unless_with_a_name() -> None:
    (one,) = find_settings("prior.kind")
    assert "geometric: renders of" in one.meaning
    assert "zero123: Zero-1-to-3: " in one.meaning and "imagedream: ImageDream: " in one.meaning


def test_bounds_are_those_of_the_models() -> None:
    (one,) = find_settings("motion.t_max_start")
    assert one.allowed == "number, above 0.02, at most 1"
    assert find_settings("pack.lods")[0].allowed == "list: each number, above 0, below 1, at most 8 long"
    assert as_json((1, "a")) == '[1,"a"]'
