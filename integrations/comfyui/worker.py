"""Worker of the ComfyUI nodes: one call of the dg4d API, run by the interpreter of dg4d's environment.

Standard input has one JSON line, `{"call": NAME, "arguments": {...}}`; its end interrupts the call. Standard output
gets JSON lines: events, then `result` or `error`.
"""

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import IO, Any

import dg4d

INTERRUPTED = 130  # exit status, as shells write it
RATE_LIMIT = 1000  # denominators of frame rates


def make(
    out: str,
    name: str,
    profile: str,
    seed: int,
    settings: Sequence[str],
    picture: str | None = None,
    frames: str | None = None,
    fps: float = 0.0,
    mask: str | None = None,
    views: dict[str, str] | None = None,
) -> dict[str, Any]:
    """Make an asset from a picture, or from a folder of frames, and return its folder and size."""
    from flows.inputs.manifest import parse_changes

    source = Path(frames) / "video.mkv" if frames else Path(picture or "")
    if frames:
        write_video(sorted(Path(frames).glob("*.png")), source, fps)
    asset = dg4d.make(
        source,
        mask=mask,
        views={float(azimuth): path for azimuth, path in (views or {}).items()},
        profile=profile,
        seed=seed,
        name=name,
        out=out,
        on_progress=report,
        **parse_changes(list(settings)),
    )
    return {"folder": str(asset.folder), "frames": asset.frames, "fps": asset.fps, "failing": asset.failing or []}


def render(folder: str, target: str, views: Sequence[dict[str, float]], size: int, mesh: bool) -> dict[str, Any]:
    """Render views of an asset into a .npy of RGBA pictures, float32 with straight alpha."""
    import numpy as np

    asset = dg4d.load(folder)
    pictures = []
    for number, view in enumerate(views):
        time = view["phase"] * asset.duration_s
        camera = dg4d.Camera(view["elevation"], view["azimuth"], width=size, height=size)
        pictures.append(asset.render(camera, time, mesh=mesh))
        emit("progress", fraction=(number + 1) / len(views), text=f"view {number + 1} of {len(views)}")
    np.save(target, np.stack(pictures))
    return {"views": len(pictures)}


def write_video(frames: Sequence[Path], path: Path, fps: float) -> None:
    """Write pictures as a lossless video; equal pictures give equal bytes."""
    import av
    from PIL import Image

    with av.open(str(path), "w", format="matroska", container_options={"fflags": "+bitexact"}) as container:
        stream = container.add_stream("ffv1", Fraction(fps).limit_denominator(RATE_LIMIT), {"flags": "+bitexact"})
        stream.pix_fmt = "bgr0"
        for number, frame in enumerate(frames):
            with Image.open(frame) as picture:
                image = av.VideoFrame.from_image(picture.convert("RGB"))
            if number == 0:
                stream.width, stream.height = image.width, image.height
            container.mux(stream.encode(image))
        container.mux(stream.encode(None))


def report(progress: dg4d.Progress) -> None:
    """Send the progress of a conversion."""
    done = max(progress.number - 1 + progress.fraction, 0.0) / max(progress.of, 1)
    emit("progress", fraction=done if progress.number else None, text=str(progress))


CALLS: dict[str, Callable[..., dict[str, Any]]] = {"make": make, "render": render}
_MAIN_THREAD = threading.get_ident()
_lock = threading.Lock()
_finished = threading.Event()


class _Answers:
    """Stream of the answers; standard output until `main` moves it."""

    stream: IO[str] = sys.stdout


def emit(event: str, **values: Any) -> None:
    """Send one event."""
    with _lock:
        _Answers.stream.write(json.dumps({"event": event, **values}) + "\n")
        _Answers.stream.flush()


def main() -> int:
    """Serve one request."""
    _Answers.stream = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # output of libraries must not reach the pipe
    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_interrupt_at_the_end_of_input, daemon=True).start()
    try:
        value = CALLS[request["call"]](**request["arguments"])
        _finished.set()
        emit("result", value=value)
    except KeyboardInterrupt:
        return INTERRUPTED
    except dg4d.DG4DError as error:
        _finished.set()
        emit("error", message=str(error))
    return 0


def _interrupt_at_the_end_of_input() -> None:
    sys.stdin.read()
    if not _finished.is_set():
        signal.pthread_kill(_MAIN_THREAD, signal.SIGINT)  # wakes it where it waits


if __name__ == "__main__":
    sys.exit(main())
