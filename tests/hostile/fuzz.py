"""Fuzzer of everything that reads what other people wrote: decoders, zips, manifests, settings, scenes, records.

`python -m tests.hostile.fuzz --minutes 60 [--seed N] [--target NAME] [--shrink]` runs it for as long as one likes;
`--replay FILE` reads a saved input again. Every reader runs in a child process, so a crash is a failure as well.
"""

import argparse
import hashlib
import json
import random
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, Phase, configuration, given, seed, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from tests.hostile import banks, documents, manifests
from tests.hostile.archives import UNPACKED, ZIPS
from tests.hostile.decoding import Decoder, Outcome
from tests.hostile.outcomes import Accepted
from tests.hostile.pictures import PICTURES
from tests.hostile.table_files import FILES
from tests.hostile.videos import VIDEOS

SAVED = Path(__file__).parents[2] / "out" / "fuzz"
MOST_MB = 2048  # resident, of the process that reads
MOST_S = 20.0  # of processor time for one input
HANGS_S = 60.0
LARGEST_SEED_FILE = 30_000  # bytes; mutations of larger files hit pixels, not headers
AT_ONCE = 100  # inputs between two looks at the clock
COLUMNS = (
    "path",
    "text",
    "video",
    "asset",
    "name",
    "profile",
    "seed",
    "bank",
    "mask",
    "box",
    "depth",
    "layers",
    "views",
    "turntable",
    "cameras",
    "priority",
    "set",
)
KNOBS = ("mesh.grid", "prior.kind", "motion.iterations", "text.weights")
EDGES = (0, 1, 2, 31, 32, 127, 128, 255, 256, 4095, 32_767, 32_768, 65_535, 2**24, 2**31 - 1, 2**31, 2**32 - 1)


class Found(AssertionError):
    """An input that a reader neither accepted nor refused in a sentence."""


@dataclass(frozen=True)
class Target:
    """A reader and inputs for it.

    Attributes:
        share: of the time of a run.
        readers: names in `decoding.READERS`; each input goes to one of them.
        inputs: makes the strategy, which may take seconds.
    """

    share: float
    readers: tuple[str, ...]
    inputs: Callable[[], SearchStrategy[bytes]]


# Mutations of files


@st.composite
def mutated(draw: st.DrawFn, seeds: Sequence[bytes]) -> bytes:
    """Draw a file and damage it: cuts, flips, edge values, pieces of other files, pieces twice."""
    content = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(1, 6))):
        how = draw(st.sampled_from(("cut", "flip", "edge", "splice", "repeat", "remove", "insert")))
        _mutate(draw, how, content, seeds)
    fixed = draw(st.booleans())
    return repaired(bytes(content)) if fixed else bytes(content)


def _mutate(draw: st.DrawFn, how: str, content: bytearray, seeds: Sequence[bytes]) -> None:
    at = draw(st.integers(0, max(0, len(content) - 1)))
    length = draw(st.sampled_from((1, 2, 4, 8, 12, 64, 512)))
    if how == "cut":
        del content[at:]
    elif how == "flip" and content:
        content[at] ^= draw(st.integers(1, 255))
    elif how == "edge":
        form = draw(st.sampled_from(("<I", ">I", "<H", ">H", "B")))
        value = draw(st.sampled_from(EDGES)) % 2 ** (8 * struct.calcsize(form))
        content[at : at + struct.calcsize(form)] = struct.pack(form, value)
    elif how == "splice":
        other = draw(st.sampled_from(seeds))
        start = draw(st.integers(0, max(0, len(other) - 1)))
        content[at : at + length] = other[start : start + length]
    elif how == "repeat":
        content[at:at] = content[at : at + length] * draw(st.sampled_from((1, 2, 100)))
    elif how == "remove":
        del content[at : at + length]
    elif how == "insert":
        content[at:at] = draw(st.binary(max_size=16))


