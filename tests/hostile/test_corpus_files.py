"""Every file of the corpus through the decoders, in a child process whose memory is watched."""

import os
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.catalog_request import ready
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.inputs.manifest import Item
from steps.profiles import profile
from tests.hostile.archives import UNPACKED, ZIPS
from tests.hostile.conftest import Place
from tests.hostile.decoding import Decoder, Outcome
from tests.hostile.others import OTHERS, PLACES
from tests.hostile.outcomes import UNKNOWN, Accepted, Refused
from tests.hostile.pictures import PICTURES
from tests.hostile.table import PLACES as SAID
from tests.hostile.table import UNPACKED as EXTRACTED
from tests.hostile.table_files import FILES
from tests.hostile.videos import VIDEOS

CASES = {**PICTURES, **VIDEOS, **ZIPS, **OTHERS}
BOMBS = (  # two seconds each; those that unpack a little less are tested every time
    "png: 10,900 a side, zeros", "png: 8,000 a side, zeros of 1 bit", "webp: canvas of 6,000 a side",
    "tiff: deflate bomb", "jpeg: 60 scans of 16 million pixels",
)  # fmt: skip
MOST_MB = 2048  # resident, of the process that decodes, with everything that it has loaded
MOST_S = 12.0  # of processor time for one file; the largest that is read takes the most


@pytest.fixture(scope="module")
def decoder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Decoder]:
    with Decoder(tmp_path_factory.mktemp("decoder")) as child:
        yield child


def check(outcome: Outcome, expected: Accepted | Refused) -> None:
    if isinstance(expected, Accepted):
        assert (outcome.kind, outcome.frames) == (expected.kind, expected.frames), outcome.says
    else:
        assert outcome.kind == "refused", outcome
        assert re.search(expected.says, outcome.says), outcome.says
        assert len(outcome.says) < 1000 and "\n" not in outcome.says, outcome.says
    assert outcome.left == []
    assert outcome.peak_mb < MOST_MB
    assert outcome.seconds < MOST_S


def test_every_file_is_in_the_table() -> None:
    assert set(CASES) == set(FILES)
    assert set(PLACES) == set(SAID) and set(UNPACKED) == set(EXTRACTED)
    refused = [name for name, expected in FILES.items() if isinstance(expected, Refused)]
    assert len(refused) >= 91 + 60 and len(FILES) - len(refused) >= 21


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] if n in BOMBS else []) for n in CASES])
def test_a_file_gets_what_the_table_says(name: str, decoder: Decoder, tmp_path: Path) -> None:
    path = tmp_path / "source"
    path.write_bytes(CASES[name]())
    check(decoder.ask(path), FILES[name])


@pytest.mark.parametrize("name", UNPACKED)
def test_a_zip_is_unpacked_within_its_folder_or_refused(name: str, decoder: Decoder, tmp_path: Path) -> None:
    path, expected = tmp_path / "zip", EXTRACTED[name]
    path.write_bytes(UNPACKED[name]())
    outcome = decoder.ask(path, "zip")
    if isinstance(expected, Refused):
        check(outcome, expected)
    else:
        assert (outcome.kind, outcome.frames) == ("done", expected), outcome.says


@pytest.mark.parametrize("name", [*PLACES, *(n for n in CASES if FILES[n] == UNKNOWN)])
def test_what_is_no_source_never_enters_the_store(name: str, place: Place) -> None:
    path = place.work / "cat.png"
    if name in PLACES:
        PLACES[name](path)
    else:
        path.write_bytes(CASES[name]())
    request = ConversionRequest(item="cat", picture=path, settings=profile("preview"))
    row = ready(Item(name="cat", request=request), place.work / "out", strict=False)
    assert not isinstance(row, ConversionJob)
    expected = SAID[name] if name in PLACES else UNKNOWN
    assert (row.status, row.kind) == ("failed", "BadInput")
    assert re.search(expected.says, row.message), row.message
    assert place.stored() == []
    assert not (place.work / "out").exists()


def test_a_file_that_may_not_be_read_is_refused(place: Place) -> None:
    import subprocess
    import sys

    path = place.work / "cat.png"
    path.write_bytes(CASES["png: 1 bit"]())
    path.chmod(0)
    drop = "--bounding-set=-dac_override,-dac_read_search"
    as_others = ["setpriv", drop] if os.geteuid() == 0 else []  # root may read everything
    done = subprocess.run(
        [*as_others, sys.executable, "-m", "flows.cli", "make", "cat.png", "-o", "out"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode in (2, 65), done.stderr
    assert re.search("not readable|cannot be read: Permission denied", done.stderr)
    assert "Traceback" not in done.stderr
    assert place.stored() == [] and not (place.work / "out").exists()


def test_a_crash_and_a_hang_are_results_and_the_next_file_is_decoded(tmp_path: Path) -> None:
    (tmp_path / "cat.png").write_bytes(CASES["png: 1 bit"]())
    with Decoder(tmp_path / "decoder", hangs_s=20) as child:
        assert child.ask(tmp_path / "cat.png", "crash").kind == "crashed"
        assert child.ask(tmp_path / "cat.png").kind == "picture"
    with Decoder(tmp_path / "decoder", hangs_s=0.01) as child:
        assert child.ask(tmp_path / "cat.png").kind == "hung"
