"""Evaluation of assets against ground truth; behind `dg4d score` and `dg4d bench`."""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from dg4d_lib.asset_settings import ScoreSettings
from dg4d_lib.errors import BadInput, DG4DError
from dg4d_lib.input_settings import SubjectSettings
from flows import home
from flows.commands import terminal
from flows.engine.leases import running
from flows.engine.output_lock import is_up_to_date
from flows.exit_status import EXIT_BAD_INPUT, EXIT_MISSING, EXIT_STATUS
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.inputs.manifest import parse_changes
from flows.inputs.package_record import RECORD
from flows.inputs.sources import put_zip
from flows.packages import scores
from flows.packages.publish import check_folder, check_writable, load_verified
from flows.packages.scores import Results
from flows.packages.summary import BatchProgress, Row
from flows.step_errors import StepError, StepMissing
from steps.artifacts.archives import unpack
from steps.artifacts.ground_truth import MESH, GroundTruth, find_ground_truth, find_ground_truths
from steps.catalog import GROUND_TRUTH, PACKAGE
from steps.contract import ArtifactRef
from steps.profiles import ScoreAssetSettings, profile, revise
from steps.runtime.weights import without_paths
from steps.sources.media_types import check_arrays, check_still
from steps.store.artifact_store import ArtifactStore
from steps.store.files import room_for, write_atomically

if TYPE_CHECKING:
    from rich.console import Console

    from flows.benchmark import BenchmarkEntry, BenchmarkResult

NEEDED = ("asset.json", "asset.glb", "splats/", "meshes/", "canonical/")  # files of a package for rendering
SCORE = "score."  # prefix of the settings of scores
UNSCORED = frozenset(["pack_asset", "check_asset"])  # steps whose time counts for no score
MESH_STEPS = frozenset(["plan_mesh", "extract_mesh", "join_meshes", "refine_texture"])  # not needed by the splats
ASSETS, VIDEOS = "assets", "films"  # folders of a benchmark


def score(
    package: Path,
    ground_truth: Path,
    console: "Console",
    mesh: bool = False,
    changes: list[str] | None = None,
    out: Path | None = None,
    actionbench: bool = False,
) -> Results:
    """Score one asset.

    Args:
        package: folder of the asset.
        ground_truth: folder in a layout of steps/artifacts/ground_truth.py, or a picture if other views are unknown.
        console: for progress.
        mesh: score the textured mesh instead of the splats.
        changes: "score.NAME=VALUE", settings of `ScoreSettings`.
        out: file for the results, Markdown if it ends in .md, else JSON.
        actionbench: compare the meshes by ActionBench's metrics, too.

    Raises:
        BadInput: the asset, the ground truth or a setting cannot be used, or `out` cannot be written.
        StepError: the step failed.
    """
    if not ground_truth.exists():
        raise BadInput(f"--truth: {ground_truth} does not exist; give a folder of an object, or a picture")
    found, (pipeline, settings) = find_ground_truth(ground_truth), _settings(changes, mesh)
    if pipeline:
        raise BadInput(f"only settings that begin with {SCORE!r} apply to a finished asset; given {min(pipeline)}")
    if actionbench and found.mesh is None:
        raise BadInput(f"{ground_truth} has no {MESH}; --actionbench compares with true meshes (vertices, faces)")
    settings = settings.model_copy(update={"actionbench": actionbench})
    record = load_verified(package)
    most = frame_limit(record)
    if out is not None:
        check_writable(out.parent)
    from flows.convert import connect

    connect()
    from flows.benchmark import BenchmarkEntry, score_assets
    from flows.engine.step_tasks import flow_context

    with running(home.store(), str(package)), terminal.steps_shown(console), flow_context():
        entry = BenchmarkEntry(
            name=found.name,
            ground_truth=put_ground_truth(found, home.store()),
            package=put_package(package, record, home.store()),
            seconds=compute_seconds(record, mesh),
            max_frames=most,
        )
        judged = score_assets(
            [entry], settings, f"{package.absolute().name} against {found.name}", package.absolute().name
        )
    for one in judged.results.failed:
        if EXIT_STATUS.get(one.kind) == EXIT_BAD_INPUT:
            raise BadInput(f"{package} cannot be scored against {ground_truth}: {one.error}")
        raise (StepMissing if EXIT_STATUS.get(one.kind) == EXIT_MISSING else StepError)("score_asset", one.error)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        as_text = scores.markdown if out.suffix.lower() == ".md" else _json
        write_atomically(out, as_text(judged.results))
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
    """Convert and score every object of a data set; finished objects are not converted again.

    Writes results.json, results.csv, table.md, index.html, films/ and the packages in assets/.

    Args:
        dataset: folder per object, in a layout of steps/artifacts/ground_truth.py.
        out: output folder, created if necessary.
        console: for progress.
        profile_name: of the conversion.
        changes: "NAME=VALUE" of the conversion, "score.NAME=VALUE" of scores.
        seed: of all random numbers.
        mesh: score the textured meshes instead of the splats.
        bank: use each object's ground-truth views as the prior.
        limit: number of objects, the first by name.
        workers: objects converted at a time.
        allow: raises BadInput for files that may not be read here.

    Raises:
        BadInput: the data set or a setting cannot be used, or `out` cannot be written.
        BackendUnavailable: something that the profile needs is missing.
    """
    ground_truths = find_ground_truths(dataset)[:limit]
    for ground_truth in ground_truths:
        if allow:
            allow(ground_truth.files)
        check_ground_truth(ground_truth)
    given, settings = _settings(changes, mesh)
    if bank:
        given = {"prior.kind": "oracle", **given}
        if without := [one.name for one in ground_truths if one.bank is None]:
            raise BadInput(f"--bank needs ground-truth views, which these objects lack: {', '.join(without)}")
    pipeline = revise(profile(profile_name), given)
    most = pipeline.subject.max_frames
    if bank and (longer := [one.name for one in ground_truths if len(one.inputs) > most]):
        raise BadInput(
            f"--bank: views belong to frames of the whole video, and of these videos only {most} frames would be used "
            f"(subject.max_frames): {', '.join(longer)}; set subject.max_frames to their number of frames"
        )
    settings = settings.model_copy(update={"rasterizer": pipeline.rasterizer})
    settings = ScoreAssetSettings.model_validate(settings.model_dump(mode="json"))
    check_writable(out)
    requests = [request_of(one, bank, given, profile_name, seed) for one in ground_truths]
    for request in requests:
        request.check()
        check_folder(out / ASSETS / request.item)
    from flows.convert import connect

    connect()
    from flows.benchmark import score_assets
    from flows.engine.step_tasks import flow_context

    with running(home.store(), str(out)):
        jobs = [request.to_job(home.store()) for request in requests]
        rows = _converted(jobs, out / ASSETS, workers, console, dataset.name)
        entries = [_entry(one, out / ASSETS / one.name, rows[one.name], mesh) for one in ground_truths]
        title = f"{dataset.absolute().name}, {profile_name}{', ground-truth views as prior' if bank else ''}"
        with terminal.batch_shown(console, [one.name for one in ground_truths]) as table, flow_context():
            judged = score_assets(entries, settings, title, profile_name, seed)
            for one in judged.results.objects:
                table.settle(one.object, "failed" if one.error else "done", one.error)
        results = judged.results.model_copy(update={"settings": {**judged.results.settings, "changes": given}})
        write(results, judged, out)
    return results


