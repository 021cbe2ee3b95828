"""Flows of the deployments: the same work as the commands, started by a form of the Prefect UI on any worker.

Paths are those of the worker's machine, below the roots that its user allows (flows/serving/roots.py).
`deploy/prefect.yaml` lists the deployments.
"""

import json
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import httpx
from prefect import flow, runtime
from prefect.client.schemas.objects import State
from prefect.states import Completed, Failed
from pydantic import ConfigDict, Field

from dg4d_lib.errors import BackendUnavailable
from dg4d_lib.input_settings import Motion
from flows import home
from flows.catalog_request import CatalogRequest
from flows.commands.batch import batch, print_summary
from flows.commands.benchmark import bench
from flows.commands.options import shortcut_settings
from flows.commands.terminal import console
from flows.convert import connect, convert_job, stored
from flows.engine.cancellation import stay_cancelled
from flows.engine.item_runs import FLOW, failure, read_job
from flows.engine.orphans import claim_run
from flows.engine.output_lock import is_up_to_date
from flows.engine.shared_results import sharing_results
from flows.inputs.conversion_job import ConversionRequest
from flows.inputs.fetching import item_name, local_copy, without_secrets
from flows.inputs.given_views import ViewsRequest, parse_views
from flows.inputs.manifest import box_settings, parse_changes
from flows.inputs.naming import name_from_path
from flows.packages.delivery import Outcome, pack_package, write_outcome
from flows.packages.publish import check_folder
from flows.serving.roots import Roots
from flows.serving.server import ServerUnavailable
from flows.ui.showing import PATIENCE_S
from steps.contract import LARGEST_SEED, ArtifactRef, Frozen
from steps.profiles import ProfileName, profile, revise

WHERE = r"^(|local|dask|deployment(:[\w .-]+)?)$"  # no address of a Dask scheduler, which runs code
MOST_STARTS = 3  # starts of a run whose process dies


def _title(text: str) -> dict[str, Any]:
    """Return the schema extra that titles a field of a form; Prefect's default is the name of the parameter."""
    return {"title": text}


def _optional(title: str, description: str, ge: float | None = None, le: float | None = None) -> Any:
    """Return a field of a form that may stay empty; for None, Prefect's form would ask for the type first."""

    def unwrap(schema: dict[str, Any]) -> None:
        schema |= schema.pop("anyOf")[0]
        del schema["default"]

    return Field(None, title=title, description=description, json_schema_extra=unwrap, ge=ge, le=le)


def _sort_fields(schema: dict[str, Any]) -> None:
    """Put the most important fields first; databases may lose the order of fields without a position."""
    fields = schema["properties"]
    first = [name for name in ("profile", "motion") if name in fields]
    for position, name in enumerate(dict.fromkeys([*first, *fields])):
        fields[name]["position"] = position


def _options_field(options: "Options") -> dict[str, Any]:
    """Return the schema extra of a parameter with options, filled in with their defaults."""
    return _title("Options") | {"default": options.model_dump(mode="json", exclude_none=True)}


Text = Annotated[str, Field(min_length=1)]
Folder = Annotated[Text, Field(json_schema_extra=_title("Output folder"))]
Workers = Annotated[int, Field(ge=1, le=64, json_schema_extra=_title("Items at a time"))]
ViewText = Annotated[str, Field(pattern=r"^[-+.,\d\s]+=", title="View")]
Setting = Annotated[str, Field(pattern=r"^\s*[a-z_]+(\.[a-z_0-9]+)*\s*=", title="Setting")]


