"""The studio in Chromium: drop, correct, convert, play, download; failures; many assets; accessibility."""

import json
from pathlib import Path
from typing import Any

import pytest
from fake_steps import picture

from flows import home
from flows.engine.versions import Version, VersionStep
from steps.contract import digest_of
from tests.clients.node import run_node
from tests.flows.studio.conftest import Client

MANY = 200
FIRST_PAINT_MS = 1000


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
