"""Conversions from Python, with fake steps and no server."""

import inspect
import json
import math
import os
import threading
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from conversions import EVERY_STEP, ran
from fake_steps import picture
from PIL import Image

import dg4d
from dg4d import making, progress
from dg4d.asset import Asset
from dg4d_lib.errors import BadInput
from flows import home
from flows.step_errors import StepBadInput


@pytest.fixture(autouse=True)
def loading(monkeypatch: pytest.MonkeyPatch, alone: Path) -> None:
    """Fake packages have no manifest: load their record alone."""

    def load(folder: Path) -> Asset:
        asset = Asset.__new__(Asset)
        asset.folder, asset._record = folder, json.loads((folder / "provenance.json").read_text())
        return asset

    monkeypatch.setattr(making, "load", load)


def words(path: str, text: str) -> str:
    Path(path).write_text(picture(text))
    return path


def test_processes_that_the_package_starts_get_absolute_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DG4D_HOME", "here")
    assert dg4d.__getattr__("DG4DError")
    assert os.environ["DG4D_HOME"] == str(tmp_path / "here")


def test_a_picture_becomes_an_asset_and_the_second_call_does_nothing(alone: Path) -> None:
    asset = dg4d.make(words("fox.png", "x"))
    assert (asset.folder, asset.name) == (Path("out/fox"), "fox")
    assert sorted(ran(alone)) == sorted(EVERY_STEP)
    dg4d.make("fox.png", out="elsewhere", seed=0)
    assert ran(alone) == []
    dg4d.make("fox.png", seed=1)
    assert "fit_motion" in ran(alone)


def test_a_video_needs_no_picture_and_names_its_asset(alone: Path) -> None:
    Path("run.v2").mkdir()
    for number in range(2):
        words(f"run.v2/{number}.png", f"moving {number}")
    assert dg4d.make(video="run.v2").name == "run.v2"


@pytest.mark.parametrize(
    "settings", [{"motion": {"iterations": 7}}, {"motion.iterations": 7}, {"motion": {"iterations": 7}, "mesh": {}}]
)
def test_settings_are_nested_or_dotted(settings: dict[str, Any]) -> None:
    asset = dg4d.make(words("fox.png", "x"), **settings)
    assert asset.provenance["recipe"]["settings"]["motion"]["iterations"] == 7
    assert asset.provenance["recipe"]["settings"]["motion"]["views"] == 1  # of the profile, as before


