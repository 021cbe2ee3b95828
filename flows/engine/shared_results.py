"""Exchange of step results between machines through a shared store.

A machine caches results in its own home folder. If it dies in the middle of an item, the machine that takes the item
over reuses the finished steps from here.

results/KEY    a record as Prefect keeps it, by the name of `record_key`
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from flows import home
from flows.engine.events import StepEvent, listening
from flows.engine.records import parse_record
from flows.packages.delivery import RESULTS
from steps.store.artifact_store import ArtifactStore, StoreUnreachable
from steps.store.files import write_atomically


@contextmanager
def sharing_results(store: ArtifactStore) -> Iterator[None]:
    """Share the results of steps with other machines while the block runs."""
    keys: set[str] = set()
    _sharing.append((store, keys))

    def share_finished(event: StepEvent) -> None:
        if event.kind == "finished":
            with suppress(StoreUnreachable):  # at worst another machine runs the step again
                _share_results(store, keys)

    try:
        with listening(share_finished):
            yield
    finally:
        _sharing.remove((store, keys))


def fetch_result(key: str, record: Path) -> None:
    """Fetch the record of a result that another machine shares, unless it exists here; else share it once it exists.

    A record that `parse_record` refuses is replaced after its step has run again.
    """
    for store, keys in _sharing:
        if record.exists():
            return
        content = store.read(f"{RESULTS}/{key}")
        if content is None or not parse_record(content.decode(errors="replace")):
            keys.add(key)
        else:
            record.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(record, content.decode())


_sharing: list[tuple[ArtifactStore, set[str]]] = []


def _share_results(store: ArtifactStore, keys: set[str]) -> None:
    for key in sorted(keys):
        with suppress(FileNotFoundError):  # of a parallel step that has not finished
            store.write(f"{RESULTS}/{key}", (home.records() / key).read_text(encoding="utf-8"))
            keys.discard(key)
