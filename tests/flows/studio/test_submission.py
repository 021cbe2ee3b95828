"""Conversions that the studio starts, without a server."""

import asyncio
import struct
import zlib
from collections.abc import AsyncIterator
from io import BytesIO
from pathlib import Path
from typing import get_args

import pytest
from fake_steps import PNG
from PIL import Image

from dg4d_lib.errors import BadInput
from flows import home
from flows.inputs.fetching import item_name
from flows.inputs.manifest import items_of
from flows.serving.roots import Roots
from flows.studio import quick
from flows.studio.drafts import Draft, Upload
from flows.studio.pages import DESCRIPTIONS
from flows.studio.status import name_of
from flows.studio.submission import Submission, asset_tag, convert
from flows.ui import pages
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


@pytest.mark.parametrize("name", ["Fox 1.5", "bear #2", "what? 100%"])
@pytest.mark.parametrize("file", ["fox.png", "picture", "Fox 1.5"])
def test_a_name_with_dots_and_signs_stays_whole_and_its_page_is_found(draft: Draft, file: str, name: str) -> None:
    receive(draft, file, PNG)
    run = convert(draft, Submission(name=name))
    row = {"name": run.name, "parameters": run.parameters}
    assert name_of(row) == item_name(run.parameters["picture"]) == name
    assert asset_tag(item_name(run.parameters["picture"])) in run.tags


@pytest.mark.parametrize(("frames", "kind"), [(1, "picture"), (2, "video")])
def test_a_gif_is_a_video_if_it_has_two_frames(draft: Draft, frames: int, kind: str) -> None:
    assert receive(draft, "fox.gif", gif(frames)).kind == kind


def test_a_file_that_was_removed_from_the_store_is_stored_again(draft: Draft) -> None:
    upload = receive(draft, "fox.png", PNG)
    stored = quick._source(upload)
    home.store().path(stored).unlink()
    assert quick._source(upload) == stored and home.store().has(stored)


def test_a_mask_that_claims_to_be_huge_is_refused(draft: Draft) -> None:
    with pytest.raises(BadInput, match="not a readable PNG"):
        draft.save_mask(huge_png(), (8, 8))
    assert pages.small_webp(BytesIO(huge_png()), 10_000) is None


def test_a_mask_that_was_not_drawn_is_asked_for(draft: Draft) -> None:
    receive(draft, "fox.png", PNG)
    for ask in (
        lambda: quick.motion_previews(draft, "preview", masked=True),
        lambda: convert(draft, Submission(masked=True)),
    ):
        with pytest.raises(BadInput, match="no mask yet; paint"):
            ask()


def huge_png() -> bytes:
    """Return the head of a picture of 60000 times 60000 pixels."""
    head = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", len(head) - 4) + head + struct.pack(">I", zlib.crc32(head))
