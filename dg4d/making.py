"""Conversion of pictures and videos: `make` and `batch`."""

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union

from pydantic import ValidationError

from dg4d.asset import Asset, load
from dg4d.progress import OnProgress, reporting
from dg4d_lib.errors import BadInput, DG4DError
from flows.convert import connect, convert_job, stored
from flows.engine.output_lock import is_up_to_date
from flows.inputs.conversion_job import ConversionJob, ConversionRequest, name_from_text
from flows.inputs.given_views import ViewFile, ViewsRequest
from flows.inputs.manifest import Item, items_of
from flows.inputs.naming import name_from_path, unique_names
from flows.inputs.setting_reference import check_names
from flows.packages.publish import check_folder
from flows.step_errors import StepError
from steps.contract import settings_errors
from steps.profiles import profile as named_profile
from steps.profiles import revise
from steps.sources.views import check_direction
from steps.store.artifact_store import ArtifactMissing, StoreUnreachable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image

Engine = Literal["inline", "prefect"]
ENGINES = ("inline", "prefect")
Picture = Union[str, Path, "Image.Image", "NDArray[np.generic]"]
Views = Mapping[float | tuple[float, float], str | Path]  # azimuth, or azimuth and elevation, in degrees
CHANNELS = (3, 4)
PNG_MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "I;16")  # of PIL images
FAILURES = (DG4DError, StepError, ArtifactMissing, StoreUnreachable, OSError)  # of one item of a batch


@dataclass(frozen=True)
class Batch:
    """Result of a batch.

    Attributes:
        assets: finished assets by name.
        errors: errors of the other items by name.
    """

    assets: dict[str, Asset]
    errors: dict[str, Exception]


def make(
    picture: Picture | None = None,
    *,
    text: str = "",
    video: str | Path | None = None,
    views: Views | None = None,
    turntable: str | Path | None = None,
    cameras: str | Path | None = None,
    asset: str | Path | None = None,
    bank: str | Path | None = None,
    mask: str | Path | None = None,
    depth: str | Path | None = None,
    layers: str | Path | None = None,
    profile: str = "preview",
    seed: int = 0,
    name: str = "",
    out: str | Path | None = None,
    on_progress: OnProgress | None = None,
    engine: Engine = "inline",
    commercial_only: bool = False,
    force: bool = False,
    **settings: Any,
) -> Asset:
    """Make one animated asset; finished steps of earlier conversions are reused.

    Args:
        picture: picture or video: a path, a PIL image, or an array of shape (height, width, 3 or 4), uint8 or float in
            [0, 1].
        text: prompt for a text-to-image model, instead of a picture.
        video: driving video or folder of frames; a `picture` only names the asset.
        views: pictures of other sides at the first moment, by azimuth or (azimuth, elevation) in degrees.
        turntable: video, or folder of frames, of the still subject turned once.
        cameras: transforms.json of nerfstudio, with pictures of one moment or synchronized videos.
        asset: model of your own, a mesh or splats, that is set in motion.
        bank: folder of ground-truth views, for `prior.kind=oracle`.
        mask: picture, or folder of frames for a video, that is white where the subject is.
        depth: picture of the depth of the first frame: integers are inverse depth, floating-point numbers distances.
        layers: gray picture of the first frame: parts lighter than mid-gray lie before the rest, darker ones behind it.
        profile: set of settings.
        seed: seed of every step.
        name: name of the asset; default: from the name of picture, model or video, or from the text.
        out: folder of the package; default: out/NAME.
        on_progress: called with every event, from the threads of the steps; an exception of it ends the conversion.
        engine: `inline` runs the steps from this process; `prefect` runs a flow on the Prefect server of `dg4d up`,
            or on a background server.
        commercial_only: refuse weights whose license forbids commercial use.
        force: replace another asset in the output folder.
        settings: changes of the profile, nested or dotted: `motion={"iterations": 100}` or
            `**{"motion.iterations": 100}`.

    Raises:
        BadInput: the input or a setting cannot be used; says what is allowed.
        BackendUnavailable: a library, a device or weights are missing.
        StepError: a step failed; the output folder is as it was.
    """
    if views is not None and not isinstance(views, Mapping):
        raise BadInput(
            'views is a dict of azimuth to file, for example {90: "right.png"}; given ' + type(views).__name__
        )
    with _as_file(picture) as path:
        request = _request(
            item=name or _name_of(picture, asset, video, text),
            picture=path,
            text=text,
            video=Path(video) if video is not None else None,
            bank=Path(bank) if bank is not None else None,
            asset=Path(asset) if asset is not None else None,
            mask=Path(mask) if mask is not None else None,
            depth=Path(depth) if depth is not None else None,
            layers=Path(layers) if layers is not None else None,
            given_views=ViewsRequest(
                views=tuple(_view_file(place, path) for place, path in (views or {}).items()),
                turntable=Path(turntable) if turntable is not None else None,
                cameras=Path(cameras) if cameras is not None else None,
            ),
            profile=profile,
            settings=revise(named_profile(profile), flat_settings(settings)),
            seed=seed,
            commercial_only=commercial_only,
        )
        folder = Path(out) if out is not None else Path("out") / request.item
        return _convert(request, folder, engine, on_progress, force)


