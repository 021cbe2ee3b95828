"""A minute of the fuzzer, with the same seed every time; `python -m tests.hostile.fuzz` goes on for longer."""

from collections.abc import Iterator

import pytest

from tests.hostile.decoding import Decoder, Outcome
from tests.hostile.fuzz import HANGS_S, TARGETS, fault, fuzz, repaired
from tests.hostile.samples import sound_png

SECONDS = 60.0  # of all targets together
SEED = 0


@pytest.fixture(scope="module")
def child(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Decoder]:
    with Decoder(tmp_path_factory.mktemp("child"), HANGS_S) as decoder:
        yield decoder


# Hypothesis blames a strategy when a thread of an earlier test, such as Prefect's event client, draws a random number
@pytest.mark.filterwarnings("ignore:Do not use the `random` module:hypothesis.errors.HypothesisDeprecationWarning")
@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_readers_accept_or_refuse_whatever_they_are_given(name: str, child: Decoder) -> None:
    count = fuzz(name, child, SECONDS * TARGETS[name].share, SEED)
    assert count > 0, f"no input from seed {SEED} in time"


def test_shares_of_the_targets_are_all_of_the_time() -> None:
    assert sum(target.share for target in TARGETS.values()) == pytest.approx(1)


def test_what_is_a_fault() -> None:
    assert not fault(Outcome("refused", says="no"), "source")
    assert not fault(Outcome("picture", 1), "source")
    for outcome in (Outcome("broke"), Outcome("crashed"), Outcome("hung"), Outcome("done", peak_mb=5000)):
        assert fault(outcome, "source")
    assert fault(Outcome("refused", left=["temporary/x"]), "source")


def test_checksums_are_repaired_so_that_the_decoder_looks_behind_them() -> None:
    content = sound_png()
    at = content.index(b"IHDR") + 4
    wrong = content[:at] + b"\0\0\0\x21" + content[at + 4 :]
    assert repaired(wrong) != wrong and repaired(content) == content
