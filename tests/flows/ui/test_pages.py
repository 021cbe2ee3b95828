"""Artifacts of an item on the Prefect server, read through its API and seen in a browser."""

import base64
import io
import json
import re
import urllib.error
import urllib.request
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conversions import EVERY_STEP, job
from PIL import Image, ImageColor
from prefect.client.orchestration import get_client
from prefect.settings import PREFECT_API_AUTH_STRING, PREFECT_API_URL
from waiting import retry_after, wait_until

from flows.convert import convert_job
from flows.formatting import curves
from flows.serving.auth import basic
from flows.serving.server import Server
from flows.step_errors import StepDiverged
from flows.ui import pages
from flows.ui.asset_page import PICTURES
from steps.contract import ArtifactRef
from steps.store.artifact_store import ArtifactStore
from tests.clients.node import run_node

TITLES = [title for (step, _), title in PICTURES.items() if step in EVERY_STEP]
LOSSES = 2  # drawings of losses, of the two fits


@pytest.fixture
def place(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Fake steps in this process, under the home folder of the server, which looks for artifacts there."""
    monkeypatch.setenv("DG4D_HOME", str(server.folder.parent))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    retry_after(0.01, monkeypatch)
    return tmp_path


def artifacts(item: str, path: str = "/artifacts/latest/filter") -> dict[str, list[dict[str, Any]]]:
    """Return the artifacts of an item by key without the item, the newest first.

    Prefect's client repeats a request whose answer was lost, so what one run made twice counts once.
    """
    wanted = {"artifacts": {"key": {"like_": f"-{item}-"}}, "limit": 200}
    with get_client(sync_client=True) as client:
        found: list[dict[str, Any]] = client.request("POST", path, json=wanted).json()
    by_key: dict[str, list[dict[str, Any]]] = {}
    once = {(each["key"], each["flow_run_id"], each["task_run_id"], str(each["data"])): each for each in found}
    for each in sorted(once.values(), key=lambda each: each["created"], reverse=True):
        by_key.setdefault(each["key"].partition(f"-{item}-")[0], []).append(each)
    return by_key


def server_address() -> str:
    return str(PREFECT_API_URL.value()).removesuffix("/api")


def fetched(address: str) -> tuple[str, bytes]:
    signed_in = {"Authorization": basic(str(PREFECT_API_AUTH_STRING.value()))}
    with urllib.request.urlopen(urllib.request.Request(server_address() + address, headers=signed_in)) as answer:
        return answer.headers["content-type"], answer.read()


def drawn_in_browser(server: Server, version: dict[str, Any], screenshot: Path) -> dict[str, Any]:
    """Open the page of an asset in a browser that is signed in."""
    asked = {
        "login": server.login_address(server_address()),
        "address": f"/artifacts/artifact/{version['id']}",
        "wait": len(TITLES) + LOSSES,
        "text": "Contact sheet",
        "screenshot": str(screenshot),
    }
    return run_node("prefect.mjs", json.dumps(asked))


def test_an_item_leaves_a_page_per_step_and_one_with_everything(place: Path) -> None:
    _, cached = convert_job(job("pages", place, item="paged"), place / "out")
    assert not cached
    kept = {key: latest[0] for key, latest in artifacts("paged").items()}
    labels = {step.replace("_", "-") for step in EVERY_STEP}
    assert set(kept) == labels | {f"progress-{label}" for label in labels} | {"asset"}
    assert kept["progress-fit-gaussians"]["data"] == 100
    (look,) = re.findall(r"\(/dg4d/viewer/([0-9a-f]{64})/\d+/first_look\.html\)", kept["fit-gaussians"]["data"])
    assert f'"first_look": "sha256:{look}"' in (place / "out" / "provenance.json").read_text()
    motion = kept["fit-motion"]["data"]
    assert "data:image/webp;base64," in motion and "| 2 | 0.01 |" in motion

    page = kept["asset"]["data"]
    record = (place / "out" / "provenance.json").read_text()
    (package,) = re.findall(r"`(sha256:[0-9a-f]{64})`", page)
    assert f'"package": "{package}"' in record
    embedded = re.findall(r"!\[([^\]]+)\]\(data:image/(webp|svg\+xml);base64,([^)]+)\)", page)
    assert [title for title, kind, _ in embedded if kind == "webp"] == TITLES
    assert sum(kind == "svg+xml" for _, kind, _ in embedded) == LOSSES
    for _, kind, content in embedded:
        if kind == "webp":
            assert Image.open(io.BytesIO(base64.b64decode(content))).size == (8, 6)
    assert "Accepted: all 1 gates passed." in page and "| passed | silhouette | 0.9 |" in page
    assert "- This asset is a fake." in page
    rows = re.findall(r"\| (\w+) \| computed \|(?: [\d.]+ \|){3} \d+ MiB \| [0-9a-f]{12} \| ([0-9a-f]{12}) \|", page)
    assert [step for step, _ in rows] == EVERY_STEP
    assert all(f'"digest": "sha256:{digest}' in record for _, digest in rows)


def test_files_and_the_viewer_are_a_link_away(place: Path) -> None:
    convert_job(job("links", place, item="linked"), place / "out")
    kept = {key: latest[0]["data"] for key, latest in artifacts("linked").items()}
    to = {key: re.findall(r"/dg4d/[^)\s\]]+", str(data)) for key, data in kept.items()}
    kind, subject = fetched(to["prepare-subject"][0])
    assert kind == "image/png" and subject.startswith(b"\x89PNG")
    package_link, viewer_link = to["asset"]
    _, package = fetched(package_link)
    with zipfile.ZipFile(io.BytesIO(package)) as archive:
        mesh = archive.read("asset.glb")
    assert mesh == (place / "out" / "asset.glb").read_bytes()
    kind, viewer = fetched(viewer_link)
    assert kind.startswith("text/html")
    assert base64.b64encode(zlib.compress(mesh)) in viewer
    for absent in (
        viewer_link.replace(re.findall(r"[0-9a-f]{64}", viewer_link)[0], "0" * 64),
        "/dg4d/viewer/x/1/y",
    ):
        with pytest.raises(urllib.error.HTTPError, match="404"):
            fetched(absent)
    with pytest.raises(urllib.error.HTTPError, match="404"):  # a picture is no package
        fetched(to["prepare-subject"][0].replace("artifacts", "viewer"))


def test_the_same_item_again_is_a_new_version_under_the_same_keys(place: Path) -> None:
    convert_job(job("version one", place, item="versioned"), place / "out")
    convert_job(job("version two", place, item="versioned"), place / "out")
    convert_job(job("version two", place, item="versioned"), place / "out")
    every, latest = artifacts("versioned", "/artifacts/filter"), artifacts("versioned")
    assert {key: len(versions) for key, versions in every.items() if key in ("asset", "fit-motion")} == {
        "asset": 3, "fit-motion": 2,
    }  # fmt: skip
    assert set(every) == set(latest)
    assert [page["data"].count("| cached |") for page in every["asset"]] == [len(EVERY_STEP), 0, 0]
    assert latest["asset"][0]["data"] == every["asset"][0]["data"]


def test_a_step_that_failed_leaves_its_reason_and_its_last_good_state(place: Path) -> None:
    with pytest.raises(StepDiverged):
        convert_job(job("fit_motion=diverge", place, item="diverged"), place / "out")
    kept = {key: latest[0]["data"] for key, latest in artifacts("diverged").items()}
    assert "iteration 7" in kept["fit-motion"] and "![last_good](data:image/webp;base64," in kept["fit-motion"]
    assert "asset" not in kept and "package" not in kept


def test_a_browser_draws_every_picture_of_the_page(server: Server, place: Path) -> None:
    convert_job(job("drawn", place, item="drawn"), place / "out")
    version, *_ = artifacts("drawn", "/artifacts/filter")["asset"]
    seen = drawn_in_browser(server, version, place / "page.png")
    assert [shown["name"] for shown in seen["pictures"]] == [*TITLES, *["Losses of the fake"] * LOSSES]
    screen = np.asarray(Image.open(place / "page.png").convert("RGB")).astype(int)
    ink, paper = (ImageColor.getrgb(dark) for _, dark in (curves.INKS[0], curves.PAPER))  # as the pages of the UI
    for shown in seen["pictures"]:
        left, top, width, height = (round(side) for side in shown["box"])
        drawn = screen[top : top + height, left : left + width]
        if shown["name"] in TITLES:  # every fake step makes the same
            assert np.abs(drawn[height // 2, width // 2] - [100, 200, 90]).max() < 40, shown
        else:
            assert (np.abs(drawn - ink).max(-1) < 40).sum() > 100, shown
            assert (np.abs(drawn - paper).max(-1) < 10).mean() > 0.5, shown
    assert "silhouette" in seen["text"] and "This asset is a fake." in seen["text"]
    assert {address.split("/")[4] for address in seen["links"] if "/dg4d/" in address} == {"artifacts", "viewer"}


def test_a_picture_is_shown_as_large_as_its_bytes_allow(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path)
    noise = np.random.default_rng(0).integers(0, 255, (500, 2000, 3), dtype=np.uint8)
    plain, hard = (_stored(store, Image.fromarray(pixels)) for pixels in (noise * 0 + 90, noise))
    sizes = []
    for ref, most in ((plain, 50_000), (hard, 50_000), (hard, 20_000)):
        small = pages.thumbnail(ref, store, most)
        assert small is not None and len(small) <= most
        sizes.append(Image.open(io.BytesIO(small)).size)
    assert sizes[0] == (960, 240)
    assert sizes[2][0] < sizes[1][0]
    assert pages.thumbnail(hard, store, 100) is None
    assert pages.thumbnail(store.put_bytes(b"no picture", "image/png"), store) is None


def test_a_loss_that_cannot_be_drawn_is_left_out() -> None:
    assert curves.svg_picture({"title": "t", "x": [], "series": {"a": []}, "notes": []}) == ""
    assert curves.svg_picture({"title": "t", "x": [1, 2], "series": {"a": [float("nan")] * 2}, "notes": []}) == ""
    assert "&lt;loss&gt; 3" in curves.svg_picture(
        {"title": "t", "x": [1, 2], "series": {"<loss>": [2.0, 3.0]}, "notes": []}
    )


def _stored(store: ArtifactStore, picture: Image.Image) -> ArtifactRef:
    content = io.BytesIO()
    picture.save(content, "PNG")
    return store.put_bytes(content.getvalue(), "image/png")


def test_counts_are_read_with_all_their_digits() -> None:
    values = [65536, 5000.0, 12.0, 2748.64, -123456.7, 0.0, float("nan"), float("inf")]
    said = ["65,536", "5,000", "12", "2749", "-1.235e+05", "0", "nan", "inf"]
    assert [curves.format_number(value) for value in values] == said


def test_an_item_may_be_called_anything_and_is_shown_letter_by_letter(server: Server, place: Path) -> None:
    name = "{0} {item} ![x](http:tracker) |b| <img src=x> *c*"
    convert_job(job("nasty", place, item=name), place / "out")
    with get_client(sync_client=True) as client:
        wanted = {"artifacts": {"key": {"like_": "-0-item-x-http-tracker-b-img-src-x-c-"}}, "limit": 200}
        found: list[dict[str, Any]] = client.request("POST", "/artifacts/filter", json=wanted).json()
        named = {"task_runs": {"name": {"any_": [f"prepare_subject: {name}"]}}}
        wait_until(
            lambda: client.request("POST", "/task_runs/filter", json=named).json()
        )  # the server notes them later
    assert len(found) == 2 * len(EVERY_STEP) + 1  # a page and a bar per step, and the page of the asset
    for page in found:
        for text in (page["description"] or "", page["data"] if page["type"] == "markdown" else ""):
            assert not re.search(r"(?<!\\)(\]\(http|<img|\|b|\*c)", text), text
    (version,) = [page for page in found if page["key"].startswith("asset-")]
    seen = drawn_in_browser(server, version, place / "page.png")
    assert name in seen["text"]
    assert [picture["name"] for picture in seen["pictures"]] == [*TITLES, *["Losses of the fake"] * LOSSES]
