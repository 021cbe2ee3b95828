"""What a Prefect server runs by its name and a filled-in form: the same work as the commands, on any worker.

Paths are those of the machine on which the worker runs; `deploy/prefect.yaml` says where which flow is deployed.
"""

import json
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from prefect import flow
from prefect.client.schemas.objects import State
from prefect.states import Completed, Failed
from pydantic import Field

from flows import home
from flows.batch import batch, tell
from flows.benchmark import bench
from flows.fetching import at_hand
from flows.make import connect, make
from flows.options import knobs_of
from flows.orders import Wish
from flows.publish import check_folder, is_current
from flows.terminal import console
from steps.contract import Frozen
from steps.profiles import profile, revise

Place = Annotated[str, Field(min_length=1)]
Workers = Annotated[int, Field(ge=1, le=64)]
Count = Annotated[int, Field(ge=1)]


class Options(Frozen):
    """What every conversion can be asked for."""

    profile: Literal["preview", "paper", "video", "video-fast", "reference", "quality"] = Field(
        "preview", description="named settings to start from"
    )
    seed: int = Field(0, ge=0, description="of everything random; equal seeds give equal bytes")
    triangles: int | None = Field(None, ge=100, description="of the mesh, at most")
    texture: int | None = Field(None, ge=64, le=8192, description="texels of a side")
    fps: float | None = Field(None, ge=1, le=240, description="frames per second of the files")
    changes: dict[str, Any] = Field({}, description='knobs by their dotted names: {"motion.iterations": 200}')
    commercial_only: bool = Field(False, description="refuse weights whose license forbids commercial use")

    def knobs(self) -> dict[str, Any]:
        """Every change to the profile."""
        return self.changes | knobs_of(self.triangles, self.texture, self.fps)


PREVIEW = Options()


@flow(name="image-to-4d", flow_run_name="{picture}", persist_result=False)
def image_to_4d(picture: Place, out: Place, options: Options = PREVIEW) -> None:
    """A picture becomes an animated 3D asset.

    Args:
        picture: a path on the worker's machine, https://HOST/FILE, or s3://BUCKET/KEY
        out: folder of the package, on the worker's machine
        options: what to ask for
    """
    with at_hand(picture) as path:
        _make(picture, Path(out), options, picture=path)


@flow(name="video-to-4d", flow_run_name="{video}", persist_result=False)
def video_to_4d(video: Place, out: Place, options: Options = PREVIEW) -> None:
    """A video becomes an animated 3D asset that moves as it does.

    Args:
        video: a path on the worker's machine, also of a folder of frames; https://HOST/FILE, or s3://BUCKET/KEY
        out: folder of the package, on the worker's machine
        options: what to ask for
    """
    with at_hand(video) as path:
        _make(video, Path(out), options, picture=path, video=path)


@flow(name="catalog", flow_run_name="{inputs}", persist_result=False)
def catalog(
    inputs: Place, out: Place, options: Options = PREVIEW, workers: Workers = 1, strict: bool = False
) -> State[None]:
    """Many pictures and videos become an asset each; those that are made already are left alone.

    Args:
        inputs: a folder, a pattern or a manifest on the worker's machine, or s3://BUCKET/PREFIX
        out: folder of the packages and of index.html, on the worker's machine
        options: what to ask for where an item says nothing else
        workers: items at a time
        strict: an asset that a gate does not let pass is a failure, and ends the batch
    """
    rows = batch(
        inputs,
        Path(out),
        console(),
        options.profile,
        options.knobs(),
        options.seed,
        workers,
        options.commercial_only,
        strict,
    )
    failed = tell(rows, Path(out), console())
    text = f"{sum(row.made for row in rows)} of {len(rows)} items are in {out}"
    return Failed(message=text) if failed else Completed(message=text)


@flow(name="benchmark", flow_run_name="{dataset}", persist_result=False)
def benchmark(
    dataset: Place,
    out: Place,
    options: Options = PREVIEW,
    mesh: bool = False,
    bank: bool = False,
    limit: Count | None = None,
    workers: Workers = 1,
) -> None:
    """Make an asset of every object of a data set and judge all of them against the truth.

    Args:
        dataset: a folder per object, on the worker's machine
        out: folder of the tables, films and packages, on the worker's machine
        options: what to ask for
        mesh: judge the textured meshes instead of the splats
        bank: every object's own bank of true views is its prior
        limit: only so many objects, the first by name
        workers: objects at a time
    """
    pairs = [f"{knob}={json.dumps(value)}" for knob, value in options.knobs().items()]
    bench(Path(dataset), Path(out), console(), options.profile, pairs, options.seed, mesh, bank, limit, workers)


def _make(address: str, folder: Path, options: Options, **files: Path) -> None:
    """As `dg4d make` does: what is made already is left alone."""
    connect()
    wish = Wish(
        item=PurePosixPath(urlsplit(address).path).stem,
        profile=options.profile,
        settings=revise(profile(options.profile), options.knobs()),
        seed=options.seed,
        commercial_only=options.commercial_only,
        **files,
    )
    wish.check()
    check_folder(folder)
    order = wish.order(home.store())
    if not is_current(folder, order.digest()):
        make(order, folder)
