"""Conversion of pictures and videos: `make` and `batch`."""

import math
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Union

from pydantic import ValidationError

from dg4d.asset import Asset, load
from dg4d.progress import OnProgress, reporting
from dg4d_lib.errors import BadInput, DG4DError, quoted
from flows.convert import connect, convert_job, stored
from flows.engine.output_lock import is_up_to_date
from flows.inputs.conversion_job import ConversionJob, ConversionRequest, name_from_text
from flows.inputs.given_views import ViewFile, ViewsRequest
from flows.inputs.manifest import Item, items_of
from flows.inputs.naming import name_from_path, unique_names
from flows.inputs.setting_reference import check_names
from flows.packages.publish import check_folder
from steps.contract import settings_errors
from steps.profiles import profile as named_profile
from steps.profiles import revise
from steps.sources.views import check_direction

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image

Engine = Literal["inline", "prefect"]
ENGINES = ("inline", "prefect")
Picture = Union[str, Path, "Image.Image", "NDArray[np.generic]"]
Views = Mapping[float | tuple[float, float], Picture]  # azimuth, or azimuth and elevation, in degrees
VIEWS_EXAMPLE = 'for example {90: "right.png"}'
What = Literal["picture", "view", "mask"]
CHANNELS = (3, 4)
PNG_MODES = ("1", "L", "LA", "P", "RGB", "RGBA", "I;16", "I;16B")  # of PIL images
CONVERTED_MODES = {  # PIL modes that PNG does not have, and the one that they become
    "CMYK": "RGB", "YCbCr": "RGB", "LAB": "RGB", "HSV": "RGB", "RGBX": "RGB", "RGBa": "RGBA", "La": "LA", "PA": "RGBA",
}  # fmt: skip
ROUNDING = 0.5 / 255  # tolerance of floats outside of [0, 1]: half a step of 8 bits
FAILURES = (DG4DError, OSError)  # of one item of a batch


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
    mask: Picture | None = None,
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
        video: driving video or folder of frames; its first frame is the subject, and a `picture` only names the asset.
        views: pictures of other sides in the first frame, by azimuth or (azimuth, elevation) in degrees; each as
            `picture`.
        turntable: video, or folder of frames, of the still subject turned once.
        cameras: transforms.json of nerfstudio: pictures of the first frame, or synchronized videos.
        asset: model of your own, a mesh or splats, that is set in motion.
        bank: folder of ground-truth views, for `prior.kind=oracle`.
        mask: picture, or folder of frames for a video, that is white where the subject is: a path, a PIL image, or an
            array as `picture`, also bool and of shape (height, width).
        depth: picture of the depth of the first frame: integers are inverse depth, floating-point numbers distances.
        layers: gray picture of the first frame: lighter than mid-gray is nearer, darker is farther.
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
        StepError: a step failed; the output folder is as it was. If the step finds that the input cannot be used, or
            that something is missing, the error is also one of the two above.
    """
    driving_video, model = _path("video", video), _path("asset", asset)
    with tempfile.TemporaryDirectory(prefix="dg4d-pictures-") as scratch:
        request = _request(
            item=name or _name_of(picture, model, driving_video, text),
            picture=None if picture is None else _file(picture, Path(scratch), "picture"),
            text=text,
            video=driving_video,
            bank=_path("bank", bank),
            asset=model,
            mask=None if mask is None else _file(mask, Path(scratch), "mask", "mask"),
            depth=_path("depth", depth),
            layers=_path("layers", layers),
            given_views=ViewsRequest(
                views=_view_files({} if views is None else views, Path(scratch)),
                turntable=_path("turntable", turntable),
                cameras=_path("cameras", cameras),
            ),
            profile=profile,
            settings=revise(named_profile(profile), flat_settings(settings)),
            seed=seed,
            commercial_only=commercial_only,
        )
        folder = _path("out", out) or Path("out") / request.item
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
    out, changes = _path("out", out) or Path("out"), flat_settings(settings)
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
    if isinstance(pictures, str | os.PathLike):
        yield items_of(Path(pictures) if isinstance(pictures, os.PathLike) else pictures, out, profile, changes, seed)
        return
    if not isinstance(pictures, Iterable):
        raise BadInput(
            f"pictures is a list of pictures, a folder, a pattern or a manifest; given {type(pictures).__name__}"
        )
    base = revise(named_profile(profile), changes)
    with tempfile.TemporaryDirectory(prefix="dg4d-pictures-") as scratch:
        paths: list[Path] = []
        errors: dict[Path, str] = {}  # of pictures in memory that cannot be used
        for number, one in enumerate(pictures, 1):
            stem = f"picture-{number}"
            try:
                paths.append(_file(one, Path(scratch) / str(number), stem))
            except BadInput as error:
                paths.append(Path(scratch) / str(number) / f"{stem}.png")
                errors[paths[-1]] = str(error)
        if not paths:
            raise BadInput("the batch is empty; give one picture or more")
        names = unique_names([(name_from_path(path), path.suffix.lstrip(".")) for path in paths])
        yield [
            Item(name=name, error=errors[path])
            if path in errors
            else Item(name=name, request=_request(item=name, picture=path, profile=profile, settings=base, seed=seed))
            for name, path in zip(names, paths, strict=True)
        ]


def _path(name: str, given: Any) -> Path | None:
    """Return the path that an argument has, if it is given.

    Raises:
        BadInput: it is not a path.
    """
    if given is None:
        return None
    if not isinstance(given, str | os.PathLike):
        raise BadInput(f"{name} is a path; given {type(given).__name__}")
    return Path(given)


def _file(given: Any, folder: Path, stem: str, what: What = "picture") -> Path:
    """Return a path as it is; write a picture in memory into a folder."""
    return Path(given) if isinstance(given, str | os.PathLike) else _written(given, folder, stem, what)


def _written(given: Any, folder: Path, stem: str, what: What) -> Path:
    """Write a PIL image or an array as PNG.

    Raises:
        BadInput: it is neither, or has another shape, type or range.
    """
    from PIL import Image, ImageOps

    picture = given if isinstance(given, Image.Image) else Image.fromarray(_pixels(given, what))
    try:
        picture = ImageOps.exif_transpose(picture)  # as in files; an opened file is read here
    except (OSError, ValueError, SyntaxError) as error:  # a broken file, or one that was closed
        raise BadInput(f"a PIL image cannot be read: {error}; open it again, or export it as PNG or JPEG") from error
    if picture.mode not in PNG_MODES:
        if picture.mode not in CONVERTED_MODES:
            raise BadInput(
                f"a PIL image of mode {picture.mode!r} has no known range: scale its values to 0 to 255 and convert it "
                f"to L or RGB; allowed modes: {', '.join((*PNG_MODES, *CONVERTED_MODES))}"
            )
        picture = picture.convert(CONVERTED_MODES[picture.mode])
    folder.mkdir(parents=True, exist_ok=True)
    picture.save(folder / f"{stem}.png")
    return folder / f"{stem}.png"


def _pixels(given: Any, what: What) -> "NDArray[np.uint8]":
    """Return an array as 8-bit pixels.

    Raises:
        BadInput: it is not an array of pixels, or its floats leave [0, 1].
    """
    import numpy as np

    try:
        pixels = np.asarray(given)
    except (TypeError, ValueError, RuntimeError) as error:  # tensors on a GPU or with gradients, rows of unequal length
        raise BadInput(
            f"a {what} is a path, a PIL image or an array; given {type(given).__name__}, which NumPy cannot convert: "
            f"{error}"
        ) from error
    is_plane = what == "mask" and pixels.ndim == 2
    is_picture = pixels.ndim == 3 and pixels.shape[2] in CHANNELS
    is_known = pixels.dtype == np.uint8 or pixels.dtype.kind in ("fb" if what == "mask" else "f")
    if not pixels.size or not (is_plane or is_picture) or not is_known:
        shape, types = ("(height, width) or ", "bool, ") if what == "mask" else ("", "")
        raise BadInput(
            f"a {what} is a path, a PIL image or an array of shape {shape}(height, width, 3 or 4), {types}uint8 or "
            f"float in [0, 1]; given {type(given).__name__} of shape {pixels.shape} and type {pixels.dtype}"
        )
    if pixels.dtype == np.uint8:
        return pixels
    lowest, highest = float(pixels.min()), float(pixels.max())  # NaN if one is NaN
    if not -ROUNDING <= lowest <= highest <= 1 + ROUNDING:
        found = (
            "NaN; replace it"
            if math.isnan(lowest)
            else f"values from {lowest:g} to {highest:g}; divide by 255, or clip them"
        )
        raise BadInput(f"a {what} as an array has floats in [0, 1]; given {found}")
    return (pixels.clip(0, 1) * 255.0).round().astype(np.uint8)


def _name_of(picture: Picture | None, asset: Path | None, video: Path | None, text: Any) -> str:
    if picture is not None and not isinstance(picture, str | os.PathLike):
        return "asset"
    if named := picture or asset or video:
        return name_from_path(Path(named))
    if not isinstance(text, str):
        raise BadInput(f"text is a string; given {type(text).__name__}")
    return name_from_text(text)


def _view_files(views: Views, folder: Path) -> tuple[ViewFile, ...]:
    """Return the files of views and their directions; write views in memory into a folder.

    Raises:
        BadInput: it is not a dict of pictures by direction, or a direction is out of range.
    """
    if not isinstance(views, Mapping):
        raise BadInput(f"views is a dict of azimuth to picture, {VIEWS_EXAMPLE}; given {type(views).__name__}")
    found = []
    for number, (place, given) in enumerate(views.items(), 1):
        angles = place if isinstance(place, tuple) else (place, 0.0)
        if len(angles) != 2 or not all(isinstance(angle, Real) for angle in angles):
            raise BadInput(
                f"views has the direction {quoted(place)}; give the azimuth, or (azimuth, elevation), in degrees as "
                f"numbers, {VIEWS_EXAMPLE}"
            )
        path = _file(given, folder, f"view-{number}", "view")
        azimuth, elevation = map(float, angles)
        check_direction(azimuth, elevation, path.name)
        found.append(ViewFile(azimuth=azimuth, elevation=elevation, path=path))
    return tuple(found)