class Options(Frozen):
    """Options of every conversion."""

    # pydantic leaves the title of a field out of the schema if it is that of its class, by default the class name
    model_config = ConfigDict(json_schema_extra=_sort_fields, title="Options of a conversion")

    profile: ProfileName = Field(
        "preview",
        title="Profile",
        description="`preview` takes minutes on any machine, without a pretrained model; others need a GPU and weights",
    )
    triangles: int | None = _optional(
        "Triangles", "largest number of triangles, 100 or more; empty: set by the profile", ge=100
    )
    texture: int | None = _optional(
        "Texture size", "texels per side, from 64 to 8192; empty: set by the profile", ge=64, le=8192
    )
    fps: float | None = _optional(
        "Frames per second", "from 1 to 240; empty: that of the video, or set by the profile", ge=1, le=240
    )
    seed: int = Field(
        0,
        ge=0,
        le=LARGEST_SEED,
        title="Seed",
        description=f"from 0 to {LARGEST_SEED}; another seed gives another result",
    )
    commercial_only: bool = Field(
        False, title="Commercial use only", description="refuse pretrained weights whose license forbids commercial use"
    )
    settings: tuple[Setting, ...] = Field(
        (), title="Further settings", description="one per item, as `motion.iterations=400`; the command's `--set`"
    )

    def changes(self) -> dict[str, Any]:
        """Return the settings that differ from the profile.

        Raises:
            BadInput: a setting is invalid.
        """
        return parse_changes(list(self.settings)) | shortcut_settings(self.triangles, self.texture, self.fps)


class PictureOptions(Options):
    """Options of a conversion of a picture."""

    motion: Motion | None = _optional(
        "Motion", "used where no video model generates one (profile `preview`); empty: the subject sways"
    )

    def changes(self) -> dict[str, Any]:
        """Return the settings that differ from the profile."""
        return super().changes() | ({"driving.motion": self.motion} if self.motion else {})


class Sides(Frozen):
    """Pictures or a model of all sides; files on the worker's machine."""

    views: tuple[ViewText, ...] = Field(
        (), title="Views", description="one per item, AZIMUTH[,ELEVATION]=FILE in degrees, as `90=/data/in/right.png`"
    )
    turntable: str = Field("", title="Turntable", description="video of the still subject turned once, from its front")
    cameras: str = Field(
        "",
        title="Cameras",
        description="transforms.json of nerfstudio: pictures of the first frame, or synchronized videos",
    )
    asset: str = Field(
        "",
        title="Own model",
        description="instead of pictures: a mesh or splats that are set in motion, as `/data/in/fox.glb`",
    )

    def request(self) -> ViewsRequest:
        """Return the views by paths.

        Raises:
            BadInput: a view is not of its form.
        """
        turntable, cameras = (Path(text) if text else None for text in (self.turntable, self.cameras))
        return ViewsRequest(views=parse_views(self.views), turntable=turntable, cameras=cameras)


class Cutout(Frozen):
    """Hints for cutting the subject out and for its depth; empty: both are found."""

    mask: str = Field(
        "",
        title="Mask",
        description="picture, or folder of frames for a video, on the worker's machine: white where the subject is",
    )
    box: str = Field("", title="Box", description="X,Y,W,H in pixels, as `120,40,300,420`: the part with the subject")
    depth: str = Field(
        "",
        title="Depth",
        description="depth picture of the first frame, on the worker's machine: inverse depth (bright is near), or "
        "distances as EXR or TIFF with floating-point numbers",
    )
    layers: str = Field(
        "",
        title="Layers",
        description="gray picture of the first frame, same size, on the worker's machine: lighter than mid-gray is "
        "nearer, darker is farther",
    )


FormSides = Annotated[Sides, Field(json_schema_extra=_title("Other sides") | {"default": Sides().model_dump()})]
FormCutout = Annotated[
    Cutout, Field(json_schema_extra=_title("Cut-out and depth") | {"default": Cutout().model_dump()})
]
FormOptions = Annotated[Options, Field(json_schema_extra=_options_field(Options()))]
FormPictureOptions = Annotated[PictureOptions, Field(json_schema_extra=_options_field(PictureOptions()))]


