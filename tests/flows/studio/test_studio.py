"""The studio: its routes, its pages in Chromium, and a restart of its server; one server and one worker for all."""

import asyncio
import hashlib
import json
import re
import zipfile
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from fake_steps import PNG, picture
from PIL import Image
from starlette.requests import Request
from waiting import wait_until

from flows import home
from flows.engine.versions import Version, VersionStep
from flows.serving.auth import Sessions, basic
from flows.serving.workers import Worker, running
from flows.studio import gallery
from flows.studio.changes import Changes
from flows.studio.drafts import Draft
from flows.studio.server_api import TAG, ServerApi
from steps.contract import ArtifactRef, digest_of
from tests.clients.node import run_node
from tests.flows.studio.conftest import Client

READING = ["", "/activity", "/static/studio.js", "/drafts/0123456789abcdef", "/assets/x", "/thumbnails/00/1"]
CHANGES = ["/drafts", "/drafts/0123456789abcdef/runs", "/runs/x/cancel", "/runs/x/retry", "/assets/x/again"]
UNKNOWN = "00000000-0000-0000-0000-000000000000"
MANY = 200
FIRST_PAINT_MS = 1000


@pytest.mark.parametrize("path", READING)
def test_a_page_is_read_by_those_who_are_signed_in(studio: Client, path: str) -> None:
    assert studio.ask(path)[0] == 401
    assert studio.ask(path, Authorization=basic("dg4d:guess"))[0] == 401
    assert studio.ask(path, **studio.secret)[0] in {200, 404}
    status, headers, _ = studio.ask(path, Sec_Fetch_Dest="document", Sec_Fetch_Site="same-origin")
    assert (status, headers["location"]) == (303, f"/dg4d/login?next=/dg4d/studio{path}")


@pytest.mark.parametrize("path", CHANGES)
def test_a_change_needs_the_secret_itself(studio: Client, path: str) -> None:
    sessions = Sessions(studio.server.auth_string())
    cookie = {"Cookie": f"{sessions.cookie}={sessions.issue()}", "Sec_Fetch_Site": "same-origin"}
    assert studio.ask("", **cookie)[0] == 200  # the session of a browser reads
    assert studio.ask(path, "POST", {}, **studio.token)[0] == 401
    assert studio.ask(path, "POST", {}, **studio.token, **cookie)[0] == 401
    assert studio.ask(path, "POST", {}, **studio.secret)[0] == 403  # without the token against forged requests


@pytest.mark.parametrize("headers", [{"Origin": "http://evil.example"}, {"Sec_Fetch_Site": "same-site"}])
def test_a_change_by_a_page_of_another_origin_is_refused(studio: Client, headers: dict[str, str]) -> None:
    before = sorted(home.uploads().iterdir())
    assert studio.ask("/drafts", "POST", {}, **studio.secret, **studio.token, **headers)[0] == 403
    assert sorted(home.uploads().iterdir()) == before


def test_the_page_runs_its_own_script_alone_and_is_not_framed(studio: Client) -> None:
    _, headers, content = studio.ask("", **studio.secret)
    policy = headers["content-security-policy"]
    assert "script-src 'self';" in policy and "frame-ancestors 'none'" in policy and "unsafe" not in policy
    assert not re.search(rb"<script(?![^>]* src=)|<style|\son\w+=|\sstyle=", content)
    assert b"http" not in content.replace(b"http-equiv", b"")  # nothing of other hosts


@pytest.mark.parametrize("path", ["/drafts/../x", "/drafts/0123", "/drafts/0123456789abcdef", f"/runs/{UNKNOWN}",
                                  f"/runs/{UNKNOWN}/status", "/runs/x", "/runs/%00", "/runs/%0d%0a",
                                  "/assets/asset-none-000000",
                                  "/static/..%2froutes.py", "/static/routes.py",
                                  f"/thumbnails/{'0' * 64}/7", "/entries/zz/7/x",
                                  f"/entries/{'0' * 64}/7/x"])  # fmt: skip
def test_an_address_of_nothing_is_not_found(studio: Client, path: str) -> None:
    status, content = studio.read(path)
    assert status == 404 and b"Traceback" not in content


