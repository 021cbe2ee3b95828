"""Manifests of other people: a bad row is a failed row with a sentence, and the others are made."""

import os
import re
from pathlib import Path

import pytest

from dg4d_lib.errors import DG4DError
from flows.catalog_request import ready
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.manifest import Item, items_of
from flows.packages.summary import Row
from tests.hostile.conftest import Place
from tests.hostile.manifests import ROWS, SOUND, WHOLE
from tests.hostile.names import NAMES, WANTED
from tests.hostile.outcomes import Refused
from tests.hostile.samples import sound_png
from tests.hostile.table import MADE, MANIFESTS
from tests.hostile.table import NAMES as FILES_CALLED
from tests.hostile.table import WANTED as ITEMS_CALLED

CASES = {**WHOLE, **ROWS, **SOUND}
OUT = Path("out")


@pytest.fixture(autouse=True)
def pictures(place: Place, monkeypatch: pytest.MonkeyPatch) -> Place:
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")  # quicker than reading the source
    (place.work / "list").mkdir()
    (place.work / "list" / "cat.png").write_bytes(sound_png())
    return place


def prepared(items: list[Item]) -> tuple[list[ConversionJob], list[Row]]:
    """Prepare items as a batch does."""
    found = [ready(item, OUT, strict=False) for item in items]
    return [one for one in found if isinstance(one, ConversionJob)], [one for one in found if isinstance(one, Row)]


def check(items: list[Item], made: int, says: str) -> list[ConversionJob]:
    """Assert how many items can be made, and that every other one is a failed row with a sentence."""
    jobs, rows = prepared(items)
    assert len(jobs) == made, rows
    for row in rows:
        assert (row.status, row.kind) == ("failed", "BadInput")
        assert re.search(says, row.message), row.message
        assert len(row.message) < 3000 and "\n" not in row.message
    for one in [*jobs, *rows]:
        one.model_dump_json()  # the summary and the server are given it
        assert one.item
    for name in (job.item for job in jobs):
        assert (OUT / name).resolve().is_relative_to(OUT.resolve()) and Path(name) != Path(), name
        assert all(len(os.fsencode(part)) <= 255 for part in Path(name).parts), name
    assert not OUT.exists() or list(OUT.rglob("*")) == []
    return jobs


def test_every_manifest_is_in_the_table() -> None:
    assert set(CASES) == set(MANIFESTS)
    assert set(FILES_CALLED) <= set(NAMES) and set(ITEMS_CALLED) <= set(WANTED)
    assert len(CASES) >= 17 and len(NAMES) >= 14


@pytest.mark.parametrize("name", CASES)
def test_a_manifest_gets_what_the_table_says(name: str, pictures: Place) -> None:
    (suffix, make), expected = CASES[name], MANIFESTS[name]
    file = pictures.work / "list" / f"manifest{suffix}"
    file.write_bytes(make())
    try:
        items = items_of(file, OUT, "preview", {}, 0)
    except DG4DError as error:
        assert isinstance(expected, Refused), error
        assert re.search(expected.says, str(error))
        assert len(str(error)) < 3000
        return
    assert not isinstance(expected, Refused), items
    check(items, expected.made, expected.says)


@pytest.mark.parametrize("name", NAMES)
def test_a_file_of_any_name_is_made_or_refused_in_a_sentence(name: str, pictures: Place) -> None:
    expected = FILES_CALLED.get(name, MADE)
    path = os.fsencode(pictures.work / "list") + b"/" + NAMES[name]
    with open(path, "wb") as file:  # noqa: PTH123  # a name of bytes
        file.write(sound_png())
    (pictures.work / "list" / "cat.png").unlink()
    hidden = NAMES[name].startswith(b".")
    if hidden:
        (pictures.work / "list" / "seen.png").write_bytes(sound_png())
    check(items_of(pictures.work / "list", OUT, "preview", {}, 0), expected.made, expected.says)


@pytest.mark.parametrize("name", WANTED)
def test_an_item_of_any_name_is_made_below_the_output_or_refused(name: str, pictures: Place) -> None:
    import json

    expected = ITEMS_CALLED.get(name, MADE)
    rows = [{"path": "cat.png", "name": WANTED[name]}, {"path": "cat.png", "name": "cat"}]
    (pictures.work / "list" / "m.json").write_text(json.dumps(rows))
    items = items_of(pictures.work / "list" / "m.json", OUT, "preview", {}, 0)
    assert len({item.name for item in items}) == 2
    check(items, expected.made + 1, expected.says)
