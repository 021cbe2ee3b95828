"""`dg4d score` and `dg4d bench`: assets against ground truth, with every result in files."""

import json
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from dg4d_lib.asset_settings import ScoreSettings
from dg4d_lib.errors import BadInput, DG4DError
from flows import home
from flows.commands import terminal
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.inputs.manifest import parse_changes
from flows.packages import scores
from flows.packages.publish import check_folder, check_writable, is_current, load_verified
from flows.packages.scores import Results
from flows.packages.summary import BAD_INPUT, BatchProgress, Row
from flows.step_errors import StepError, StepMissing
from steps.artifacts.archives import add_entry, unpack
from steps.artifacts.ground_truth import Truth, find_truth, find_truths
from steps.catalog import PACKAGE, TRUTH
from steps.contract import ArtifactRef
from steps.profiles import ScoreAssetSettings, profile, revise
from steps.runtime.weights import without_paths
from steps.sources.media_types import check_arrays, check_still
from steps.store.artifact_store import ArtifactStore
from steps.store.files import room_for, write_atomically

if TYPE_CHECKING:
    from rich.console import Console

    from flows.benchmark import BenchmarkEntry, BenchmarkResult

NEEDED = ("asset.json", "asset.glb", "splats/", "meshes/", "canonical/")  # of a package, to draw it
OWN = "score."  # before the knobs of scoring
MISSING = frozenset(["StepMissing", "StepLost", "StepUnreachable"])  # kinds of failure for which something is not here
ASSETS, FILMS = "assets", "films"  # folders of a benchmark


def score(
    package: Path,
    truth: Path,
    console: "Console",
    mesh: bool = False,
    changes: list[str] | None = None,
    out: Path | None = None,
) -> Results:
    """Judge one finished asset.

    Args:
        package: its folder.
        truth: a folder in a layout of steps/artifacts/ground_truth.py, or a picture, where other sides are unknown.
        console: where to show how far it is.
        mesh: judge the textured mesh instead of the splats.
        changes: "score.KNOB=VALUE", knobs of `ScoreSettings`.
        out: a file to write the results to, as JSON.

    Raises:
        BadInput: the asset, the truth or a setting cannot be used, or `out` cannot be written.
        StepError: the step did not finish.
    """
    found, (pipeline, settings) = find_truth(truth), _settings(changes, mesh)
    if pipeline:
        raise BadInput(f"the asset is finished: only knobs that begin with {OWN!r} can be set; given {min(pipeline)}")
    record = load_verified(package)
    if out is not None:
        check_writable(out.parent)
    from flows.convert import connect

    connect()
    from flows.benchmark import BenchmarkEntry, score_assets
    from flows.engine.step_tasks import flow_context

    entry = BenchmarkEntry(
        name=found.name,
        truth=put_truth(found, home.store()),
        package=put_package(package, record, home.store()),
        seconds=_seconds(record),
    )
    with terminal.steps_shown(console), flow_context():
        judged = score_assets(
            [entry], settings, f"{package.absolute().name} against {found.name}", package.absolute().name
        )
    for one in judged.results.failed:
        if one.kind in BAD_INPUT:
            raise BadInput(f"{package} cannot be judged against {truth}: {one.error}")
        raise (StepMissing if one.kind in MISSING else StepError)("score_asset", one.error)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, _json(judged.results))
    return judged.results