def test_a_player_gets_ranges_of_a_film_inside_a_zip(studio: Client) -> None:
    content = BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("films/1.mp4", bytes(range(100)))
        archive.writestr("../out.mp4", b"x")
    ref = home.store().put_bytes(content.getvalue(), "application/zip")
    folder = f"/entries/{ref.digest.removeprefix('sha256:')}/{ref.size_bytes}"
    for _ in range(2):
        status, headers, part = studio.ask(f"{folder}/films/1.mp4", Range="bytes=10-19", **studio.secret)
        assert (status, headers["content-range"], part) == (206, "bytes 10-19/100", bytes(range(10, 20)))
    status, headers, nothing = studio.ask(f"{folder}/films/1.mp4", "HEAD", **studio.secret)
    assert (status, headers["content-length"], headers["content-type"], nothing) == (200, "100", "video/mp4", b"")
    assert headers["content-disposition"] == 'inline; filename="1.mp4"'
    assert studio.ask("", "HEAD", **studio.secret)[0] == 200
    assert {studio.read(f"{folder}/{name}")[0] for name in ("films", "films/", "films/2.mp4", "..%2Fout.mp4")} == {404}


@pytest.mark.parametrize("path", ["/drafts/0123456789abcdef/files?name=x", f"/runs/{UNKNOWN}/cancel",
                                  f"/runs/{UNKNOWN}/retry", "/assets/asset-none-000000/again",
                                  "/drafts/0123456789abcdef/runs"])  # fmt: skip
def test_a_change_of_nothing_is_not_found(studio: Client, path: str) -> None:
    body = {"version": "x"} if path.endswith("again") else {}
    assert studio.post(path, body)[0] == 404


@pytest.mark.parametrize(
    ("name", "content", "status", "says"),
    [
        ("fox.png", b"", 422, "empty"),
        ("fox.png", b"hello, I am text", 422, "text file"),
        ("fox.png", b"MZ\x90\0" * 40, 422, "not known here"),
        ("page.html", b"<script>alert(1)</script>", 422, "text file"),
        ("fox.glb", b"\x89PNG\r\n\x1a\n", 422, "does not start as"),
        ("fox.zip", b"PK\3\4 broken", 422, "broken"),
        ("large.png", PNG + bytes(2**20), 413, "DG4D_STUDIO_UPLOAD_MB"),
    ],
)
def test_a_hostile_upload_gets_a_sentence_and_leaves_nothing(
    studio: Client, name: str, content: bytes, status: int, says: str
) -> None:
    draft = studio.draft()
    answered, said = studio.post(f"/drafts/{draft}/files?name={name}", content)
    assert (answered, says in said["detail"]) == (status, True), said
    assert str(home.uploads()) not in said["detail"]
    assert list((home.uploads() / draft / "files").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("..%2F..%2Fetc%2Fpasswd.png", "passwd.png"),
        ("C:%5Cpictures%5Cfox.PNG", "fox.png"),
        ("a%00b%0A.png", "ab.png"),
        ("", "asset"),
        ("%2E%2E", "asset"),
        ("x" * 400 + ".png", "x" * 190 + ".png"),
    ],
)
def test_the_name_of_an_upload_leads_nowhere(studio: Client, name: str, kept: str) -> None:
    draft = studio.draft((name, PNG))
    assert [path.name for path in (home.uploads() / draft / "files").iterdir()] == [kept]
    assert studio.post(f"/drafts/{draft}/files?name={name}", PNG)[1]["name"] != kept  # no file replaces another


@pytest.mark.parametrize("wanted", [{"profile": "no such"}, {"seed": -1}, {"settings": ["rm -rf"]}, {"box": [1, 2]},
                                    {"views": [{"file": "none.png", "azimuth": 90}]}, {"other": 1},
                                    {"masked": True}, {"name": "\x00"}])  # fmt: skip
def test_choices_that_cannot_be_are_refused_before_a_run_starts(studio: Client, wanted: dict[str, object]) -> None:
    draft = studio.draft(("fox.png", PNG))
    status, said = studio.post(f"/drafts/{draft}/runs", wanted)
    assert status in {404, 422} and said["detail"]


