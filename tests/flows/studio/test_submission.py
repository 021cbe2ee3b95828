"""Conversions that the studio starts, without a server."""

import asyncio
from collections.abc import AsyncIterator
from io import BytesIO
from pathlib import Path
from typing import get_args

import pytest
from fake_steps import PNG
from PIL import Image

from flows import home
from flows.inputs.manifest import items_of
from flows.inputs.naming import name_from_path
from flows.serving.roots import Roots
from flows.studio import quick
from flows.studio.drafts import Draft, Upload
from flows.studio.pages import DESCRIPTIONS
from flows.studio.status import name_of
from flows.studio.submission import Submission, convert
from steps.profiles import PROFILES


@pytest.fixture
def draft(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Draft:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    return Draft.create()


def receive(draft: Draft, name: str, content: bytes) -> Upload:
    async def chunks() -> AsyncIterator[bytes]:
        yield content

    return asyncio.run(draft.receive(name, chunks()))


def gif(frames: int) -> bytes:
    content, pictures = BytesIO(), [Image.new("L", (8, 8), 99 * number) for number in range(frames)]
    pictures[0].save(content, "GIF", save_all=True, append_images=pictures[1:])
    return content.getvalue()


def test_the_page_offers_every_profile() -> None:
    assert set(get_args(Submission.model_fields["profile"].annotation)) == set(PROFILES) == set(DESCRIPTIONS)


def test_a_batch_makes_an_asset_of_every_file_whatever_its_suffix(draft: Draft) -> None:
    for name in ("fox.png", "fox.jfif", "IMG_0001", "manifest.csv"):
        receive(draft, name, PNG)
    parameters = convert(draft, Submission(batch=True)).parameters
    receive(draft, "later.png", PNG)
    roots = Roots.of_this_process()
    items = items_of(roots.inputs(parameters["inputs"]), Path(parameters["out"]), "preview", {}, 0)
    assert {item.name for item in items} == {"fox-png", "fox-jfif", "IMG_0001", "manifest"}
    for item in items:
        roots.check_item(item)
        assert item.request is not None
        item.request.check()


@pytest.mark.parametrize("file", ["fox.png", "picture", "Fox 1.5"])
def test_a_name_with_dots_stays_whole(draft: Draft, file: str) -> None:
    receive(draft, file, PNG)
    run = convert(draft, Submission(name="Fox 1.5"))
    row = {"name": run.name, "parameters": run.parameters}
    assert name_of(row) == name_from_path(Path(run.parameters["picture"])) == "Fox 1.5"


@pytest.mark.parametrize(("frames", "kind"), [(1, "picture"), (2, "video")])
def test_a_gif_is_a_video_if_it_has_two_frames(draft: Draft, frames: int, kind: str) -> None:
    assert receive(draft, "fox.gif", gif(frames)).kind == kind


def test_a_file_that_was_removed_from_the_store_is_stored_again(draft: Draft) -> None:
    upload = receive(draft, "fox.png", PNG)
    stored = quick._source(upload)
    home.store().path(stored).unlink()
    assert quick._source(upload) == stored and home.store().has(stored)