def bench(
    dataset: Path,
    out: Path,
    console: "Console",
    profile_name: str = "preview",
    changes: list[str] | None = None,
    seed: int = 0,
    mesh: bool = False,
    bank: bool = False,
    limit: int | None = None,
    workers: int = 1,
    allow: Callable[[Iterable[Path]], None] | None = None,
) -> Results:
    """Make an asset of every object of a data set, judge all, and write what was found; what is done is left alone.

    OUT gets results.json, results.csv, table.md, index.html, films/ and the packages in assets/.

    Args:
        dataset: a folder per object, in a layout of steps/artifacts/ground_truth.py.
        out: made if it is not there.
        console: where to show how far it is.
        profile_name: of the conversion.
        changes: "KNOB=VALUE" of the conversion, "score.KNOB=VALUE" of scoring.
        seed: of everything random.
        mesh: judge the textured meshes instead of the splats.
        bank: every object's own bank of true views is its prior.
        limit: only so many objects, the first by name.
        workers: objects at a time.
        allow: raises BadInput for files that may not be read here.

    Raises:
        BadInput: the data set or a setting cannot be used, or `out` cannot be written.
        BackendUnavailable: what the profile needs is not here.
    """
    truths = find_truths(dataset)[:limit]
    for truth in truths:
        if allow:
            allow(truth.files)
        check_truth(truth)
    knobs, settings = _settings(changes, mesh)
    if bank:
        knobs = {"prior.kind": "oracle", **knobs}
        if without := [truth.name for truth in truths if truth.bank is None]:
            raise BadInput(f"--bank: these objects have no bank of true views: {', '.join(without)}")
    pipeline = revise(profile(profile_name), knobs)
    settings = settings.model_copy(update={"rasterizer": pipeline.rasterizer})
    settings = ScoreAssetSettings.model_validate(settings.model_dump(mode="json"))
    check_writable(out)
    requests = [_request(truth, bank, profile=profile_name, settings=pipeline, seed=seed) for truth in truths]
    for request in requests:
        request.check()
        check_folder(out / ASSETS / request.item)
    from flows.convert import connect

    connect()
    rows = _converted(
        [request.to_job(home.store()) for request in requests], out / ASSETS, workers, console, dataset.name
    )
    from flows.benchmark import score_assets
    from flows.engine.step_tasks import flow_context

    entries = [_entry(truth, out / ASSETS / truth.name, rows[truth.name]) for truth in truths]
    title = f"{dataset.absolute().name}, {profile_name}{', true views as prior' if bank else ''}"
    with terminal.batch_shown(console, [truth.name for truth in truths]) as table, flow_context():
        judged = score_assets(entries, settings, title, profile_name, seed)
        for one in judged.results.objects:
            table.settle(one.object, "failed" if one.error else "done", one.error)
    results = judged.results.model_copy(update={"settings": {**judged.results.settings, "changes": knobs}})
    write(results, judged, out)
    return results


def write(results: Results, judged: "BenchmarkResult", out: Path) -> None:
    """Write the files of a benchmark; raises DiskFull."""
    shown = _put_films(judged, out)
    texts = {
        "results.json": _json(results),
        "results.csv": scores.csv_text(results),
        "table.md": scores.markdown(results),
        "index.html": scores.scores_page(results, shown),
    }
    for name, text in texts.items():
        write_atomically(out / name, text)


def check_truth(truth: Truth) -> None:
    """Refuse a ground truth with files that are no pictures, or a mesh that is no NumPy archive.

    Raises:
        BadInput: says which file.
    """
    for path in truth.pictures:
        check_still(path)
    if truth.mesh is not None:
        check_arrays(truth.mesh)


def put_truth(truth: Truth, store: ArtifactStore) -> ArtifactRef:
    """Keep a ground truth in our own layout; equal pictures give equal bytes, whatever layout they had.

    Raises:
        BadInput: a file is no picture, or the mesh no NumPy archive.
        DiskFull: there is no room.
    """
    check_truth(truth)
    files = {f"input/{i:03d}{path.suffix.lower()}": path for i, path in enumerate(truth.inputs)}
    for view in truth.views:
        files |= {f"view_{view.name}/{i:03d}{path.suffix.lower()}": path for i, path in enumerate(view.frames)}
    if truth.mesh is not None:
        files["mesh.npz"] = truth.mesh
    return _put(files, TRUTH.media_type, store)


def put_package(folder: Path, record: Mapping[str, Any], store: ArtifactStore) -> ArtifactRef:
    """Keep what is needed to draw the package in a folder, whose provenance is `record`."""
    names = [name for name in sorted(record["files"]) if name.startswith(NEEDED)]
    return _put({name: folder / name for name in names}, PACKAGE.media_type, store)