def test_a_matte_gets_the_size_of_its_source(studio: Client) -> None:
    draft = studio.draft(("fox.png", PNG))
    for content, status in ((b"no picture", 422), (gray(0), 422), (gray(255), 201)):
        assert studio.post(f"/drafts/{draft}/mask", content)[0] == status
    with Image.open(home.uploads() / draft / "mask.png") as mask:
        assert (mask.size, mask.mode) == ((8, 6), "L")  # of the fake source
    headers = {**studio.secret, **studio.token}

    def save(_: int) -> int:
        return studio.ask(f"/drafts/{draft}/mask", "POST", gray(255), **headers)[0]

    with ThreadPoolExecutor(4) as side:  # the page saves it again with every order
        assert set(side.map(save, range(12))) == {201}
    assert [path.name for path in (home.uploads() / draft).glob(".*")] == []


def gray(value: int) -> bytes:
    content = BytesIO()
    Image.new("L", (16, 12), value).save(content, "PNG")
    return content.getvalue()


@pytest.mark.slow
def test_a_draft_becomes_an_asset_that_is_found_downloaded_and_made_again(studio: Client) -> None:
    draft = studio.draft(("wolf.png", picture("a wolf that is torn").encode()), ("side.png", PNG))
    cut = studio.post(f"/drafts/{draft}/cutout", {"box": [1, 1, 4, 4]})[1]
    assert (cut["width"], cut["height"]) == (8, 6)
    assert studio.post(f"/drafts/{draft}/mask", gray(255))[0] == 201
    wanted = {"name": "wolf", "motion": "wave", "masked": True, "views": [{"file": "side.png", "azimuth": 90}]}
    status = studio.ended(studio.post(f"/drafts/{draft}/runs", wanted)[1]["id"])
    assert status["state"] == "done", status
    assert {step["state"] for step in status["steps"]} == {"done"}
    assert status["picture"].startswith("/dg4d/artifacts/")
    assert status["first_look"].startswith("/dg4d/viewer/")
    record = json.loads(next((home.studio_assets()).glob("asset-wolf-*/*/provenance.json")).read_text())
    assert record["recipe"]["mask"] and record["recipe"]["views"]
    assert record["recipe"]["settings"]["driving"]["motion"] == "wave"

    page = studio.read(status["asset"].removeprefix("/dg4d/studio"))[1].decode()
    assert "Not accepted" in page and "Again with twice the motion iterations" in page
    assert studio.read(re.findall(r'"/dg4d/studio(/entries/[^"]+asset.glb)"', page)[0])[1]
    assert studio.read(re.findall(r'"/dg4d/studio(/thumbnails/[^"]+)"', page)[0])[1][8:12] == b"WEBP"
    key = re.findall(r'data-asset="([^"]+)"', page)[0]
    version = status["asset"].partition("?v=")[2]
    again = {"version": version, "settings": ["motion.iterations=500"], "seed": 7}
    second = studio.ended(studio.post(f"/assets/{key}/again", again)[1]["id"])
    assert second["state"] == "done" and second["asset"] != status["asset"]
    page = studio.read(f"/assets/{key}?v={version}&with={second['asset'].partition('?v=')[2]}")[1].decode()
    assert page.count("<iframe") == 2 and "2 versions" in studio.read("?search=wolf")[1].decode()
    assert "wolf" not in studio.read("?search=wolf&verdict=accepted")[1].decode().partition('id="cards"')[2]


@pytest.mark.slow
def test_a_failed_conversion_says_why_and_can_be_tried_again(studio: Client) -> None:
    draft = studio.draft(("owl.png", picture("an owl pack_asset=full").encode()))
    run = studio.post(f"/drafts/{draft}/runs", {})[1]["id"]
    assert studio.post(f"/runs/{run}/retry")[0] == 409
    status = studio.ended(run)
    assert status["state"] == "failed" and "disk" in status["message"].lower() and "Traceback" not in status["message"]
    assert studio.post(f"/runs/{run}/cancel")[0] == 409
    again = studio.post(f"/runs/{run}/retry")[1]["id"]
    assert again != run and studio.ended(again)["state"] == "failed"
    page = studio.read("/activity")[1].decode()
    assert page.count("<strong>owl</strong>") == 1  # the last attempt stands for both


