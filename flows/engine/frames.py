"""Division of the frames of a driving video among tasks."""

import math
import zipfile

from flows.engine.requests import Part
from steps.contract import ArtifactRef
from steps.store.artifact_store import ArtifactStore


def count_frames(frames: ArtifactRef, store: ArtifactStore) -> int:
    """Return the number of frames of a `frames` artifact."""
    with zipfile.ZipFile(store.path(frames)) as archive:
        return sum(name.endswith(".png") for name in archive.namelist())


def divide_frames(frames: int, tasks: int) -> list[Part]:
    """Divide frames into parts whose sizes differ by at most one; no more parts than frames."""
    count = max(1, min(frames, tasks))
    ends = [math.ceil(frames * number / count) for number in range(count + 1)]
    return [
        Part(number=number + 1, of=count, first_frame=ends[number], end_frame=ends[number + 1])
        for number in range(count)
    ]