def batch(
    pictures: str | Path | Iterable[Picture],
    *,
    out: str | Path = "out",
    profile: str = "preview",
    seed: int = 0,
    workers: int = 1,
    on_progress: OnProgress | None = None,
    engine: Engine = "inline",
    commercial_only: bool = False,
    force: bool = False,
    **settings: Any,
) -> Batch:
    """Make many assets, each in OUT/NAME; a failed item does not stop the others.

    Args:
        pictures: pictures or videos as `make` takes them; or a folder, a pattern such as `photos/*.png`, an object
            store, or a manifest, as `dg4d batch` takes them.
        out: output folder.
        profile: set of settings.
        seed: seed of every step.
        workers: items converted at a time.
        on_progress: called with every event of every item.
        engine: as of `make`.
        commercial_only: refuse weights whose license forbids commercial use.
        force: replace other assets in the output folders.
        settings: changes of the profile, as of `make`.

    Raises:
        BadInput: the inputs or the settings cannot be used at all.
    """
    if workers < 1:
        raise BadInput(f"workers is {workers}; at least 1 is needed")
    out, changes = Path(out), flat_settings(settings)
    with _items(pictures, out, profile, changes, seed) as items:

        def convert(item: Item) -> Asset | Exception:
            try:
                with item.fetch() as fetched:
                    request = fetched.model_copy(update={"commercial_only": commercial_only})
                    return _convert(request, out / item.name, engine, on_progress, force)
            except FAILURES as error:
                return error

        results = dict(zip([item.name for item in items], _each(convert, items, workers), strict=True))
    return Batch(
        assets={name: result for name, result in results.items() if isinstance(result, Asset)},
        errors={name: result for name, result in results.items() if isinstance(result, Exception)},
    )


