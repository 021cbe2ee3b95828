"""Flows that a Prefect server runs by name with a filled-in form: the same work as the commands, on any worker.

Paths are those of the worker's machine, below the roots that its user allows (flows/serving/roots.py);
`deploy/prefect.yaml` lists the deployments.
"""

import json
import tempfile
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from prefect import flow, runtime
from prefect.client.schemas.objects import State
from prefect.states import Completed, Failed
from pydantic import ConfigDict, Field

from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.settings import Motion
from flows import home
from flows.catalog_request import CatalogRequest
from flows.commands.batch import batch, print_summary
from flows.commands.benchmark import bench
from flows.commands.options import knobs_of
from flows.commands.terminal import console
from flows.convert import connect, convert_job
from flows.engine.item_runs import FLOW, failure, read_job
from flows.engine.orphans import claim_run
from flows.engine.shared_results import sharing_results
from flows.inputs.conversion_job import ConversionRequest
from flows.inputs.fetching import local_copy, without_secrets
from flows.inputs.manifest import parse_changes
from flows.inputs.naming import clean
from flows.packages.delivery import Outcome, pack, write_outcome
from flows.packages.publish import check_folder, is_current
from flows.serving.roots import Roots
from steps.contract import LARGEST_SEED, ArtifactRef, Frozen
from steps.profiles import profile, revise

WHERE = r"^(|local|dask|deployment(:[\w .-]+)?)$"  # a scheduler of Dask runs code here: only the worker's user names it
BEGUN = 3  # times, at most, is a run begun whose process dies


def _title(text: str) -> dict[str, Any]:
    """What stands above a field of a form; by Prefect it is the name of the parameter."""
    return {"title": text}


def _may_stay_empty(schema: dict[str, Any]) -> None:
    """One field that may stay empty, where a form would first ask "int or None"."""
    schema |= schema.pop("anyOf")[0]
    del schema["default"]


def _in_order(schema: dict[str, Any]) -> None:
    """What matters most stands first; without a position some databases forget the order."""
    fields = schema["properties"]
    first = [name for name in ("profile", "motion") if name in fields]
    for position, name in enumerate(dict.fromkeys([*first, *fields])):
        fields[name]["position"] = position


def _filled_in(options: "Options") -> dict[str, Any]:
    """The fields of a form with options as they stand before anybody touches them."""
    return _title("How it is made") | {"default": options.model_dump(mode="json", exclude_none=True)}


Text = Annotated[str, Field(min_length=1)]
Folder = Annotated[Text, Field(json_schema_extra=_title("Folder for what is made"))]
Workers = Annotated[int, Field(ge=1, le=64, json_schema_extra=_title("Items at a time"))]
Setting = Annotated[str, Field(pattern=r"^\s*[a-z_]+(\.[a-z_0-9]+)*\s*=", title="Setting")]


class Options(Frozen):
    """What every conversion can be asked for."""

    model_config = ConfigDict(json_schema_extra=_in_order)

    profile: Literal["preview", "paper", "video", "video-fast", "reference", "quality"] = Field(
        "preview",
        title="Profile",
        description="`preview` takes minutes on any machine, without a pretrained model; others need a GPU and weights",
    )
    triangles: int | None = Field(
        None,
        ge=100,
        title="Triangles",
        description="of the mesh at most, 100 or more; empty: as the profile says",
        json_schema_extra=_may_stay_empty,
    )
    texture: int | None = Field(
        None,
        ge=64,
        le=8192,
        title="Texture size",
        description="pixels of a side, from 64 to 8192; empty: as the profile says",
        json_schema_extra=_may_stay_empty,
    )
    fps: float | None = Field(
        None,
        ge=1,
        le=240,
        title="Frames per second",
        description="of the files, from 1 to 240; empty: as the video, or the profile",
        json_schema_extra=_may_stay_empty,
    )
    seed: int = Field(
        0,
        ge=0,
        le=LARGEST_SEED,
        title="Seed",
        description=f"from 0 to {LARGEST_SEED}; another whole number gives another result of its kind",
    )
    commercial_only: bool = Field(
        False, title="Commercial use only", description="refuse pretrained weights whose license forbids selling"
    )
    settings: tuple[Setting, ...] = Field(
        (), title="Further settings", description="one per item, as `motion.iterations=400`; the command's `--set`"
    )

    def knobs(self) -> dict[str, Any]:
        """Every change to the profile.

        Raises:
            BadInput: a setting that is none.
        """
        return parse_changes(list(self.settings)) | knobs_of(self.triangles, self.texture, self.fps)