def _settings(changes: list[str] | None, mesh: bool) -> tuple[dict[str, Any], ScoreAssetSettings]:
    """The knobs of the conversion that were set, and the settings of scoring."""
    given = parse_changes(changes or [])
    own = {key.removeprefix(OWN): value for key, value in given.items() if key.startswith(OWN)}
    try:
        tree = ScoreSettings.model_validate(own).model_dump(mode="json")
        settings = ScoreAssetSettings(rasterizer="auto", mesh=mesh, score=ScoreSettings(**without_paths(tree)))
    except ValidationError as error:
        lines = [f"{OWN}{'.'.join(map(str, e['loc']))} = {e['input']!r}: {e['msg']}" for e in error.errors()]
        known = ", ".join(f"{OWN}{name}" for name in ScoreSettings.model_fields)
        raise BadInput(f"settings refused: {'; '.join(lines)}; there are: {known}") from error
    return {key: value for key, value in given.items() if not key.startswith(OWN)}, settings


def _request(truth: Truth, bank: bool, **asked: Any) -> ConversionRequest:
    """What `dg4d make` would be asked for: the input film is followed, or the input picture is made to move."""
    folder = truth.inputs[0].parent
    return ConversionRequest(
        item=truth.name,
        picture=truth.inputs[0],
        video=folder if len(truth.inputs) > 1 else None,
        bank=truth.bank if bank else None,
        **asked,
    )


def _converted(jobs: list[ConversionJob], folder: Path, workers: int, console: "Console", name: str) -> dict[str, Row]:
    """Make what is not made yet; what became of every object."""
    from flows.catalog import run_jobs

    rows = {job.item: Row(item=job.item, status="unchanged") for job in jobs}
    waiting = [job for job in jobs if not is_current(folder / job.item, job.digest())]
    if not waiting:
        return rows
    with terminal.batch_shown(console, [job.item for job in waiting]) as table:

        def show(row: Row) -> None:
            table.settle(row.item, row.status, row.message)
            if not console.is_terminal:
                console.print(f"{row.item}: {row.status} {row.message}", markup=False)

        progress = BatchProgress(len(waiting), show)
        run_jobs(waiting, folder, workers, f"{name}: {len(waiting)} objects", progress)
    return rows | progress.rows


def _entry(truth: Truth, folder: Path, row: Row) -> "BenchmarkEntry":
    from flows.benchmark import BenchmarkEntry

    ref = put_truth(truth, home.store())
    if row.status == "failed":
        return BenchmarkEntry(name=truth.name, truth=ref, error=row.message, kind=row.kind)
    try:
        record = load_verified(folder)
        package = put_package(folder, record, home.store())
    except DG4DError as error:
        return BenchmarkEntry(name=truth.name, truth=ref, error=str(error), kind=type(error).__name__)
    return BenchmarkEntry(name=truth.name, truth=ref, package=package, seconds=_seconds(record))


def _seconds(record: Mapping[str, Any]) -> float:
    """What the steps of a package took to compute, now or before."""
    steps = record.get("run", {}).get("steps", [])
    return round(sum(float(step.get("duration_s", 0.0)) for step in steps), 1)


def _json(results: Results) -> str:
    return json.dumps(results.model_dump(mode="json"), indent=1, ensure_ascii=False) + "\n"


def _put_films(judged: "BenchmarkResult", out: Path) -> dict[str, dict[str, dict[str, str]]]:
    """Unpack every film below OUT; where each lies, by object, whose it is, and view."""
    shown: dict[str, dict[str, dict[str, str]]] = {}
    for name, refs in judged.films.items():
        for whose, ref in refs.items():
            folder = out / FILMS / name / whose
            folder.mkdir(parents=True, exist_ok=True)
            with room_for(folder):
                films = unpack(home.store().path(ref), folder, "the zip of films")
            views = {Path(film).stem: f"{FILMS}/{name}/{whose}/{film}" for film in films}
            shown.setdefault(name, {})[whose] = views
    return shown


def _put(files: Mapping[str, Path], media_type: str, store: ArtifactStore) -> ArtifactRef:
    """A stored zip; equal files under equal names give equal bytes."""
    with tempfile.TemporaryDirectory(prefix="dg4d-score-") as scratch, room_for(Path(scratch)):
        path = Path(scratch) / "files.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for name, content in _contents(files):
                add_entry(archive, name, content)
        return store.put(path, media_type)


def _contents(files: Mapping[str, Path]) -> Iterator[tuple[str, bytes]]:
    for name, path in files.items():
        try:
            yield name, path.read_bytes()
        except OSError as error:
            raise BadInput(f"{path} cannot be read: {error.strerror}") from error