@pytest.mark.parametrize(
    ("call", "says"),
    [
        ({"motion": {"iteration": 7}}, "motion.iteration"),
        ({"motion": {"iterations": 0}}, "greater than or equal to 1"),
        ({"engine": "steam"}, "inline, prefect"),
        ({"profile": "perfect"}, "choose one of"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed = 1.5"),
        ({"views": {450: "fox.png"}}, "450 .* out of range"),
        ({"views": {(90, 89): "fox.png"}}, "out of range"),
        ({"views": {math.nan: "fox.png"}}, "out of range"),
        ({"views": {90: "none.png"}}, "none.png"),
        ({"views": ["fox.png"]}, 'views is a dict of azimuth to picture, for example {90: "right.png"}; given list'),
        ({"views": {"90": "fox.png"}}, """views has the direction '90'.*for example {90: "right.png"}"""),
        ({"views": {(90, 0, 0): "fox.png"}}, r"views has the direction \(90, 0, 0\)"),
        ({"views": {(90, "0"): "fox.png"}}, "views has the direction"),
        ({"views": {90: 5}}, "a view is a path, a PIL image or an array.*given int"),
        ({"views": {90: np.zeros((4, 4, 3), np.uint16)}}, "a view is .*type uint16"),
        ({"mask": 5}, "a mask is a path, a PIL image or an array.*given int"),
        ({"mask": np.zeros(4, bool)}, r"a mask is .*\(height, width\).*given ndarray of shape \(4,\)"),
        ({"depth": np.zeros((4, 4))}, "depth is a path; given ndarray"),
        ({"turntable": 5}, "turntable is a path; given int"),
        ({"video": [1]}, "video is a path; given list"),
        ({"out": 5}, "out is a path; given int"),
        ({"views": {(90, 0): "fox.png", 90: "fox.png"}}, "90"),
        ({"asset": "none.glb"}, "none.glb"),
        ({"asset": "fox.glb", "views": {180: "fox.png"}}, "not both"),
        ({"asset": "fox.glb", "turntable": "fox.png"}, "not both"),
        ({"video": "none.mp4"}, "none.mp4 does not exist"),
    ],
)
def test_wrong_arguments_are_refused_before_any_work(alone: Path, call: dict[str, Any], says: str) -> None:
    Path("fox.glb").write_bytes(b"glTF same")
    with pytest.raises(BadInput, match=says):
        dg4d.make(words("fox.png", "x"), **call)
    assert ran(alone) == [] and not Path("out").exists()


def test_a_text_of_another_type_is_refused() -> None:
    for text in (5, b"a fox", ["fox"]):
        with pytest.raises(BadInput, match="text"):
            dg4d.make(text=text)


def test_nothing_to_make_and_another_asset_in_the_way_are_refused() -> None:
    with pytest.raises(BadInput, match="nothing to make"):
        dg4d.make()
    dg4d.make(words("fox.png", "x"), out="here")
    with pytest.raises(BadInput, match="holds the asset 'fox'"):
        dg4d.make(words("cat.png", "y"), out="here")
    assert dg4d.make("cat.png", out="here", force=True).name == "cat"


@pytest.mark.parametrize(
    "given",
    [
        Image.new("RGBA", (40, 40), "red"),
        np.full((40, 40, 3), 200, np.uint8),
        np.full((40, 40, 4), 0.5, np.float32),
    ],
    ids=["PIL", "uint8", "float"],
)
def test_a_picture_in_memory_is_taken(given: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[Any] = []
    monkeypatch.setattr(making, "_run", lambda job, folder, engine, force: taken.append(job))
    monkeypatch.setattr(making, "load", taken.append)
    dg4d.make(given, name="drawn")
    job, folder = taken
    assert (job.item, folder) == ("drawn", Path("out/drawn"))


def written(given: Any, folder: Path, what: Literal["picture", "mask"] = "picture") -> Image.Image:
    with Image.open(making._written(given, folder, "x", what)) as found:
        found.load()
        return found


@pytest.mark.parametrize(
    "mode", ["L", "CMYK", "YCbCr", "LAB", "HSV", "I;16", "I;16B", "RGBa", "RGBX", "LA", "La", "P", "PA", "1"]
)
def test_pictures_of_every_mode_are_written(mode: str, tmp_path: Path) -> None:
    assert written(Image.new(mode, (6, 4)), tmp_path).size == (6, 4)


@pytest.mark.parametrize("mode", ["I;16", "I;16B"])
def test_pictures_of_16_bits_keep_their_values(mode: str, tmp_path: Path) -> None:
    assert written(Image.new(mode, (6, 4), 3000), tmp_path).getpixel((0, 0)) == 3000


@pytest.mark.parametrize("mode", ["I", "F"])
def test_pictures_without_a_range_of_values_are_refused(mode: str) -> None:
    with pytest.raises(BadInput, match=f"mode '{mode}'.*scale its values to 0 to 255.*I;16, .*CMYK"):
        dg4d.make(Image.new(mode, (40, 40), 100))


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (np.nan, "given NaN; replace"),
        (np.inf, "given values from 0 to inf; divide by 255"),
        (200.0, "given values from 0 to 200; divide by 255"),
        (1.01, "from 0 to 1.01"),
        (-0.5, "from -0.5 to 0"),
    ],
)
def test_floats_out_of_range_are_refused(value: float, says: str) -> None:
    given = np.zeros((40, 40, 3), np.float32)
    given[3, 4] = value
    for pixels in (given, np.full_like(given, value)) if math.isnan(value) else (given,):
        with pytest.raises(BadInput, match=rf"floats in \[0, 1\].*{says}"):
            dg4d.make(pixels)


def test_floats_are_written_as_8_bits_also_with_rounding_errors(tmp_path: Path) -> None:
    for value, expected in ((1 + 1e-6, 255), (-1e-6, 0), (0.5, 128), (1.0, 255)):
        assert written(np.full((4, 4, 3), value), tmp_path).getpixel((0, 0)) == (expected,) * 3