class PictureOptions(Options):
    """What a conversion of a picture can be asked for too."""

    motion: Motion | None = Field(
        None,
        title="Motion",
        description="how it moves, where no video model decides that (profile `preview`); empty: it sways",
        json_schema_extra=_may_stay_empty,
    )

    def knobs(self) -> dict[str, Any]:
        """Every change to the profile."""
        return super().knobs() | ({"driving.motion": self.motion} if self.motion else {})


Wanted = Annotated[Options, Field(json_schema_extra=_filled_in(Options()))]
WantedOfPictures = Annotated[PictureOptions, Field(json_schema_extra=_filled_in(PictureOptions()))]


@flow(name="picture-to-4d", flow_run_name=lambda: _name("picture"), persist_result=False)
def picture_to_4d(
    picture: Annotated[Text, Field(json_schema_extra=_title("Picture"))],
    out: Folder,
    options: WantedOfPictures = PictureOptions(),  # noqa: B008 - frozen
) -> None:
    """A picture becomes an animated 3D asset.

    Args:
        picture: a file on the worker's machine, as `/data/in/fox.png`; an address, as `https://host/fox.png`; or an
            object, as `s3://bucket/fox.png`. Cut-outs with a transparent background are best
        out: on the worker's machine, as `/data/out/fox`; open `report.html` there when it is done
        options: as it stands it works on any machine
    """
    _begin()
    roots = Roots.of_this_process()
    folder = roots.output(out)
    with local_copy(roots.source(picture)) as path:
        _make(picture, folder, options, roots, picture=path)


@flow(name="video-to-4d", flow_run_name=lambda: _name("video"), persist_result=False)
def video_to_4d(
    video: Annotated[Text, Field(json_schema_extra=_title("Video"))],
    out: Folder,
    options: Wanted = Options(),  # noqa: B008 - frozen
) -> None:
    """A video becomes an animated 3D asset that moves as it does.

    Args:
        video: a file or a folder of frames on the worker's machine, as `/data/in/walk.mp4`; an address, as
            `https://host/walk.mp4`; or an object, as `s3://bucket/walk.mp4`
        out: on the worker's machine, as `/data/out/walk`; open `report.html` there when it is done
        options: as it stands it works on any machine
    """
    _begin()
    roots = Roots.of_this_process()
    folder = roots.output(out)
    with local_copy(roots.source(video)) as path:
        _make(video, folder, options, roots, picture=path, video=path)


@flow(name="catalog-to-4d", flow_run_name=lambda: _name("inputs"), persist_result=False)
def catalog_to_4d(
    inputs: Annotated[Text, Field(json_schema_extra=_title("Pictures and videos"))],
    out: Folder,
    workers: Workers = 1,
    where: Annotated[str, Field(pattern=WHERE, json_schema_extra=_title("Items run on"))] = "",
    strict: Annotated[bool, Field(json_schema_extra=_title("Stop at a faulty asset"))] = False,
    options: WantedOfPictures = PictureOptions(),  # noqa: B008 - frozen
) -> State[None]:
    """Many pictures and videos become an asset each; those that are made already are left alone.

    Args:
        inputs: on the worker's machine a folder, as `/data/in`, a pattern, as `/data/in/**/*.png`, or a list, as
            `/data/in/list.csv`; or a place in an object store, as `s3://bucket/in/`
        out: on the worker's machine, as `/data/out`; open `index.html` there when it is done
        workers: from 1 to 64; more than one is quicker where there are cores, GPUs or machines for it
        where: `local` is this machine; `deployment:POOL` are the machines whose workers serve that pool, as `fleet`,
            and share the store of this one; `dask` the cluster that this machine knows; empty: as `$DG4D_RUNNER` says
        strict: an asset that fails a gate ends the batch; else it is marked, and the next one begins
        options: where a line of a list says nothing else; as it stands it works on any machine
    """
    _begin()
    roots = Roots.of_this_process()
    folder = roots.output(out)
    request = CatalogRequest(
        inputs=roots.inputs(inputs),
        out=folder,
        profile=options.profile,
        changes=_knobs(options, roots),
        seed=options.seed,
        workers=workers,
        where=where,
        commercial_only=options.commercial_only,
        strict=strict,
    )
    rows = batch(request, console(), allow=roots.check_item)
    failed = print_summary(rows, folder, console())
    text = f"{sum(row.made for row in rows)} of {len(rows)} items are in {folder}"
    return Failed(message=text) if failed else Completed(message=text)