def test_a_conversion_is_cancelled(studio: Client) -> None:
    draft = studio.draft(("slow.png", picture("fit_gaussians=sleep:300").encode()))
    begun, waiting = (studio.post(f"/drafts/{draft}/runs", {"seed": seed})[1]["id"] for seed in (0, 1))
    assert studio.post(f"/runs/{waiting}/cancel")[0] == 200
    wait_until(lambda: json.loads(studio.read(f"/runs/{begun}/status")[1])["steps"][0]["state"] == "done")
    assert studio.post(f"/runs/{begun}/cancel")[0] == 200
    for run in (begun, waiting):
        assert studio.ended(run)["state"] == "cancelled"
        assert studio.post(f"/runs/{run}/cancel")[0] == 200  # a second tab


def test_a_crashed_conversion_is_cancelled_and_not_started_a_second_time(studio: Client) -> None:
    flow = studio.post("/api/flows/", {"name": "killed"})[1]["id"]
    wanted = {"flow_id": flow, "name": "killed", "tags": [TAG], "state": {"type": "CRASHED", "name": "Crashed"}}
    run = studio.post("/api/flow_runs/", wanted)[1]["id"]
    page = studio.read("/activity")[1].decode()
    assert f"/runs/{run}/cancel" in page and f"/runs/{run}/retry" not in page
    assert studio.post(f"/runs/{run}/retry")[0] == 409
    assert studio.post(f"/runs/{run}/cancel")[0] == 200
    assert studio.ended(run)["state"] == "cancelled"


def test_an_upload_that_the_browser_ends_leaves_nothing_and_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    draft = Draft.create().identifier

    async def receive() -> dict[str, str]:
        return {"type": "http.disconnect"}

    scope = {"type": "http", "method": "POST", "headers": [], "query_string": b"name=fox.png"}
    request = Request({**scope, "path_params": {"identifier": draft}}, receive)
    answer = asyncio.run(Changes(ServerApi(request, "dg4d:secret")).upload(request))
    assert (answer.status_code, answer.body) == (499, b"")
    assert list((home.uploads() / draft / "files").iterdir()) == []


def test_an_artifact_that_was_missing_is_looked_for_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    content = b'{"accepted": true}'
    digest = f"sha256:{hashlib.sha256(content).hexdigest()}"
    step = VersionStep(label="check_asset", record=digest, inputs={}, outputs={"gates": digest})
    source = ArtifactRef(digest=digest, media_type="application/json", size_bytes=len(content))
    version = Version(
        item="fox", order=digest, package=source, profile="preview", seed=0, source=source, finished="", steps=(step,)
    )
    assert gallery._output(version, "check_asset", "gates") is None
    home.store().put_bytes(content, "application/json")
    assert gallery._output(version, "check_asset", "gates") == {"accepted": True}


def test_a_folder_becomes_a_batch(studio: Client) -> None:
    draft = studio.draft(*((f"item{i}.png", picture(f"item {i}").encode()) for i in range(3)))
    status = studio.ended(studio.post(f"/drafts/{draft}/runs", {"batch": True})[1]["id"])
    assert status["state"] == "done" and len(status["items"]) == 3
    assert studio.read("?search=item")[1].decode().count('class="asset"') == 3


def test_uploads_lie_in_files_that_others_cannot_read(studio: Client) -> None:
    draft = studio.draft(("fox.png", PNG))
    assert (home.studio().parent.stat().st_mode & 0o077, Path(home.uploads() / draft).is_dir()) == (0, True)


def tell(studio: Client, story: str, **needs: object) -> dict[str, Any]:
    """Let a browser do something, and return what it saw; the pages complained about nothing."""
    login = studio.server.login_address(str(studio.server.address()), "/dg4d/studio")
    seen = run_node("studio.mjs", json.dumps({"login": login, "story": story, **needs}), timeout_s=400)
    assert seen.pop("complaints") == []
    return seen


@pytest.fixture
def drawn(tmp_path: Path) -> Any:
    """Return a function that writes a picture with words for the fake steps."""

    def write(name: str, words: str) -> str:
        path = tmp_path / name
        path.write_text(picture(f"{words} {tmp_path}"))
        return str(path)

    return write