@pytest.mark.parametrize(
    "given",
    [
        np.eye(40, dtype=bool), 255 * np.eye(40, dtype=np.uint8), np.eye(40),
        Image.fromarray(255 * np.eye(40, dtype=np.uint8)),
        np.stack([255 * np.eye(40, dtype=np.uint8)] * 3, -1),
    ],
    ids=["bool", "uint8", "float", "PIL", "channels"],
)  # fmt: skip
def test_a_mask_in_memory_is_white_where_it_is_set(given: Any, tmp_path: Path) -> None:
    found = np.asarray(written(given, tmp_path, "mask").convert("L"))
    np.testing.assert_array_equal(found, 255 * np.eye(40, dtype=np.uint8))


def test_mask_and_views_in_memory_are_those_of_files(monkeypatch: pytest.MonkeyPatch) -> None:
    jobs: list[Any] = []
    monkeypatch.setattr(making, "_run", lambda job, folder, engine, force: jobs.append(job))
    monkeypatch.setattr(making, "load", lambda folder: folder)
    picture, side, mask = Image.new("RGB", (40, 40), "red"), Image.new("RGB", (40, 40), "blue"), np.eye(40) > 0
    Image.fromarray(mask).convert("L").save("mask.png")
    for number in range(2):
        views = {90: side, (180.0, 10): np.asarray(picture), np.float32(-90): words("left.png", "x")}
        dg4d.make(picture, mask=mask, views=views, out=str(number))
    dg4d.make(picture, mask="mask.png", out="other")
    assert jobs[0] == jobs[1]  # names of temporary files do not count
    with Image.open(home.store().path(jobs[0].mask)) as one, Image.open("mask.png") as other:
        np.testing.assert_array_equal(np.asarray(one.convert("L")), np.asarray(other))
    with zipfile.ZipFile(home.store().path(jobs[0].views)) as archive:
        given = json.loads(archive.read("views.json"))["views"]
    assert [(one["azimuth"], one["elevation"]) for one in given] == [(90, 0), (180, 10), (-90, 0)]
    assert [one["name"] for one in given] == ["view-1.png", "view-2.png", "left.png"]


@pytest.mark.parametrize(
    "given", [[[1], [1, 2]], torch.zeros(4, 4, 3, requires_grad=True), torch.zeros(4, 4, 3, dtype=torch.bfloat16)]
)
def test_what_numpy_cannot_convert_is_refused(given: Any) -> None:
    with pytest.raises(BadInput, match=r"a picture is a path, a PIL image or an array; given .*cannot convert"):
        dg4d.make(given)


def test_a_pil_image_of_a_broken_or_closed_file_is_refused() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    Image.fromarray(noise).save("noise.png")
    Path("broken.png").write_bytes(Path("noise.png").read_bytes()[:2000])
    with Image.open("broken.png") as broken, pytest.raises(BadInput, match="a PIL image cannot be read"):
        dg4d.make(broken)
    closed = Image.fromarray(noise)
    closed.close()
    with pytest.raises(BadInput, match="a PIL image cannot be read"):
        dg4d.make(closed)


