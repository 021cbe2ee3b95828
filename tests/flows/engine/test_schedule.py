"""Positions of steps and the time left, with a clock of our own."""

from pathlib import Path
from typing import Any

import pytest

from flows.engine.events import StepEvent
from flows.engine.schedule import USUAL_S, Schedule, durations_file, format_left, keep_durations, load_durations
from flows.tasks import TASKS

STEPS = ["prepare_subject", "drive_video", "fit_gaussians", "fit_motion", "plan_mesh", "extract_mesh"]


def event(step: str, kind: str, **facts: Any) -> StepEvent:
    return StepEvent("newt", step, kind, **facts)


def run(schedule: Schedule, step: str, start: float, end: float, cached: bool = False) -> None:
    schedule.note(event(step, "started"), start)
    schedule.note(event(step, "finished", seconds=end - start, cached=cached), end)


def test_a_step_knows_its_place() -> None:
    schedule = Schedule(STEPS)
    assert schedule.position("fit_motion") == "step 4 of 6"
    assert schedule.position("extract_mesh 2/3") == "step 6 of 6"
    assert schedule.position("join_meshes") == ""


def test_nothing_is_predicted_before_anything_is_known() -> None:
    schedule = Schedule(STEPS)
    assert schedule.seconds_left(0.0) is None
    schedule.note(event("prepare_subject", "started"), 0.0)
    assert schedule.seconds_left(1.0) is None


def test_a_machine_of_half_the_speed_needs_twice_the_time() -> None:
    schedule, rest = Schedule(STEPS), sum(USUAL_S[name] for name in STEPS[3:])
    clock = 0.0
    for step in STEPS[:3]:
        run(schedule, step, clock, clock + 2 * USUAL_S[step])
        clock += 2 * USUAL_S[step]
    assert schedule.seconds_left(clock) == pytest.approx(2 * rest)


def test_every_step_of_a_conversion_has_a_usual_duration() -> None:
    assert vars(TASKS).keys() - {"finished"} <= USUAL_S.keys()


def test_an_earlier_conversion_of_a_model_predicts_the_next() -> None:
    earlier = {"prepare_asset": 5.5, "drive_video": 0.9, "animate_asset": 97.0, "pack_asset": 11.0, "check_asset": 1.8}
    assert Schedule([*earlier], earlier).seconds_left(0.0) == pytest.approx(sum(earlier.values()))


@pytest.mark.parametrize("earlier", [None, {name: USUAL_S[name] for name in STEPS}])
def test_a_long_preparation_does_not_multiply_the_other_steps(earlier: dict[str, float] | None) -> None:
    schedule, rest = Schedule(STEPS, earlier), sum(USUAL_S[name] for name in STEPS[3:])
    schedule.note(event("prepare_subject", "progress", done=0, total=3), 0.0)
    schedule.note(event("prepare_subject", "progress", done=2, total=3), 40.0)
    left = schedule.seconds_left(40.0)
    assert left is None if earlier is None else left == pytest.approx(20 + sum(USUAL_S[name] for name in STEPS[1:]))
    run(schedule, "prepare_subject", 0.0, 60.0)
    run(schedule, "drive_video", 60.0, 61.0)
    run(schedule, "fit_gaussians", 61.0, 71.0)
    assert schedule.seconds_left(71.0) == pytest.approx(rest)


def test_a_running_step_is_predicted_by_its_own_pace() -> None:
    schedule = Schedule(["fit_motion"], {"fit_motion": 10.0})
    schedule.note(event("fit_motion", "started"), 0.0)
    schedule.note(event("fit_motion", "progress", done=25, total=100), 50.0)
    assert schedule.seconds_left(50.0) == pytest.approx(150.0)


def test_an_earlier_conversion_predicts_from_the_start_and_cached_steps_take_no_time() -> None:
    earlier = {name: 10.0 for name in STEPS}
    schedule = Schedule(STEPS, earlier)
    assert schedule.seconds_left(0.0) == pytest.approx(60.0)
    run(schedule, "prepare_subject", 0.0, 0.01, cached=True)
    assert schedule.seconds_left(0.01) == pytest.approx(50.0)
    assert schedule.durations() == {}


def test_a_divided_step_ends_with_its_last_part() -> None:
    schedule = Schedule(["extract_mesh"], {"extract_mesh": 10.0})
    run(schedule, "extract_mesh 1/2", 0.0, 4.0)
    assert schedule.seconds_left(4.0) == pytest.approx(6.0)
    run(schedule, "extract_mesh 2/2", 1.0, 8.0)
    assert schedule.seconds_left(8.0) == 0.0
    assert schedule.durations() == {"extract_mesh": 8.0}


def test_steps_that_are_not_planned_do_not_count() -> None:
    schedule = Schedule(["fit_motion"], {"fit_motion": 10.0})
    run(schedule, "draw_picture", 0.0, 5.0)
    assert (schedule.finished, schedule.durations(), schedule.position("draw_picture")) == (0, {}, "")
    assert schedule.seconds_left(5.0) == pytest.approx(10.0)


def test_a_step_of_no_known_length_may_report_progress() -> None:
    schedule = Schedule(["fit_motion"], {"fit_motion": 10.0})
    schedule.note(event("fit_motion", "progress", done=0, total=0), 0.0)
    assert schedule.seconds_left(0.0) == pytest.approx(10.0)


def test_durations_are_kept_by_profile_and_what_is_broken_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "new"))
    assert load_durations("preview") == {}
    keep_durations("preview", {"fit_motion": 30.0, "plan_mesh": 1.0})
    keep_durations("paper", {"fit_motion": 900.0})
    keep_durations("preview", {"fit_motion": 40.0})
    assert load_durations("preview") == {"fit_motion": 40.0, "plan_mesh": 1.0}
    assert load_durations("paper") == {"fit_motion": 900.0}
    durations_file().write_text('{"preview": {"fit_motion": "x", "plan_mesh": -1, "drive_video": NaN}, "paper": 3}')
    assert load_durations("preview") == load_durations("paper") == {}
    durations_file().write_text("torn")
    assert load_durations("preview") == {}


@pytest.mark.parametrize("broken", ['"x"', "-1", "1e999", "NaN", "true", "null"])
def test_only_a_number_of_seconds_is_a_duration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    keep_durations("preview", {"fit_motion": 30.0})
    durations_file().write_text(durations_file().read_text().replace("30.0", broken))
    assert load_durations("preview") == {}


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, ""), (0.0, ""), (0.1, "about 5 s left"), (41.0, "about 45 s left"), (121.0, "about 3 min left")],
)
def test_times_are_rounded_for_people(seconds: float | None, text: str) -> None:
    assert format_left(seconds) == text