def repaired(content: bytes) -> bytes:
    """Return a PNG with right checksums, so that the decoder looks behind them; anything else as it is."""
    if content[:4] != b"\x89PNG":
        return content
    parts, at = [content[:8]], 8
    while at + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, at)
        if at + 12 + length > len(content):
            break
        body = content[at + 4 : at + 8 + length]
        parts += [content[at : at + 4], body, struct.pack(">I", zlib.crc32(body))]
        at += 12 + length
    return b"".join([*parts, content[at:]])


def _seeds(*some: dict[str, Callable[[], bytes]]) -> list[bytes]:
    """Return the sound files of the corpus that are small."""
    made = [make() for group in some for name, make in group.items() if isinstance(FILES.get(name), Accepted)]
    return [content for content in made if len(content) <= LARGEST_SEED_FILE]


# Structured inputs


def _json_values() -> SearchStrategy[Any]:
    """Return what JSON can say, and what Python's reader takes beyond that."""
    words = st.one_of(
        st.text(max_size=20), st.sampled_from(["../x", "/etc/passwd", "a\0b", "\udce9", "=1+1", "9" * 5000, "[" * 3000])
    )
    numbers = st.one_of(
        st.integers(), st.floats(), st.sampled_from([10**400, -1, 0, 2**63, 1e308, float("nan"), float("inf")])
    )
    leaves = st.one_of(st.none(), st.booleans(), numbers, words)
    return st.recursive(
        leaves,
        lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(words, inner, max_size=4)),
        max_leaves=8,
    )


def _dumped(value: Any) -> bytes:
    return json.dumps(value).encode()


def _rows() -> SearchStrategy[list[dict[str, Any]]]:
    columns = st.sampled_from(COLUMNS + KNOBS)
    cells = st.one_of(_json_values(), st.sampled_from(["cat.png", "mesh.grid=64", "preview", "7", {"mesh.grid": 64}]))
    return st.lists(
        st.dictionaries(columns, cells, max_size=5).map(lambda row: {"path": "cat.png"} | row), min_size=1, max_size=4
    )


def _manifest_texts() -> SearchStrategy[bytes]:
    whole = [make() for _, make in (manifests.WHOLE | manifests.ROWS | manifests.SOUND).values()]
    small = [content for content in whole if len(content) < 2000]
    lines = st.lists(st.text(st.characters(codec="utf-8"), max_size=30), max_size=4).map(",".join)
    table = st.lists(lines, max_size=5).map(lambda rows: "\n".join(["path,name,seed,set,mesh.grid", *rows]).encode())
    rows = _rows()
    by_line = rows.map(lambda some: b"\n".join(map(_dumped, some)))
    return st.one_of(rows.map(_dumped), by_line, table, mutated(small), st.binary(max_size=200))


def _pairs() -> SearchStrategy[bytes]:
    knobs = st.sampled_from(
        [
            "mesh.grid",
            "mesh",
            "prior.kind",
            "motion.iterations",
            "static.resolution_schedule",
            "pack.fps",
            "...",
            "driving.kind",
        ]
    )
    names = st.one_of(knobs, st.text(max_size=12), st.lists(st.text(max_size=4), max_size=5).map(".".join))
    deep = st.tuples(st.sampled_from(["[", '{"a":', '["']), st.integers(1, 20_000)).map(lambda pair: pair[0] * pair[1])
    values = st.one_of(_json_values().map(json.dumps), st.text(max_size=30), deep)
    pair = st.tuples(names, st.sampled_from(["=", "", "==", " = "]), values).map("".join)
    return st.lists(pair, max_size=4).map(lambda some: "\n".join(some).encode("utf-8", "surrogatepass"))


def _scenes() -> SearchStrategy[bytes]:
    keys = st.sampled_from(["package", "name", "position", "rotation_deg", "scale", "start_s", "speed", "loop"])
    item = st.dictionaries(keys, st.one_of(_json_values(), st.lists(st.floats(), min_size=3, max_size=3)), max_size=5)
    scene = st.lists(item.map(lambda one: {"package": "gem"} | one), max_size=3).flatmap(
        lambda items: st.fixed_dictionaries(
            {"items": st.just(items)}, optional={"fps": _json_values(), "duration_s": _json_values()}
        )
    )
    return st.one_of(
        scene.map(_dumped), mutated([make() for make in _small(documents.SCENES)]), _json_values().map(_dumped)
    )