def test_a_picture_in_memory_is_turned_upright(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # orientation
    Image.new("RGB", (8, 4)).save(tmp_path / "phone.jpg", exif=exif)
    with Image.open(tmp_path / "phone.jpg") as phone:
        assert written(phone, tmp_path).size == (4, 8)


@pytest.mark.parametrize(
    "given",
    [
        np.zeros((4, 4)),
        np.zeros((4, 4, 2)),
        np.zeros((0, 4, 3)),
        np.zeros((4, 4, 3), np.uint16),
        np.full((4, 4, 3), "a"),
        object(),
    ],
)
def test_other_things_in_memory_are_refused(given: Any) -> None:
    with pytest.raises(BadInput, match="a picture is a path, a PIL image or an array"):
        dg4d.make(given)


def test_progress_counts_steps_and_knows_the_time_left_from_the_second_run_on() -> None:
    first: list[dg4d.Progress] = []
    dg4d.make(words("fox.png", "x fit_motion=sleep:0.3"), on_progress=first.append)
    started = [one for one in first if one.kind == "started"]
    assert {one.number for one in started} == set(range(1, 9)) and {one.of for one in first} == {8}
    assert next(one for one in first if one.kind == "progress").values["loss"] > 0
    assert first[-1].kind == "finished" and first[-1].seconds_left == 0.0
    second: list[dg4d.Progress] = []
    dg4d.make(words("cat.png", "y"), on_progress=second.append)
    assert second[0].seconds_left is not None and second[0].seconds_left > 0.3
    assert str(second[0]).startswith("step 1 of 8: prepare_subject started, about ")


def test_an_exception_of_the_callback_cancels_the_conversion(alone: Path) -> None:
    class Cancelled(Exception):
        pass

    calls = []

    def cancel(one: dg4d.Progress) -> None:
        calls.append(one)
        if one.step == "fit_gaussians":
            raise Cancelled

    with pytest.raises(Cancelled):
        dg4d.make(words("fox.png", "x"), on_progress=cancel)
    assert "fit_motion" not in ran(alone) and not Path("out/fox").exists()
    assert [one.step for one in calls].count("fit_gaussians") == 1
    assert dg4d.make("fox.png").name == "fox"


def test_a_failed_step_is_an_error_with_its_message() -> None:
    with pytest.raises(StepBadInput, match="the picture is empty"):
        dg4d.make(words("fox.png", "x prepare_subject=bad:empty"))


def test_a_batch_keeps_what_succeeded(alone: Path) -> None:
    Path("a").mkdir()
    pictures = [words("one.png", "1"), words("two.png", "2 fit_motion=bad:broken"), words("a/one.png", "3")]
    done = dg4d.batch([*pictures, "none.png"], out="all", workers=2)
    assert sorted(done.assets) == ["one-png", "one-png-2"]
    assert set(done.errors) == {"two", "none"}
    assert isinstance(done.errors["two"], StepBadInput) and "does not exist" in str(done.errors["none"])
    assert all((Path("all") / name / "provenance.json").exists() for name in done.assets)


def test_a_batch_goes_on_without_a_picture_in_memory_that_cannot_be_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(making, "_run", lambda job, folder, engine, force: None)
    monkeypatch.setattr(making, "load", lambda folder: Asset.__new__(Asset))
    done = dg4d.batch([np.full((40, 40, 3), 9.0), Image.new("RGB", (40, 40)), 5], out="all")
    assert set(done.assets) == {"picture-2"} and set(done.errors) == {"picture-1", "picture-3"}
    assert "divide by 255" in str(done.errors["picture-1"]) and isinstance(done.errors["picture-3"], BadInput)


@pytest.mark.parametrize("call", [{"pictures": Image.new("RGB", (4, 4))}, {"pictures": None}, {"out": 5}])
def test_a_batch_of_what_is_not_a_list_is_refused(call: dict[str, Any]) -> None:
    with pytest.raises(BadInput, match=r"given (Image|NoneType|int)"):
        dg4d.batch(**{"pictures": ["fox.png"], **call})


def test_a_batch_of_a_folder_names_items_as_the_command_does() -> None:
    Path("photos/deep").mkdir(parents=True)
    words("photos/fox.png", "1")
    words("photos/deep/cat.png", "2")
    assert set(dg4d.batch("photos", out="all").assets) == {"fox", "deep/cat"}
    with pytest.raises(BadInput, match="empty"):
        dg4d.batch([])


def test_conversions_in_threads_report_to_their_own_callbacks() -> None:
    seen: dict[str, list[dg4d.Progress]] = {"a": [], "b": []}
    for folder in seen:
        Path(folder).mkdir()
        words(f"{folder}/fox.png", f"{folder} fit_motion=sleep:0.2")

    def convert(folder: str) -> None:
        dg4d.make(f"{folder}/fox.png", out=f"out/{folder}", on_progress=seen[folder].append)

    threads = [threading.Thread(target=convert, args=(folder,)) for folder in seen]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for events in seen.values():  # the assets have one name
        assert sorted(one.step for one in events if one.kind == "finished") == sorted(EVERY_STEP)


def test_the_engine_of_prefect_connects_and_runs_the_flow(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    monkeypatch.setattr(making, "connect", lambda: calls.append("connect"))
    monkeypatch.setattr(making, "convert_job", lambda job, folder, force: calls.append(f"{job.item} in {folder}"))
    monkeypatch.setattr(making, "load", lambda folder: folder)
    dg4d.make(words("fox.png", "1"), engine="prefect")
    assert calls == ["connect", "fox in out/fox"]


def test_every_public_name_is_there_and_documented() -> None:
    for name in dg4d.__all__:
        assert inspect.getdoc(getattr(dg4d, name)), name
    assert set(dg4d.__all__) <= set(dir(dg4d))
    with pytest.raises(AttributeError, match="it has: Asset"):
        _ = dg4d.nothing
    assert dg4d.Progress is progress.Progress
