"""Roots of deployments: what a form may name, and that what lies elsewhere is neither read nor stored nor written."""

import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from fake_steps import PNG, bank_json
from waiting import wait_until

from dg4d_lib.errors import BadInput
from flows import deployments, home
from flows.deployments import Cutout, Options, PictureOptions, Sides
from flows.inputs.conversion_job import ConversionJob
from flows.serving import roots
from flows.serving.roots import OUTPUTS, SOURCES, Roots, granted
from steps.contract import Frozen

SECRET = "root:x:0:0:root:/root:/bin/bash\n"


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A root `in` with a picture, and secrets beside it."""
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")
    monkeypatch.setenv(SOURCES, str(tmp_path / "in"))
    monkeypatch.delenv(OUTPUTS, raising=False)
    monkeypatch.chdir(tmp_path)

    def no_server(*_: object) -> None:
        pytest.fail("a server is asked for what must be refused before")

    for module in ("flows.deployments.connect", "flows.convert.connect"):
        monkeypatch.setattr(module, no_server)
    for folder in ("in", "in2", "away"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "fox.png").write_bytes(PNG)
    return tmp_path


def stored() -> list[Path]:
    return [path for path in home.store().root.rglob("*") if path.is_file()]


def test_a_password_file_is_neither_read_from_elsewhere_nor_stored_from_a_root(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BadInput, match=rf"/etc/passwd lies outside .* read: {place}/in; .* set DG4D_SOURCES"):
        deployments.picture_to_4d.fn("/etc/passwd", str(place / "in" / "out"))
    monkeypatch.setenv(SOURCES, f"/etc{os.pathsep}{place}/in")
    with pytest.raises(BadInput, match="the file is a text file, whatever its name says; give pictures"):
        deployments.picture_to_4d.fn("/etc/passwd", str(place / "in" / "out"))
    with pytest.raises(BadInput, match="the file is a text file"):
        deployments.video_to_4d.fn("/etc/passwd", str(place / "in" / "out"))
    assert stored() == []
    assert not (place / "in" / "out").exists()


def test_a_server_of_this_machine_gets_no_request(place: Path) -> None:
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        for flow in (deployments.picture_to_4d, deployments.video_to_4d):
            with pytest.raises(BadInput, match="private network"):
                flow.fn(f"http://127.0.0.1:{server.server_port}/x.png", str(place / "in" / "out"))
        server.shutdown()
    assert asked == [] and stored() == []


def refused(call: Callable[[], Any], says: str = "lies outside") -> None:
    with pytest.raises(BadInput, match=says):
        call()
    assert stored() == []


@pytest.mark.parametrize(
    "given",
    ["{place}/away/fox.png", "{place}/in/../away/fox.png", "{place}/in2/fox.png", "away/fox.png", "{place}",
     "~root/fox.png", "~nobody-at-all/fox.png", "/dev/stdin", "/proc/self/environ", "{place}/in/link.png",
     "{place}/in/dir/fox.png", "{place}/in/circle", "{place}/home/server/server.json", "in/\0", "s3://bucket/in/a.png"],
)  # fmt: skip
def test_a_source_that_lies_elsewhere_is_refused(place: Path, given: str) -> None:
    (place / "in" / "link.png").symlink_to(place / "away" / "fox.png")
    (place / "in" / "dir").symlink_to(place / "away")
    (place / "in" / "circle").symlink_to(place / "in" / "circle")
    out = str(place / "in" / "out")
    for flow in (deployments.picture_to_4d, deployments.video_to_4d, deployments.catalog_to_4d, deployments.benchmark):
        refused(lambda flow=flow: flow.fn(given.format(place=place), out))  # type: ignore[misc]


ELSEWHERE_FORMS = [
    {"sides": Sides(views=("180={place}/away/fox.png",))},
    {"sides": Sides(turntable="{place}/in/dir/fox.png")},
    {"sides": Sides(cameras="{place}/away/bank.json")},
    {"sides": Sides(asset="{place}/away/fox.glb")},
    {"cutout": Cutout(mask="{place}/in/../away/fox.png")},
    {"cutout": Cutout(depth="{place}/in/../away/fox.png")},
    {"cutout": Cutout(layers="{place}/away/fox.png")},
]


@pytest.mark.parametrize("form", ELSEWHERE_FORMS)
def test_other_sides_models_and_masks_that_lie_elsewhere_are_refused(place: Path, form: dict[str, Frozen]) -> None:
    (place / "in" / "dir").symlink_to(place / "away")
    (place / "away" / "fox.glb").write_bytes(b"glTF")
    filled = {
        name: type(fields).model_validate_json(fields.model_dump_json().replace("{place}", str(place)))
        for name, fields in form.items()
    }
    for flow in (deployments.picture_to_4d, deployments.video_to_4d):
        refused(lambda flow=flow: flow.fn(str(place / "in/fox.png"), str(place / "in/out"), **filled))  # type: ignore[misc]


def test_a_form_with_a_model_and_views_is_refused(place: Path) -> None:
    inside = str(place / "in" / "fox.png")
    (place / "in" / "fox.glb").write_bytes(b"glTF")
    sides = Sides(asset=str(place / "in" / "fox.glb"), views=(f"180={inside}",))
    refused(lambda: deployments.picture_to_4d.fn(inside, str(place / "in" / "out"), sides=sides), "not both")


def test_model_mask_and_box_of_a_form_reach_the_job(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside = str(place / "in" / "fox.png")
    (place / "in" / "fox.glb").write_bytes(b"glTF same")
    jobs: list[ConversionJob] = []
    monkeypatch.setattr(deployments, "connect", lambda: None)
    monkeypatch.setattr(deployments, "convert_job", lambda job, folder, force: jobs.append(job))
    sides, cutout = Sides(asset=str(place / "in" / "fox.glb")), Cutout(mask=inside, box="1,2,30,40")
    deployments.picture_to_4d.fn(inside, str(place / "in" / "out"), sides=sides, cutout=cutout)
    (job,) = jobs
    assert job.asset is not None and job.mask == job.source
    assert job.settings.subject.box == (1, 2, 30, 40)


def test_depth_of_a_form_reaches_the_job(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside = str(place / "in" / "fox.png")
    jobs: list[ConversionJob] = []
    monkeypatch.setattr(deployments, "connect", lambda: None)
    monkeypatch.setattr(deployments, "convert_job", lambda job, folder, force: jobs.append(job))
    for form in (Cutout(depth=inside), Cutout(layers=inside)):
        deployments.picture_to_4d.fn(inside, str(place / "in" / "out"), cutout=form)
    assert [(job.depth == job.source, job.layers == job.source) for job in jobs] == [(True, False), (False, True)]


@pytest.mark.parametrize("given", ["in/fox.png", "{place}/in/fox.png", "{place}/in2/../in/fox.png", "in/inner.png"])
def test_a_source_in_a_root_is_found(place: Path, given: str) -> None:
    (place / "in" / "inner.png").symlink_to("fox.png")
    assert Roots.of_this_process().source(given.format(place=place)) == str(place / "in" / "fox.png")


@pytest.mark.parametrize(
    "given",
    ["{place}/away/*.png", "{place}/*/fox.png", "{place}/in/*/../../away/*.png", "*/fox.png",
     "{place}/in/../away/*.png", "{place}/dir[1]", "{place}/in/dir[2]"],
)  # fmt: skip
def test_a_pattern_that_leads_elsewhere_is_refused(place: Path, given: str) -> None:
    (place / "in" / "sub").mkdir()
    for link in (place / "dir[1]", place / "in" / "dir[2]"):
        link.symlink_to(place / "away")
    refused(
        lambda: deployments.catalog_to_4d.fn(given.format(place=place), str(place / "in" / "out")),
        r"lies outside|leads back by '\.\.'",
    )


def test_what_a_pattern_or_a_folder_finds_by_links_is_a_failed_row(place: Path) -> None:
    (place / "in" / "fox.png").unlink()
    (place / "in" / "dir").symlink_to(place / "away")
    (place / "in" / "link.png").symlink_to(place / "away" / "fox.png")
    for inputs, names in (("in/*.png", ["link"]), ("in/*/*.png", ["dir/fox"]), ("in", ["dir", "link"])):
        state = deployments.catalog_to_4d.fn(f"{place}/{inputs}", str(place / "in" / "out"))
        assert state.is_failed()
        rows = json.loads((place / "in" / "out" / "summary.json").read_text())["items"]
        assert [row["item"] for row in rows] == names
        assert all(row["status"] == "failed" and "leads out of the folder" in row["message"] for row in rows)
    assert stored() == []


@pytest.mark.parametrize(
    "row",
    [
        {"path": "../away/fox.png"},
        {"path": "fox.png", "video": "dir"},
        {"path": "fox.png", "bank": "dir", "prior.kind": "oracle"},
        {"path": "fox.png", "views": "180=dir/fox.png"},
        {"path": "fox.png", "turntable": "../away/fox.png"},
        {"path": "fox.png", "cameras": "dir/bank.json"},
        {"path": "fox.png", "mask": "dir/fox.png"},
        {"path": "fox.png", "depth": "dir/fox.png"},
        {"path": "fox.png", "layers": "dir/fox.png"},
        {"path": "fox.png", "asset": "../away/fox.glb"},
        {"asset": "dir/fox.glb"},
        {"path": "fox.png", "prior.kind": "zero123", "prior.weights": "{place}/away"},
        {"path": "fox.png", "set": "prior.kind=zero123; prior.weights={place}/away"},
        {"text": "a fox", "text.weights": "./away"},
    ],
)
def test_rows_of_a_list_name_nothing_elsewhere(place: Path, row: dict[str, str]) -> None:
    (place / "in" / "dir").symlink_to(place / "away")
    (place / "away" / "bank.json").write_text(bank_json("fox.png"))
    rows = [{key: value.format(place=place) for key, value in row.items()}]
    (place / "in" / "list.json").write_text(json.dumps(rows))
    assert deployments.catalog_to_4d.fn(str(place / "in" / "list.json"), str(place / "in" / "out")).is_failed()
    (found,) = json.loads((place / "in" / "out" / "summary.json").read_text())["items"]
    assert found["status"] == "failed"
    assert "lies outside" in found["message"] or "leads out of the folder" in found["message"]
    assert stored() == [] and not (place / "home" / "weights").exists()


def test_a_list_that_a_link_leads_to_speaks_of_files_beside_itself(place: Path) -> None:
    (place / "in" / "list.json").write_text(json.dumps([{"path": "gone.png"}]))
    (place / "away" / "list.json").symlink_to(place / "in" / "list.json")
    (place / "away" / "gone.png").write_bytes(PNG)
    assert deployments.catalog_to_4d.fn("away/list.json", str(place / "in" / "out")).is_failed()
    (found,) = json.loads((place / "in" / "out" / "summary.json").read_text())["items"]
    assert "in/gone.png does not exist" in found["message"]


@pytest.mark.parametrize("name", ["input/0.png", "view_15", "mesh.npz", "bank"])
def test_links_of_a_data_set_that_lead_elsewhere_are_refused(place: Path, name: str) -> None:
    thing = place / "in" / "data" / "newt"
    for folder in ("input", "view_15", "bank"):
        (thing / folder).mkdir(parents=True)
        (thing / folder / "0.png").write_bytes(PNG)
    (thing / "bank" / "bank.json").write_text(bank_json("0.png"))
    with zipfile.ZipFile(thing / "mesh.npz", "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY")
    (thing / name).rename(place / "away" / "moved")
    (thing / name).symlink_to(place / "away" / "moved")
    refused(lambda: deployments.benchmark.fn(str(place / "in" / "data"), str(place / "in" / "out"), bank=True))


SETTINGS = [
    "prior.weights={place}/away",
    "text.weights=~root",
    "refiner.weights=../etc",
    "refiner.weights=./away",
    'prior={{"kind": "zero123", "weights": "{place}/away"}}',
    "prior.views_weights=a/b/c",
    "score.clip_weights={place}/away",
    "driving.weights=away",
]


ELSEWHERE = "the folder of weights .* lies outside|unknown setting"  # refused before a file is looked at


@pytest.mark.parametrize("setting", SETTINGS)
def test_folders_of_weights_elsewhere_are_refused(place: Path, setting: str) -> None:
    settings = (setting.format(place=place),)
    inside, out = str(place / "in" / "fox.png"), str(place / "in" / "out")
    options, of_pictures = Options(settings=settings), PictureOptions(settings=settings)
    refused(lambda: deployments.picture_to_4d.fn(inside, out, of_pictures), ELSEWHERE)
    refused(lambda: deployments.video_to_4d.fn(inside, out, options), ELSEWHERE)
    refused(lambda: deployments.catalog_to_4d.fn(str(place / "in"), out, options=of_pictures), ELSEWHERE)
    refused(lambda: deployments.benchmark.fn(str(place / "in"), out, options=options), ELSEWHERE)
    assert not (place / "home" / "weights").exists()  # no link was made there, and no digest was taken


@pytest.mark.parametrize("name", ["zero123-xl", "somebody/pictures", "{place}/in/mine", "{place}/home/weights/lgm", ""])
def test_weights_by_name_in_a_root_and_in_the_folder_of_weights_may_be_named(place: Path, name: str) -> None:
    Roots.of_this_process().check_settings({"prior.weights": name.format(place=place)})


# Outputs


@pytest.mark.parametrize("out", ["/tmp/x", "away/out", "{place}/in/../out", "{place}/in/dir/out", "{place}/in2", "/"])
def test_an_output_elsewhere_is_refused(place: Path, out: str) -> None:
    (place / "in" / "dir").symlink_to(place / "away")
    inside, chosen = str(place / "in" / "fox.png"), out.format(place=place)
    calls = [(deployments.picture_to_4d, inside), (deployments.video_to_4d, inside)]
    calls += [(deployments.catalog_to_4d, str(place / "in")), (deployments.benchmark, str(place / "in"))]
    for flow, given in calls:
        refused(lambda flow=flow, given=given: flow.fn(given, chosen), r"may write: .* set DG4D_OUTPUTS")  # type: ignore[misc]


def test_outputs_of_their_own_are_no_sources(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(OUTPUTS, f"{place}/in2{os.pathsep}{place}/away")
    found = Roots.of_this_process()
    assert found.output(f"{place}/away/x") == place / "away" / "x"
    refused(lambda: found.output(f"{place}/in/x"), "may write")
    refused(lambda: found.source(f"{place}/away/fox.png"), "may read")


def test_our_own_folder_is_neither_read_nor_written_though_a_root_holds_it(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(SOURCES, str(place))
    found = Roots.of_this_process()
    assert found.output("away/x") == place / "away" / "x"
    refused(lambda: found.output("home/store/x"))
    refused(lambda: found.source("home/server/token"))


# Variables


def test_without_a_variable_it_is_the_current_folder(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(SOURCES)
    monkeypatch.chdir(place / "in")
    assert Roots.of_this_process() == Roots(sources=(f"{place}/in",), outputs=(f"{place}/in",))


def test_a_prefix_of_an_object_store_is_a_source_and_no_output(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SOURCES, f"s3://bucket/in/{os.pathsep}{place}/in{os.pathsep}s3://other")
    found = Roots.of_this_process()
    assert found.sources == ("s3://bucket/in", f"{place}/in", "s3://other")
    assert found.outputs == (f"{place}/in",)
    for good in ("s3://bucket/in/a.png", "s3://bucket/in", "s3://bucket/in/", "s3://other/x/y.png"):
        assert found.source(good) == found.inputs(good) == good
    for bad in ("s3://bucket/a.png", "s3://bucket/inn/a.png", "s3://bucket/in/../a.png", "s3://bucket/in/%2e%2e/a.png",
                "s3://bucket", "s3://others/a.png", "s3://"):  # fmt: skip
        refused(lambda bad=bad: found.source(bad))  # type: ignore[misc]
        refused(lambda bad=bad: found.inputs(bad))  # type: ignore[misc]


def test_a_worker_is_told_the_folders_of_the_option_else_of_the_variable_else_the_current_one(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told(*given: str) -> list[str]:
        return [roots.environment(given)[name] for name in (SOURCES, OUTPUTS)]

    assert told("in2", "s3://bucket") == [f"{place}/in2{os.pathsep}s3://bucket", f"{place}/in2"]
    assert told() == [f"{place}/in", f"{place}/in"]
    monkeypatch.setenv(OUTPUTS, "away")
    assert told() == [f"{place}/in", f"{place}/away"]
    monkeypatch.delenv(SOURCES)
    assert told() == [str(place), f"{place}/away"]
    refused(lambda: told("nowhere"), "--sources nowhere is not a folder")


def test_a_folder_with_the_separator_in_its_path_grants_no_other(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    odd = place / "in:away"
    (odd / "below").mkdir(parents=True)
    (place / "link").symlink_to(odd)
    for given in ("in:away", "link"):
        refused(partial(roots.environment, [given]), "separates folders")
    monkeypatch.chdir(odd)
    refused(lambda: roots.environment(["below"]), "separates folders")
    monkeypatch.delenv(SOURCES)
    refused(roots.environment, "in:away contains ':', which separates folders")
    assert Roots.of_this_process().sources == (str(odd),)


# Watched folders


def test_a_watched_folder_is_a_root_as_long_as_it_is_watched(place: Path) -> None:
    before = Roots.of_this_process()
    with granted(place / "away", place / "in2"):
        found = Roots.of_this_process()
        assert found.source(str(place / "away" / "fox.png")) and found.output(str(place / "in2" / "x"))
        (file,) = (place / "home" / "server" / "grants").iterdir()
        assert file.stat().st_mode & 0o777 == 0o600
        assert file.parent.stat().st_mode & 0o777 == 0o700
    assert Roots.of_this_process() == before
    refused(lambda: before.source(str(place / "away" / "fox.png")))


def test_what_a_killed_watcher_granted_ends_with_it(place: Path) -> None:
    program = (
        "import time; from pathlib import Path; from flows.serving.roots import granted\n"
        "with granted(Path('away'), Path('in2')): print('granted', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as watcher:
        assert watcher.stdout is not None and watcher.stdout.readline() == "granted\n"
        assert Roots.of_this_process().sources == (f"{place}/in", f"{place}/away")
        watcher.kill()
        watcher.wait()
    assert Roots.of_this_process().sources == (f"{place}/in",)
    assert list((place / "home" / "server" / "grants").iterdir()) == []


def test_the_command_grants_what_it_watches(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for asks_a_server in ("flows.convert.connect", "flows.serving.watching.check_registered"):
        monkeypatch.setattr(asks_a_server, lambda: None)
    monkeypatch.setattr("flows.serving.watching.FailedRuns._failed", lambda _: [])
    seen: list[Roots] = []

    def poll(*_: object) -> None:
        seen.append(Roots.of_this_process())
        raise KeyboardInterrupt

    monkeypatch.setattr("flows.serving.watching.Watcher.poll", poll)
    from typer.testing import CliRunner

    from flows import cli

    CliRunner().invoke(cli.app, ["watch", "away", "-o", "in2/out"])
    assert seen == [Roots(sources=(f"{place}/in", f"{place}/away"), outputs=(f"{place}/in", f"{place}/in2/out"))]
    wait_until(lambda: Roots.of_this_process().sources == (f"{place}/in",))


def test_the_studio_has_roots_in_the_home_and_opens_nothing_else_of_it(place: Path) -> None:
    uploads = place / "home" / "studio" / "uploads"
    refused(lambda: Roots.of_this_process().folder(str(uploads / "x" / "fox.png")), SOURCES)
    (uploads / "x").mkdir(parents=True)
    (uploads / "x" / "link.png").symlink_to(place / "home" / "server" / "auth")
    roots = Roots.of_this_process()
    assert roots.folder(str(uploads / "x" / "fox.png")) == str(uploads / "x" / "fox.png")
    assert roots.output(str(place / "home" / "studio" / "assets" / "fox")).name == "fox"
    for path in (uploads / "x" / "link.png", place / "home" / "store", uploads.parent / "assets"):
        refused(lambda path=path: roots.folder(str(path)), SOURCES)
    refused(lambda: roots.output(str(uploads / "x")), OUTPUTS)


def test_a_model_and_its_picture_lie_in_the_roots(place: Path) -> None:
    picture, out = str(place / "in" / "fox.png"), str(place / "in" / "out")
    refused(lambda: deployments.model_to_4d.fn("/etc/passwd", out))
    refused(lambda: deployments.model_to_4d.fn(picture, out, picture="/etc/passwd"))