def _records() -> SearchStrategy[bytes]:
    sound = json.loads(documents.record()())
    keys = st.sampled_from(sorted(sound))
    changed = st.dictionaries(keys, _json_values(), min_size=1, max_size=3).map(
        lambda changes: _dumped(sound | changes)
    )
    facts = st.dictionaries(
        st.text(max_size=10),
        st.fixed_dictionaries({"digest": _json_values(), "size_bytes": _json_values()}),
        max_size=3,
    )
    step = st.fixed_dictionaries({"step": _json_values(), "digest": _json_values(), "outputs": _json_values()})
    deep = st.fixed_dictionaries({"files": facts, "steps": st.lists(step, max_size=2), "recipe": _json_values()})
    return st.one_of(
        changed, deep.map(lambda part: _dumped(sound | part)), mutated([make() for make in _small(documents.RECORDS)])
    )


def _small(some: dict[str, Callable[[], bytes]]) -> list[Callable[[], bytes]]:
    return [make for make in some.values() if len(make()) < 5000]


def _parquet() -> SearchStrategy[bytes]:
    """Return damaged Parquet files; without pyarrow every one is refused for that reason."""
    try:
        import pyarrow as arrow
        from pyarrow import parquet
    except ImportError:
        return st.just(b"PAR1")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.parquet"
        parquet.write_table(arrow.Table.from_pylist([{"path": "cat.png", "seed": 7, "name": "a"}] * 3), path)
        return mutated([path.read_bytes()])