@flow(name=FLOW, flow_run_name="{item}", persist_result=False)
def item_to_4d(
    item: Annotated[Text, Field(json_schema_extra=_title("Item"))],
    job: Annotated[ArtifactRef, Field(json_schema_extra=_title("ConversionJob"))],
    code: Annotated[Text, Field(json_schema_extra=_title("Code"))],
    store: Annotated[Text, Field(json_schema_extra=_title("Store"))],
) -> State[None]:
    """One item of a catalog becomes an asset in the store, from which the catalog fetches it.

    Args:
        item: name of the asset
        job: what to make, in the store that catalog and worker share
        code: digest of the steps of the catalog; a worker with others refuses the item
        store: address of the catalog's store, for messages
    """
    outcome = _made_for_catalog(job, code, store)
    write_outcome(home.store(), str(runtime.flow_run.id), outcome)
    if outcome.package is None:
        return Failed(message=f"{outcome.step}: {outcome.message}".removeprefix(": "))
    return Completed(message="every step was already done" if outcome.cached else "done")


@flow(name="benchmark", flow_run_name="{dataset}", persist_result=False)
def benchmark(
    dataset: Annotated[Text, Field(json_schema_extra=_title("Data set"))],
    out: Folder,
    limit: Annotated[int, Field(ge=0, json_schema_extra=_title("Objects at most"))] = 0,
    mesh: Annotated[bool, Field(json_schema_extra=_title("Judge the meshes"))] = False,
    bank: Annotated[bool, Field(json_schema_extra=_title("True views as the prior"))] = False,
    workers: Workers = 1,
    options: Wanted = Options(),  # noqa: B008 - frozen
) -> State[None]:
    """Make an asset of every object of a data set and judge all of them against the truth.

    Args:
        dataset: a folder on the worker's machine with a folder per object, as `/data/objects`
        out: on the worker's machine, as `/data/out`; tables, films and packages
        limit: the first so many by name; 0 for all of them
        mesh: the textured meshes are judged instead of the splats
        bank: every object's own bank of true views is its prior; this measures the optimization alone
        workers: from 1 to 64; more than one is quicker where there are cores, or GPUs, for it
        options: of every object
    """
    _begin()
    roots = Roots.of_this_process()
    folder, place = roots.output(out), Path(roots.folder(dataset))
    pairs = [f"{knob}={json.dumps(value)}" for knob, value in _knobs(options, roots).items()]
    asked = (options.profile, pairs, options.seed, mesh, bank, limit or None, workers)
    results = bench(place, folder, console(), *asked, allow=roots.check_files)
    text = f"{len(results.objects) - len(results.failed)} of {len(results.objects)} objects have scores in {out}"
    return Failed(message=text) if results.failed else Completed(message=text)


def _name(source: str) -> str:
    """Of a run, by the parameter that says what it is made of."""
    return without_secrets(runtime.flow_run.parameters[source])


def _begin() -> None:
    """Claim the run for this process; fail one that was begun too often, for it may be what kills its process."""
    claim_run()
    if runtime.flow_run.run_count > BEGUN:
        raise BackendUnavailable(
            f"this run was begun {BEGUN} times and did not end: see whether something kills it, as a machine does that "
            "has too little memory; then ask for a new run, which goes on after the last finished step"
        )


def _made_for_catalog(job: ArtifactRef, code: str, address: str) -> Outcome:
    """Make a job of a catalog into the store; a failure is an outcome too."""
    store = home.store()
    try:
        _begin()
        wanted = read_job(job, code, store, address)
        Roots.of_this_process().check_weights(wanted.settings.model_dump(mode="json"))
        connect()
        with sharing_results(store), tempfile.TemporaryDirectory(prefix="dg4d-item-") as scratch:
            folder = Path(scratch) / "package"
            _, cached = convert_job(wanted, folder)
            return Outcome(package=pack(folder, store), cached=cached)
    except Exception as error:  # whatever it is, the catalog has to know
        return failure(error)


def _knobs(options: Options, roots: Roots) -> dict[str, Any]:
    """Return every change to the profile; raises BadInput for weights that may not be read."""
    knobs = options.knobs()
    roots.check_knobs(knobs)
    return knobs


def _make(address: str, folder: Path, options: Options, roots: Roots, **files: Path) -> None:
    """Make an asset as `dg4d make` does: what is made already is left alone."""
    settings = revise(profile(options.profile), _knobs(options, roots))
    request = ConversionRequest(
        item=clean(PurePosixPath(urlsplit(address).path).stem) or "asset",
        profile=options.profile,
        settings=settings,
        seed=options.seed,
        commercial_only=options.commercial_only,
        **files,
    )
    request.check()
    check_folder(folder, request.item)
    job = request.to_job(home.store())
    if not is_current(folder, job.digest()):
        connect()
        convert_job(job, folder)
