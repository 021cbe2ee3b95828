"""Folders and zips that somebody else gives as a bank of true views."""

import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.catalog_request import ready
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.inputs.manifest import Item
from flows.packages.summary import Row
from steps.profiles import profile, revise
from steps.store.artifact_store import ArtifactStore
from tests.hostile.banks import DOOR, FOLDERS
from tests.hostile.conftest import Place
from tests.hostile.decoding import Decoder
from tests.hostile.outcomes import Refused
from tests.hostile.samples import sound_png
from tests.hostile.table import BANKS

CASES = {**DOOR, **FOLDERS}


@pytest.fixture(scope="module")
def decoder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Decoder]:
    with Decoder(tmp_path_factory.mktemp("decoder")) as child:
        yield child


def ordered(place: Place, bank: Path) -> ConversionJob | Row:
    """Prepare an item with a bank as a batch does."""
    picture = place.work / "cat.png"
    picture.write_bytes(sound_png())
    settings = revise(profile("preview"), {"prior.kind": "oracle"})
    request = ConversionRequest(item="cat", picture=picture, bank=bank, settings=settings)
    return ready(Item(name="cat", request=request), place.work / "out", strict=False)


def test_every_bank_is_in_the_table() -> None:
    assert set(CASES) == set(BANKS)


@pytest.mark.parametrize("name", CASES)
def test_a_bank_gets_what_the_table_says_at_the_door_or_in_the_step(name: str, place: Place, decoder: Decoder) -> None:
    expected = BANKS[name]
    path = place.work / "bank"
    CASES[name](path)
    found = ordered(place, path)
    if isinstance(found, ConversionJob):
        assert found.bank is not None
        blob = ArtifactStore(place.home / "store").path(found.bank)
        with zipfile.ZipFile(blob) as archive:
            assert set(archive.namelist()) <= {"bank.json", "view.png", ".DS_Store"}, "nothing that it does not name"
        outcome = decoder.ask(blob, "bank")
        says, kind = outcome.says, outcome.kind
        assert outcome.left == [] and outcome.peak_mb < 2048
    else:
        assert place.stored() == []
        says, kind = found.message, "refused" if found.kind == "BadInput" else found.kind
    if isinstance(expected, Refused):
        assert kind == "refused", says
        assert re.search(expected.says, says), says
        assert len(says) < 1000 and "\n" not in says, says
    else:
        assert kind == "done", says


@pytest.mark.parametrize("name", FOLDERS)
def test_a_bank_that_is_in_the_store_gets_the_same(name: str, place: Place, decoder: Decoder) -> None:
    path, expected = place.work / "bank", BANKS[name]
    FOLDERS[name](path)
    if "9 GiB" in name:
        pytest.skip("would be packed whole; the door leaves it out")
    outcome = decoder.ask(path, "bank")
    assert outcome.left == [] and outcome.peak_mb < 2048, outcome
    if isinstance(expected, Refused):
        assert outcome.kind == "refused", outcome.says
        assert re.search(expected.says, outcome.says), outcome.says
    else:
        assert (outcome.kind, outcome.frames) == ("done", expected), outcome.says