def test_a_dropped_picture_is_corrected_converted_played_and_downloaded(studio: Client, drawn: Any) -> None:
    seen = tell(studio, "convert", picture=drawn("heron.png", "a heron that is torn"), name="heron")
    assert seen["violations"] == []
    assert seen["wide"] == []
    assert seen["undo"] and seen["states"] == ["done", "done"] and seen["steps"] == 8
    assert seen["viewer"]["playing"] and seen["viewer"]["frames"] == 3 and not seen["reached"]
    assert "Again with twice the motion iterations" in seen["again"]
    assert seen["downloaded"][0] == "asset.glb" and seen["downloaded"][1] > 0
    record = json.loads(next(home.studio_assets().glob("asset-heron-*/*/provenance.json")).read_text())
    assert record["recipe"]["mask"] and record["recipe"]["settings"]["driving"]["motion"] == "wave"


@pytest.mark.slow
def test_a_killed_conversion_tells_so_and_goes_on(studio: Client, drawn: Any) -> None:
    seen = tell(studio, "killed", picture=drawn("killed.png", "fit_motion=die-once"))
    assert "killed" in seen["reason"] and seen["state"] == "done" and seen["hidden"]


@pytest.mark.slow
def test_a_full_disk_is_told_and_the_conversion_can_be_tried_again(studio: Client, drawn: Any) -> None:
    seen = tell(studio, "full", picture=drawn("crowded.png", "pack_asset=full"))
    assert "disk" in seen["reason"].lower() and seen["retried"]
    assert seen["listed"].count("crowded") == 1


def test_several_pictures_are_asked_about_and_a_refused_file_says_why(
    studio: Client, drawn: Any, tmp_path: Path
) -> None:
    (tmp_path / "note.png").write_text("not a picture")
    pictures = [drawn(f"side{number}.png", str(number)) for number in range(3)]
    seen = tell(studio, "several", text=str(tmp_path / "note.png"), pictures=pictures)
    assert "text file" in seen["refused"] and seen["violations"] == []
    assert seen["sides"] == ["90", "180"]


def test_two_hundred_assets_are_painted_within_a_second(studio: Client) -> None:
    store, newest = home.store(), "2026-01-01T00"
    package = store.put_bytes(b"no package", "application/zip")
    verdicts = [
        store.put_bytes(json.dumps({"accepted": good, "failing": [], "gates": []}).encode(), "application/json")
        for good in (True, False)
    ]
    for number in range(MANY):
        step = VersionStep(
            label="check_asset",
            record=digest_of(number),
            inputs={},
            outputs={"gates": verdicts[number % 10 == 0].digest},
        )
        version = Version(
            item=f"creature {number:03d}", order=digest_of(["many", number]), package=package, profile="preview",
            seed=0, source=package, finished=f"{newest}:{number // 60:02d}:{number % 60:02d}+00:00", steps=(step,),
        )  # fmt: skip
        store.write(version.name, version.model_dump_json())
    try:
        seen = tell(studio, "gallery", search="creature 01")
    finally:
        for entry in list(store.entries("versions")):
            if "creature" in entry.name:
                store.remove([entry.name])
    assert seen["paint"] < FIRST_PAINT_MS
    assert seen["before"] == 60 and seen["after"] == sum("01" in f"{number:03d}" for number in range(MANY))
    assert seen["failed"].startswith("2") and "verdict=failed" in seen["address"]
    assert seen["violations"] == []


@pytest.mark.slow
def test_a_restart_of_the_server_loses_nothing(studio: Client) -> None:
    draft = studio.draft(("lynx.png", picture("a lynx fit_motion=sleep:8").encode()))
    run = studio.post(f"/drafts/{draft}/runs", {})[1]["id"]
    wait_until(lambda: json.loads(studio.read(f"/runs/{run}/status")[1])["steps"][0]["state"] == "done")
    studio.server.stop()
    studio.server.start()
    address = studio.server.wait()
    Worker("process-cpu", studio.server.folder).start(address)
    wait_until(lambda: running(studio.server.folder))
    status = studio.ended(run)
    assert (status["state"], status["message"]) == ("done", "")
    assert studio.read(f"/drafts/{draft}")[0] == 200
    assert studio.read(status["asset"].removeprefix("/dg4d/studio"))[0] == 200
