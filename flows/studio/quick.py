"""Steps that the studio page waits for: the cut-out, and preview videos of motions, in child processes of the server.

They take no slot: they are small, and would otherwise wait for the fit of another asset. Results are recorded as those
of conversions are, so an equal step of a conversion takes them.
"""

import functools
import threading
from pathlib import Path
from typing import Any

from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import WarpSettings
from flows import home
from flows.engine.executors import configured_executor, prepare
from flows.engine.records import record_key, recorded, write_record
from flows.engine.requests import Conversion, request_for
from flows.inputs.models import put_model
from flows.inputs.sources import put_source
from flows.studio.drafts import Draft, Upload
from flows.ui import pages
from steps.contract import ArtifactRef, Frozen, StepResult
from steps.profiles import profile, revise
from steps.runtime.installed_code import catalog

MOTIONS = 6  # weights-free motions
CUTOUT_SIZE = 384  # pixels; mattes are estimated at up to twice as many
PREVIEW_SIZE = 256  # size of the subject in the preview videos, pixels
AT_ONCE = threading.Semaphore(2)


class CutOut(Frozen):
    """First frame of a source with its matte.

    Attributes:
        picture: address of the frame.
        matte: address of the matte, in the same pixels.
        width: of the source in pixels.
        height: of the source in pixels.
        kind: picture or video.
        frames: number of frames.
        has_alpha: true if the source marks its subject itself.
        notes: sentences about the cut-out.
        problem: reason if no subject was found; empty otherwise.
    """

    picture: str
    matte: str
    width: int
    height: int
    kind: str
    frames: int
    has_alpha: bool
    notes: tuple[str, ...]
    problem: str


class MotionPreview(Frozen):
    """Preview video of a motion.

    Attributes:
        motion: value of `driving.motion`.
        address: of the video, MP4.
    """

    motion: str
    address: str


def warm_up() -> None:
    """Start the fork server early, so that the first cut-out does not wait for its imports."""
    prepare()


def cut_out(draft: Draft, upload: Upload, box: tuple[int, ...] = ()) -> CutOut:
    """Cut the subject out of a file of a draft.

    Raises:
        StepError: the file cannot be read.
        BadInput: the box is invalid, or the file is a model.
    """
    if upload.kind == "model":
        raise BadInput("a model has no background to cut away")
    changes: dict[str, Any] = {"subject.size": CUTOUT_SIZE} | ({"subject.box": list(box)} if box else {})
    settings = revise(profile("preview"), changes)
    conversion = Conversion(item=draft.identifier, settings=settings)
    outputs = _run("cut_out", source=_source(upload), conversion=conversion).outputs
    facts = home.store().load_json(outputs["facts"])
    found = {name: pages.address(name, outputs[name], ".png") for name in ("picture", "matte")}
    return CutOut(**facts, **found)


def motion_previews(
    draft: Draft, profile_name: str, box: tuple[int, ...] = (), masked: bool = False
) -> list[MotionPreview]:
    """Return preview videos of the motions that a profile offers; none if a model generates the motion.

    Raises:
        StepError: the file cannot be read, or has no subject.
        BadInput: a matte is asked for that the user has not drawn.
    """
    upload = draft.first()
    settings = profile(profile_name)
    if upload.kind != "picture" or not isinstance(settings.driving, WarpSettings):
        return []
    changes: dict[str, Any] = {"driving.candidates": MOTIONS, "driving.motion": "sway", "subject.size": PREVIEW_SIZE}
    settings = revise(settings, changes | ({"subject.box": list(box)} if box and not masked else {}))
    conversion = Conversion(item=draft.identifier, settings=settings)
    mask = put_source(draft.saved_mask(), home.store()) if masked else None
    subject = _run("prepare_subject", source=_source(upload), conversion=conversion, mask=mask)
    if "footage" in subject.outputs:
        return []
    video = _run("drive_video", subject=subject, conversion=conversion)
    ranking = home.store().load_json(video.outputs["ranking"])
    address = entry_address(video.outputs["films"])
    rows = sorted(ranking["candidates"], key=lambda row: int(row["number"]))
    return [MotionPreview(motion=row["name"], address=f"{address}{row['number']}.mp4") for row in rows]


def entry_address(archive: ArtifactRef) -> str:
    """Return the address below which the entries of a zip of the store are."""
    return f"/dg4d/studio/entries/{archive.digest.removeprefix('sha256:')}/{archive.size_bytes}/"


def _source(upload: Upload) -> ArtifactRef:
    status = upload.path.stat()
    facts = upload.path, upload.kind == "model", status.st_mtime_ns, status.st_size
    if not home.store().has(_stored(*facts)):  # `dg4d store gc` removed it
        _stored.cache_clear()
    return _stored(*facts)


@functools.lru_cache(256)
def _stored(path: Path, is_model: bool, _modified: int, _size: int) -> ArtifactRef:
    """Put a file into the store once, however often its box changes."""
    return put_model(path, home.store()) if is_model else put_source(path, home.store())


def _run(step: str, **arguments: Any) -> StepResult:
    """Run a step, or take its recorded result."""
    request = request_for(step, arguments)
    record = home.records() / record_key(request)
    with AT_ONCE:
        found = recorded(record, home.store())
        if found is None:
            found = configured_executor()(catalog()[step], request, lambda *_: None, lambda _: None)
            record.parent.mkdir(parents=True, exist_ok=True)
            write_record(record, found)
        return found