def _banks() -> SearchStrategy[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        banks.FOLDERS["bank: sound"](Path(folder) / "bank")
        files = {path.name: path.read_bytes() for path in (Path(folder) / "bank").iterdir()}
    from tests.hostile.archives import packed

    about = st.dictionaries(
        st.sampled_from(["frames", "tile", "tile_size", "views"]), _json_values(), min_size=1, max_size=2
    )
    changed = about.map(lambda some: packed(files | {"bank.json": _dumped(banks.about() | some)}))
    seen = st.dictionaries(st.sampled_from(["file", "azimuth", "elevation", "radius"]), _json_values(), min_size=1)
    viewed = seen.map(lambda some: packed(files | {"bank.json": _dumped(banks.about(views=[banks.view(**some)]))}))
    return st.one_of(changed, viewed, mutated([packed(files)]))


TARGETS: dict[str, Target] = {
    "pictures": Target(0.3, ("source",), lambda: mutated(_seeds(PICTURES))),
    "videos": Target(0.25, ("source",), lambda: mutated(_seeds(VIDEOS))),
    "zips": Target(0.12, ("source", "zip"), lambda: mutated([*_seeds(ZIPS), UNPACKED["unpack: two files"]()])),
    "manifests": Target(0.12, ("csv", "json", "jsonl"), _manifest_texts),
    "parquet": Target(0.03, ("parquet",), _parquet),
    "settings": Target(0.05, ("settings",), _pairs),
    "scenes": Target(0.04, ("scene",), _scenes),
    "records": Target(0.05, ("record",), _records),
    "banks": Target(0.04, ("bank",), _banks),
}


def fuzz(name: str, child: Decoder, seconds: float, first_seed: int, shrink: bool = False) -> int:
    """Feed a target for a while.

    Args:
        name: of the target.
        child: reads; it may have been used before.
        seconds: of the clock; an input that is at work is finished.
        first_seed: equal seeds give equal inputs, as many as the time allows.
        shrink: look for a smaller input that fails, which takes as long as it takes.

    Returns:
        How many inputs were read.

    Raises:
        Found: a reader broke; says on what and where the input is saved.
    """
    target = TARGETS[name]
    with tempfile.TemporaryDirectory(prefix="dg4d-fuzz-") as scratch:
        configuration.set_hypothesis_home_dir(Path(scratch) / "hypothesis")
        inputs = st.tuples(target.inputs(), st.sampled_from(target.readers))
        child.ask(Path(scratch), "nothing")  # what it imports takes seconds
        run = _Run(name, child, Path(scratch) / "input", time.monotonic() + seconds, first_seed)
        limits = settings(
            max_examples=AT_ONCE, deadline=None, database=None, print_blob=False, report_multiple_bugs=False,
            phases=(Phase.generate, Phase.shrink) if shrink else (Phase.generate,),
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        rounds = 0
        while time.monotonic() < run.deadline:

            @seed(first_seed * 1_000_003 + rounds)
            @limits
            @given(inputs)
            def one_round(drawn: tuple[bytes, str]) -> None:
                run.read(*drawn)

            one_round()
            rounds += 1
    return run.count


class _Run:
    """Inputs of one target, one at a time."""

    def __init__(self, name: str, child: Decoder, path: Path, deadline: float, first_seed: int) -> None:
        self._name, self._child, self._path, self._seed = name, child, path, first_seed
        self.deadline = deadline
        self.count = 0
        self._failed = False

    def read(self, content: bytes, reader: str) -> None:
        if time.monotonic() > self.deadline and not self._failed:
            return
        self._path.write_bytes(content)
        outcome = self._child.ask(self._path, reader)
        self.count += 1
        if trouble := fault(outcome, reader):
            self._failed = True
            raise Found(f"{trouble}\nseed {self._seed}; {_saved(self._name, reader, content)}")


def fault(outcome: Outcome, reader: str) -> str:
    """Return what is wrong with a result; empty if nothing is."""
    if outcome.kind in ("broke", "crashed", "hung"):
        return f"{reader} {outcome.kind}: {outcome.says}"
    if reader == "source" and outcome.left:
        return f"{reader} left files behind: {outcome.left}"
    if outcome.peak_mb > MOST_MB or outcome.seconds > MOST_S:
        return f"{reader} took {outcome.peak_mb:.0f} MiB and {outcome.seconds:.1f} s"
    return ""


def _saved(name: str, reader: str, content: bytes) -> str:
    SAVED.mkdir(parents=True, exist_ok=True)
    path = SAVED / f"{name}.{reader}.{hashlib.sha256(content).hexdigest()[:12]}"
    path.write_bytes(content)
    return f"the input is saved: python -m tests.hostile.fuzz --replay {path}"


def replay(path: Path) -> Outcome:
    """Read a saved input again."""
    with (
        tempfile.TemporaryDirectory(prefix="dg4d-fuzz-") as scratch,
        Decoder(Path(scratch) / "child", HANGS_S) as child,
    ):
        return child.ask(path, path.name.split(".")[1])


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def main() -> None:
    """Run the fuzzer by hand."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(2**32))
    parser.add_argument("--target", choices=TARGETS, action="append", help="default: all, each its share of the time")
    parser.add_argument("--shrink", action="store_true", help="look for a smaller input that fails as well")
    parser.add_argument("--replay", type=Path, help="read this saved input")
    given_ = parser.parse_args()
    if given_.replay:
        outcome = replay(given_.replay)
        say(str(outcome))
        sys.exit(1 if fault(outcome, given_.replay.name.split(".")[1]) else 0)
    names = given_.target or list(TARGETS)
    whole = sum(TARGETS[name].share for name in names)
    say(f"seed {given_.seed}")
    failed = False
    with tempfile.TemporaryDirectory(prefix="dg4d-fuzz-") as scratch, Decoder(Path(scratch), HANGS_S) as child:
        for name in names:
            try:
                seconds = 60 * given_.minutes * TARGETS[name].share / whole
                say(f"{name}: {fuzz(name, child, seconds, given_.seed, given_.shrink)} inputs")
            except Found as found:
                failed = True
                say(f"{name}: {found}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