@flow(
    name="picture-to-4d", flow_run_name=lambda: _run_name("picture"), persist_result=False, on_crashed=[stay_cancelled]
)
def picture_to_4d(
    picture: Annotated[Text, Field(json_schema_extra=_title("Picture"))],
    out: Folder,
    options: FormPictureOptions = PictureOptions(),  # noqa: B008 - frozen
    sides: FormSides = Sides(),  # noqa: B008 - frozen
    cutout: FormCutout = Cutout(),  # noqa: B008 - frozen
) -> None:
    """Convert a picture to an animated 3D asset.

    Args:
        picture: a file on the worker's machine, as `/data/in/fox.png`; an address, as `https://host/fox.png`; or an
            object, as `s3://bucket/fox.png`. Cut-outs with a transparent background are best
        out: on the worker's machine, as `/data/out/fox`; open `report.html` there when it is done
        options: the defaults work on any machine
        sides: pictures of other sides (they determine shape and colors), or a model
        cutout: mask or box of the subject, if the automatic cut-out fails; depth hints
    """
    _convert(picture, out, options, sides, cutout)


@flow(name="video-to-4d", flow_run_name=lambda: _run_name("video"), persist_result=False, on_crashed=[stay_cancelled])
def video_to_4d(
    video: Annotated[Text, Field(json_schema_extra=_title("Video"))],
    out: Folder,
    options: FormOptions = Options(),  # noqa: B008 - frozen
    sides: FormSides = Sides(),  # noqa: B008 - frozen
    cutout: FormCutout = Cutout(),  # noqa: B008 - frozen
) -> None:
    """Convert a video to an animated 3D asset that moves as the video does.

    Args:
        video: a file or a folder of frames on the worker's machine, as `/data/in/walk.mp4`; an address, as
            `https://host/walk.mp4`; or an object, as `s3://bucket/walk.mp4`
        out: on the worker's machine, as `/data/out/walk`; open `report.html` there when it is done
        options: the defaults work on any machine
        sides: pictures of other sides in the first frame (they determine shape and colors), or a model
        cutout: mask or box of the subject, if the automatic cut-out fails; depth hints
    """
    _convert(video, out, options, sides, cutout, is_video=True)


@flow(name="model-to-4d", flow_run_name=lambda: _run_name("model"), persist_result=False, on_crashed=[stay_cancelled])
def model_to_4d(
    model: Annotated[Text, Field(json_schema_extra=_title("Model"))],
    out: Folder,
    picture: Annotated[str, Field(json_schema_extra=_title("Picture"))] = "",
    options: FormPictureOptions = PictureOptions(),  # noqa: B008 - frozen
) -> None:
    """Set a model of your own in motion: a mesh or splats.

    Args:
        model: a file on the worker's machine, as `/data/in/fox.glb`; also .gltf, .obj, .usdz, .ply and .spz
        out: on the worker's machine, as `/data/out/fox`; open `report.html` there when it is done
        picture: of the model, or a video of its motion, on the worker's machine; empty: the motion is generated from a
            render of the model
        options: the defaults work on any machine
    """
    _start()
    roots = Roots.of_this_process()
    folder = roots.output(out)
    path, shown = Path(roots.folder(model)), Path(roots.folder(picture)) if picture else None
    item = name_from_path(path)
    _publish(_request(item, options, roots, picture=shown, asset=path), folder)