def flat_settings(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested and dotted settings as dotted ones.

    Raises:
        BadInput: a name is unknown; suggests the nearest one.
    """
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            flat |= flat_settings(value, f"{prefix}{name}.")
        else:
            flat[f"{prefix}{name}"] = list(value) if isinstance(value, tuple) else value
    if not prefix:
        check_names(flat)
    return flat


def _request(**fields: Any) -> ConversionRequest:
    """Return a checked request.

    Raises:
        BadInput: a field has a wrong type or value.
    """
    try:
        return ConversionRequest(**fields)
    except ValidationError as error:
        raise BadInput(settings_errors(error)) from error


def _convert(
    request: ConversionRequest, folder: Path, engine: Engine, on_progress: OnProgress | None, force: bool
) -> Asset:
    if engine not in ENGINES:
        raise BadInput(f"unknown engine {engine!r}; choose one of: {', '.join(ENGINES)}")
    request.check()
    check_folder(folder, request.item, force)
    with stored(request) as job:
        if not is_up_to_date(folder, job.digest()):
            with reporting(job, on_progress):
                _run(job, folder, engine, force)
    return load(folder)


def _run(job: ConversionJob, folder: Path, engine: Engine, force: bool) -> None:
    if engine == "inline":
        from flows.inline import convert_inline

        convert_inline(job, folder, force)
    else:
        connect()
        convert_job(job, folder, force=force)


def _each(convert: Any, items: list[Item], workers: int) -> list[Asset | Exception]:
    """Convert items in this thread, or several at a time."""
    if workers == 1:
        return [convert(item) for item in items]
    from flows.engine import executors, resources

    with ThreadPoolExecutor(workers, "dg4d-item") as pool:
        try:
            return list(pool.map(convert, items))
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            executors.stop_all()
            pool.shutdown()
            resources.stopping.clear()
            raise


@contextmanager
def _items(
    pictures: str | Path | Iterable[Picture], out: Path, profile: str, changes: dict[str, Any], seed: int
) -> Iterator[list[Item]]:
    """Yield the items of a batch; pictures in memory are files meanwhile."""
    if isinstance(pictures, str | Path):
        yield items_of(pictures, out, profile, changes, seed)
        return
    base = revise(named_profile(profile), changes)
    with tempfile.TemporaryDirectory(prefix="dg4d-pictures-") as scratch:
        paths = []
        for number, one in enumerate(pictures, 1):
            folder = Path(scratch) / str(number)
            paths.append(Path(one) if isinstance(one, str | Path) else _written(one, folder, f"picture-{number}"))
        if not paths:
            raise BadInput("the batch is empty; give one picture or more")
        names = unique_names([(name_from_path(path), path.suffix.lstrip(".")) for path in paths])
        yield [
            Item(name=name, request=_request(item=name, picture=path, profile=profile, settings=base, seed=seed))
            for name, path in zip(names, paths, strict=True)
        ]


@contextmanager
def _as_file(picture: Picture | None) -> Iterator[Path | None]:
    """Yield the path of a picture; one in memory is a temporary file meanwhile."""
    if picture is None or isinstance(picture, str | Path):
        yield None if picture is None else Path(picture)
        return
    with tempfile.TemporaryDirectory(prefix="dg4d-picture-") as folder:
        yield _written(picture, Path(folder), "picture")


def _written(picture: Any, folder: Path, stem: str) -> Path:
    """Write a PIL image or an array as PNG.

    Raises:
        BadInput: it is neither, or has another shape or type.
    """
    import numpy as np
    from PIL import Image, ImageOps

    if not isinstance(picture, Image.Image):
        pixels = np.asarray(picture)
        is_picture = pixels.ndim == 3 and pixels.size and pixels.shape[2] in CHANNELS
        if not is_picture or (pixels.dtype != np.uint8 and pixels.dtype.kind != "f"):
            raise BadInput(
                f"a picture in memory is a PIL image or an array of shape (height, width, 3 or 4), uint8 or float in "
                f"[0, 1]; given {type(picture).__name__} of shape {pixels.shape} and type {pixels.dtype}"
            )
        if pixels.dtype.kind == "f":
            pixels = (np.nan_to_num(pixels).clip(0, 1) * 255).round()
        picture = Image.fromarray(pixels.astype(np.uint8))
    picture = ImageOps.exif_transpose(picture)  # as in files
    if picture.mode not in PNG_MODES:
        picture = picture.convert("RGBA" if picture.mode == "RGBa" else "RGB")
    folder.mkdir(parents=True, exist_ok=True)
    picture.save(folder / f"{stem}.png")
    return folder / f"{stem}.png"


def _name_of(picture: Picture | None, asset: str | Path | None, video: str | Path | None, text: str) -> str:
    if picture is not None and not isinstance(picture, str | Path):
        return "asset"
    named = picture or asset or video
    return name_from_path(Path(named)) if named else name_from_text(text)


def _view_file(place: float | tuple[float, float], path: str | Path) -> ViewFile:
    azimuth, elevation = place if isinstance(place, tuple) else (place, 0.0)
    check_direction(azimuth, elevation, str(path))
    return ViewFile(azimuth=azimuth, elevation=elevation, path=Path(path))