def write(results: Results, judged: "BenchmarkResult", out: Path) -> None:
    """Write the files of a benchmark into a folder, created if necessary; raises DiskFull."""
    out.mkdir(parents=True, exist_ok=True)
    videos = _unpack_videos(judged, out)
    texts = {
        "results.json": _json(results),
        "results.csv": scores.csv_text(results),
        "table.md": scores.markdown(results),
        "index.html": scores.scores_page(results, videos),
    }
    for name, text in texts.items():
        write_atomically(out / name, text)


def check_ground_truth(ground_truth: GroundTruth) -> None:
    """Refuse ground truth with invalid pictures or an invalid mesh archive.

    Raises:
        BadInput: names the file.
    """
    for path in ground_truth.pictures:
        check_still(path)
    if ground_truth.mesh is not None:
        check_arrays(ground_truth.mesh)


def put_ground_truth(ground_truth: GroundTruth, store: ArtifactStore) -> ArtifactRef:
    """Store ground truth in our own layout; equal pictures give equal bytes, whatever their layout was.

    Raises:
        BadInput: a file is not a picture, or the mesh is not a NumPy archive.
        DiskFull: the disk is full.
    """
    check_ground_truth(ground_truth)
    files = {f"input/{i:03d}{path.suffix.lower()}": path for i, path in enumerate(ground_truth.inputs)}
    for view in ground_truth.views:
        files |= {f"view_{view.name}/{i:03d}{path.suffix.lower()}": path for i, path in enumerate(view.frames)}
    if ground_truth.mesh is not None:
        files["mesh.npz"] = ground_truth.mesh
    return put_zip(files, GROUND_TRUTH.media_type, store)


def put_package(folder: Path, record: Mapping[str, Any], store: ArtifactStore) -> ArtifactRef:
    """Store the files of a package that rendering needs; `record` is its provenance."""
    names = [name for name in sorted(record["files"]) if name.startswith(NEEDED)]
    return put_zip({name: folder / name for name in names}, PACKAGE.media_type, store)