@flow(
    name="catalog-to-4d", flow_run_name=lambda: _run_name("inputs"), persist_result=False, on_crashed=[stay_cancelled]
)
def catalog_to_4d(
    inputs: Annotated[Text, Field(json_schema_extra=_title("Pictures and videos"))],
    out: Folder,
    workers: Workers = 1,
    where: Annotated[str, Field(pattern=WHERE, json_schema_extra=_title("Where items run"))] = "",
    strict: Annotated[bool, Field(json_schema_extra=_title("Stop at the first failed gate"))] = False,
    options: FormPictureOptions = PictureOptions(),  # noqa: B008 - frozen
) -> State[None]:
    """Convert many pictures and videos to an asset each; finished ones are skipped.

    Args:
        inputs: on the worker's machine a folder, as `/data/in`, a pattern, as `/data/in/**/*.png`, or a
            manifest, as `/data/in/list.csv`; or a place in an object store, as `s3://bucket/in/`
        out: on the worker's machine, as `/data/out`; open `index.html` there when it is done
        workers: from 1 to 64; more than one is faster with enough cores, GPUs or machines
        where: `local` is this machine; `deployment:POOL` are the machines whose workers serve that pool, as `fleet`,
            and share the store of this one; `dask` the cluster that this machine knows; empty: as `$DG4D_RUNNER` says
        strict: an asset that fails a quality gate ends the batch; else it is marked, and the next one is started
        options: defaults for rows of a manifest that do not set them; they work on any machine
    """
    _start()
    roots = Roots.of_this_process()
    folder = roots.output(out)
    request = CatalogRequest(
        inputs=roots.inputs(inputs),
        out=folder,
        profile=options.profile,
        changes=_changes(options, roots),
        seed=options.seed,
        workers=workers,
        where=where,
        commercial_only=options.commercial_only,
        strict=strict,
    )
    rows = batch(request, console(), allow=roots.check_item)
    failed = print_summary(rows, folder, console())
    text = f"{sum(row.has_package for row in rows)} of {len(rows)} items are in {folder}"
    return Failed(message=text) if failed else Completed(message=text)


@flow(name=FLOW, flow_run_name="{item}", persist_result=False, on_crashed=[stay_cancelled])
def item_to_4d(
    item: Annotated[Text, Field(json_schema_extra=_title("Item"))],
    job: Annotated[ArtifactRef, Field(json_schema_extra=_title("ConversionJob"))],
    code: Annotated[Text, Field(json_schema_extra=_title("Code"))],
    store: Annotated[Text, Field(json_schema_extra=_title("Store"))],
) -> State[None]:
    """Convert one item of a catalog; the package goes into the store, from which the catalog fetches it.

    Args:
        item: name of the asset
        job: conversion job, in the store that catalog and worker share
        code: digest of the steps of the catalog; a worker with other steps refuses the item
        store: address of the catalog's store, for messages
    """
    outcome = _convert_item(job, code, store)
    write_outcome(home.store(), str(runtime.flow_run.id), outcome)
    if outcome.package is None:
        return Failed(message=f"{outcome.step}: {outcome.message}".removeprefix(": "))
    return Completed(message="every step was already done" if outcome.cached else "done")


@flow(name="benchmark", flow_run_name="{dataset}", persist_result=False, on_crashed=[stay_cancelled])
def benchmark(
    dataset: Annotated[Text, Field(json_schema_extra=_title("Data set"))],
    out: Folder,
    limit: Annotated[int, Field(ge=0, json_schema_extra=_title("Maximum number of objects"))] = 0,
    mesh: Annotated[bool, Field(json_schema_extra=_title("Score the meshes"))] = False,
    bank: Annotated[bool, Field(json_schema_extra=_title("Ground-truth views as the prior"))] = False,
    workers: Workers = 1,
    options: FormOptions = Options(),  # noqa: B008 - frozen
) -> State[None]:
    """Convert every object of a data set and score the assets against the ground truth.

    Args:
        dataset: a folder on the worker's machine with a folder per object, as `/data/objects`
        out: on the worker's machine, as `/data/out`; tables, videos and packages
        limit: only the first N objects by name; 0: all
        mesh: score the textured meshes instead of the splats
        bank: use each object's ground-truth views as the prior, which measures the optimization alone
        workers: from 1 to 64; more than one is faster with enough cores or GPUs
        options: of every object
    """
    _start()
    roots = Roots.of_this_process()
    folder, place = roots.output(out), Path(roots.folder(dataset))
    pairs = [f"{name}={json.dumps(value)}" for name, value in _changes(options, roots).items()]
    asked = (options.profile, pairs, options.seed, mesh, bank, limit or None, workers)
    results = bench(place, folder, console(), *asked, allow=roots.check_files)
    text = f"{len(results.objects) - len(results.failed)} of {len(results.objects)} objects have scores in {out}"
    return Failed(message=text) if results.failed else Completed(message=text)


