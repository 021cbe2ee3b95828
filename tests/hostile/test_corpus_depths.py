"""Depth pictures that say nothing, and every picture of the corpus given as one."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.hostile.archives import ZIPS
from tests.hostile.decoding import Decoder
from tests.hostile.formats import SIZE, saved
from tests.hostile.others import OTHERS
from tests.hostile.outcomes import Refused
from tests.hostile.pictures import PICTURES, exr
from tests.hostile.samples import frames_zip
from tests.hostile.test_corpus_files import BOMBS, check

MOST_MB = 2048  # resident
SLOPE = np.repeat(np.arange(SIZE, dtype=np.uint8)[None], SIZE, 0)


def gray(pixels: np.ndarray) -> Callable[[], bytes]:
    return lambda: saved(Image.fromarray(pixels), "PNG")


SOUND = {
    "a slope": gray(SLOPE),
    "a slope of 16 bits": gray(SLOPE.astype(np.uint16) * 1000),
    "a slope in the red of a palette of gray": lambda: saved(Image.fromarray(SLOPE).convert("P"), "PNG"),
}
SENSELESS: dict[str, tuple[Callable[[], bytes], Refused]] = {
    "another size": (gray(SLOPE[:40, :40]), Refused("40 x 40 pixels, the picture 64 x 64")),
    "one value": (gray(0 * SLOPE + 90), Refused("one value")),
    "black": (gray(0 * SLOPE), Refused("one value, 0, all over")),
    "not a number": (lambda: exr("float", value=float("nan"), everywhere=True), Refused("values for 0%")),
    "infinite": (lambda: exr("float", value=float("inf"), everywhere=True), Refused("values for 0%")),
    "negative": (lambda: exr("float", value=-1.0, everywhere=True), Refused("values for 0%")),
    "colors": (gray(np.stack([SLOPE, SLOPE * 3, 255 - SLOPE], -1)), Refused("colored")),
    "transparent": (gray(np.stack([SLOPE] * 3 + [0 * SLOPE], -1)), Refused("values for 0%")),
    "a zip of frames": (frames_zip, Refused("is a zip")),
    "a huge one": (PICTURES["png: 8,000 a side, zeros of 1 bit"], Refused("8000 x 8000|max_decode_gb")),
}
GIVEN = {name: make for name, make in {**PICTURES, **ZIPS, **OTHERS}.items() if name not in BOMBS}


@pytest.fixture(scope="module")
def decoder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Decoder]:
    with Decoder(tmp_path_factory.mktemp("decoder")) as child:
        yield child


@pytest.mark.parametrize("name", SENSELESS)
def test_depths_that_say_nothing_are_refused_in_a_sentence(name: str, decoder: Decoder, tmp_path: Path) -> None:
    make, expected = SENSELESS[name]
    path = tmp_path / "depth"
    path.write_bytes(make())
    check(decoder.ask(path, "depth"), expected)


@pytest.mark.parametrize("name", SOUND)
def test_gray_pictures_of_any_depth_are_read(name: str, decoder: Decoder, tmp_path: Path) -> None:
    path = tmp_path / "depth"
    path.write_bytes(SOUND[name]())
    outcome = decoder.ask(path, "depth")
    assert outcome.kind == "done", outcome.says


@pytest.mark.parametrize("name", GIVEN)
def test_a_file_of_the_corpus_is_read_or_refused(name: str, decoder: Decoder, tmp_path: Path) -> None:
    path = tmp_path / "depth"
    path.write_bytes(GIVEN[name]())
    outcome = decoder.ask(path, "depth")
    assert outcome.sound and outcome.peak_mb < MOST_MB, outcome
    assert len(outcome.says) < 1000 and "\n" not in outcome.says, outcome.says