def _settings(changes: list[str] | None, mesh: bool) -> tuple[dict[str, Any], ScoreAssetSettings]:
    """Return the changed settings of the conversion, and the settings of scores."""
    given = parse_changes(changes or [])
    own = {key.removeprefix(SCORE): value for key, value in given.items() if key.startswith(SCORE)}
    try:
        tree = ScoreSettings.model_validate(own).model_dump(mode="json")
        settings = ScoreAssetSettings(rasterizer="auto", mesh=mesh, score=ScoreSettings(**without_paths(tree)))
    except ValidationError as error:
        lines = [f"{SCORE}{'.'.join(map(str, e['loc']))} = {e['input']!r}: {e['msg']}" for e in error.errors()]
        known = ", ".join(f"{SCORE}{name}" for name in ScoreSettings.model_fields)
        raise BadInput(f"settings refused: {'; '.join(lines)}; use: {known}") from error
    return {key: value for key, value in given.items() if not key.startswith(SCORE)}, settings


def request_of(
    ground_truth: GroundTruth, bank: bool, given: dict[str, Any], profile_name: str, seed: int
) -> ConversionRequest:
    """Return the request of `dg4d make`: follow the input video, or animate the input picture.

    The cameras of a video and of views are known, so their frames are used uncropped unless `given` says otherwise.
    """
    folder = ground_truth.inputs[0].parent
    is_placed = bool(ground_truth.views) or len(ground_truth.inputs) > 1
    changes = {"subject.framing": "keep", **given} if is_placed else given
    return ConversionRequest(
        item=ground_truth.name,
        picture=ground_truth.inputs[0],
        video=folder if len(ground_truth.inputs) > 1 else None,
        bank=ground_truth.bank if bank else None,
        profile=profile_name,
        settings=revise(profile(profile_name), changes),
        seed=seed,
    )


def _converted(jobs: list[ConversionJob], folder: Path, workers: int, console: "Console", name: str) -> dict[str, Row]:
    """Convert the unfinished objects; return the result of each."""
    from flows.catalog import run_jobs

    rows = {job.item: Row(item=job.item, status="unchanged") for job in jobs}
    waiting = [job for job in jobs if not is_up_to_date(folder / job.item, job.digest())]
    if not waiting:
        return rows
    with terminal.batch_shown(console, [job.item for job in waiting]) as table:
        progress = BatchProgress(len(waiting), lambda row: table.show(row, console))
        run_jobs(waiting, folder, workers, f"{name}: {len(waiting)} objects", progress)
    return rows | progress.rows


def _entry(ground_truth: GroundTruth, folder: Path, row: Row, mesh: bool) -> "BenchmarkEntry":
    from flows.benchmark import BenchmarkEntry

    ref = put_ground_truth(ground_truth, home.store())
    if row.status == "failed":
        return BenchmarkEntry(name=ground_truth.name, ground_truth=ref, error=row.message, kind=row.kind)
    try:
        record = load_verified(folder)
        package, most = put_package(folder, record, home.store()), frame_limit(record)
    except DG4DError as error:
        return BenchmarkEntry(name=ground_truth.name, ground_truth=ref, error=str(error), kind=type(error).__name__)
    return BenchmarkEntry(
        name=ground_truth.name,
        ground_truth=ref,
        package=package,
        seconds=compute_seconds(record, mesh),
        max_frames=most,
    )


def compute_seconds(record: Mapping[str, Any], mesh: bool) -> float:
    """Return the compute time of what is scored, including cached steps.

    For splats these are the steps up to the motion fit, as in the paper's times; for meshes also extraction and
    refinement.
    """
    without = UNSCORED if mesh else UNSCORED | MESH_STEPS
    steps = [step for step in record.get("run", {}).get("steps", []) if step["step"].partition(" ")[0] not in without]
    return round(sum(float(step.get("duration_s", 0.0)) for step in steps), 1)


def frame_limit(record: Mapping[str, Any]) -> int:
    """Return the number of frames that the video of a package was sampled to, at most; 0 if it follows no video.

    Raises:
        BadInput: the record does not have this number.
    """
    try:
        if not any("footage" in step["outputs"] for step in record.get("steps", [])):
            return 0
        subject = SubjectSettings(max_frames=record["recipe"]["settings"]["subject"]["max_frames"])
    except (KeyError, TypeError, ValidationError) as error:
        raise BadInput(
            f"the {RECORD} of the asset does not say to how many frames its video was sampled "
            "(recipe.settings.subject.max_frames); make the asset again"
        ) from error
    return subject.max_frames


def _json(results: Results) -> str:
    return json.dumps(results.model_dump(mode="json"), indent=1, ensure_ascii=False) + "\n"


def _unpack_videos(judged: "BenchmarkResult", out: Path) -> dict[str, dict[str, dict[str, str]]]:
    """Unpack every video below OUT; return their paths by object, source and view."""
    shown: dict[str, dict[str, dict[str, str]]] = {}
    for name, refs in judged.videos.items():
        for whose, ref in refs.items():
            folder = out / VIDEOS / name / whose
            folder.mkdir(parents=True, exist_ok=True)
            with room_for(folder):
                videos = unpack(home.store().path(ref), folder, "the zip of videos")
            views = {Path(video).stem: f"{VIDEOS}/{name}/{whose}/{video}" for video in videos}
            shown.setdefault(name, {})[whose] = views
    return shown