def _run_name(source: str) -> str:
    """Return the name of a run: the parameter that names its source."""
    return without_secrets(runtime.flow_run.parameters[source])


def _start() -> None:
    """Claim the run for this process; fail a run that was restarted too often, since it may crash its process."""
    _retry_until_server_answers(claim_run)
    if runtime.flow_run.run_count > MOST_STARTS:
        raise BackendUnavailable(
            f"this run was started {MOST_STARTS} times and did not end: find out what kills its process, for example "
            "too little memory; then start a new run, which resumes after the last finished step"
        )


def _convert_item(job: ArtifactRef, code: str, address: str) -> Outcome:
    """Convert a job of a catalog into the store; return an outcome also if it fails."""
    store = home.store()
    try:
        _start()
        wanted = read_job(job, code, store, address)
        Roots.of_this_process().check_weights(wanted.settings.model_dump(mode="json"))
        _retry_until_server_answers(connect)
        with sharing_results(store), tempfile.TemporaryDirectory(prefix="dg4d-item-") as scratch:
            folder = Path(scratch) / "package"
            _, cached = convert_job(wanted, folder)
            return Outcome(package=pack_package(folder, store), cached=cached)
    except Exception as error:  # the catalog waits for an outcome
        return failure(error)


def _changes(options: Options, roots: Roots) -> dict[str, Any]:
    """Return the settings that differ from the profile; raise BadInput for weights that may not be read."""
    changes = options.changes()
    roots.check_settings(changes)
    return changes


def _convert(address: str, out: str, options: Options, sides: Sides, cutout: Cutout, is_video: bool = False) -> None:
    """Convert a source as `dg4d make` does; do nothing if the folder holds its package already."""
    _start()
    roots = Roots.of_this_process()
    folder, given = roots.output(out), sides.request()
    named = {"mask": cutout.mask, "depth": cutout.depth, "layers": cutout.layers, "asset": sides.asset}
    own = {name: Path(text) if text else None for name, text in named.items()}
    roots.check_files([*given.files(), *filter(None, own.values())])
    source, item = roots.source(address), item_name(address)
    with local_copy(source) as path:
        files = {"picture": path, "video": path if is_video else None, **own}
        request = _request(item, options, roots, box_settings(cutout.box), given_views=given, **files)
        _publish(request, folder)


def _request(
    item: str, options: Options, roots: Roots, changes: Mapping[str, object] = MappingProxyType({}), **files: Any
) -> ConversionRequest:
    """Return the request of a form, with its files by their names and further settings."""
    return ConversionRequest(
        item=item,
        profile=options.profile,
        settings=revise(profile(options.profile), _changes(options, roots) | dict(changes)),
        seed=options.seed,
        commercial_only=options.commercial_only,
        **files,
    )


def _publish(request: ConversionRequest, folder: Path) -> None:
    """Convert a request into a folder, unless its package is there already."""
    request.check()
    check_folder(folder, request.item)
    with stored(request) as job:
        if not is_up_to_date(folder, job.digest()):
            _retry_until_server_answers(connect)
            convert_job(job, folder, force=False)


def _retry_until_server_answers(work: Callable[[], None]) -> None:
    """Ask the server of this run, which may restart, until it answers.

    Raises:
        ServerUnavailable, TransportError: it did not answer for `PATIENCE_S` seconds.
    """
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            work()
        except (ServerUnavailable, httpx.TransportError):
            if time.monotonic() > deadline:
                raise
            time.sleep(1.0)
        else:
            return
