"""Flow that scores finished assets against their ground truth and shows the means as a table in the Prefect UI."""

from typing import Literal

from prefect import flow
from prefect.artifacts import create_table_artifact

from dg4d_lib.errors import BadInput
from flows import home
from flows.engine.requests import Conversion
from flows.formatting.escaping import markdown
from flows.packages import scores
from flows.packages.scores import ObjectScores, Results
from flows.step_errors import StepError
from flows.tasks import score_asset
from steps.contract import ArtifactRef, Frozen
from steps.profiles import PREVIEW, ScoreAssetSettings

FVD = "fvd"


class BenchmarkEntry(Frozen):
    """Object of a benchmark: its ground truth and its asset.

    Attributes:
        name: name of the object.
        ground_truth: its ground truth.
        package: its asset; None where the conversion failed.
        error: message of that failure.
        kind: name of its exception.
        seconds: compute time of the conversion, as far as the scores need it.
        max_frames: number of frames that its video was sampled to, at most; 0 if it follows no video.
    """

    name: str
    ground_truth: ArtifactRef
    package: ArtifactRef | None = None
    error: str = ""
    kind: str = ""
    seconds: float = 0.0
    max_frames: int = 0


class BenchmarkResult(Frozen):
    """Scores of all objects, and the videos of each: of the ground truth and of the asset."""

    results: Results
    videos: dict[str, dict[Literal["truth", "ours"], ArtifactRef]]


@flow(name="score-assets", flow_run_name="{title}", persist_result=False)
def score_assets(
    entries: list[BenchmarkEntry], settings: ScoreAssetSettings, title: str, ours: str, seed: int = 0
) -> BenchmarkResult:
    """Score every asset, and naive baselines beside it; an object that fails does not stop the others."""
    objects: list[ObjectScores] = []
    videos: dict[str, dict[Literal["truth", "ours"], ArtifactRef]] = {}
    missing: dict[str, str] = {}
    clips: dict[str, list[list[float]]] = {"truth": [], "ours": []}
    store = home.store()
    for entry in entries:
        one = ObjectScores(object=entry.name, error=entry.error, kind=entry.kind, seconds=entry.seconds)
        if entry.package is not None:
            # score_asset reads the settings given here; those of the conversion do not count
            conversion = Conversion(item=entry.name, settings=PREVIEW, seed=seed)
            try:
                baselines = score_asset(
                    entry.ground_truth, settings.model_copy(update={"mesh": False}), conversion
                ).outputs
                sampled = settings.model_copy(update={"max_frames": entry.max_frames})
                asset = score_asset(entry.ground_truth, sampled, conversion, entry.package).outputs
            except StepError as error:
                one = one.model_copy(update={"error": error.message, "kind": type(error).__name__})
            else:
                theirs, mine = store.load_json(baselines["scores"]), store.load_json(asset["scores"])
                videos[entry.name] = {"truth": baselines["films"], "ours": asset["films"]}
                missing |= mine["missing"]
                clips["truth"] += theirs["clips"].values()
                clips["ours"] += mine["clips"].values()
                rows = {**theirs["rows"], ours: mine["rows"]["asset"]}
                facts = {name: mine[name] for name in ("frames", "size", "notes")}
                one = one.model_copy(update={"rows": rows, **facts})
        objects.append(one)
    mean = scores.averaged(objects, ours)
    figures, without_fvd = _fvd(clips, missing.get("fvd_consistent4d", ""))
    mean.get(ours, {}).update(figures)
    results = Results(
        title=title,
        ours=ours,
        drawn="mesh" if settings.mesh else "splats",
        settings=settings.model_dump(mode="json"),
        objects=objects,
        mean=mean,
        missing=missing | without_fvd,
    )
    create_table_artifact(table=scores.table(results), key="benchmark", description=markdown(title))
    return BenchmarkResult(results=results, videos=videos)


def _fvd(clips: dict[str, list[list[float]]], missing: str) -> tuple[scores.Figures, dict[str, str]]:
    """Return the FVD between all videos of the assets and all of the ground truth, or the reason why it is missing.

    Args:
        clips: I3D features of the videos.
        missing: reason why no video has features.
    """
    if not clips["ours"]:
        return {}, {FVD: missing} if missing else {}
    from dg4d_lib.metrics.fvd import fvd  # noqa: PLC0415 - brings torch

    try:
        return {FVD: fvd(clips["ours"], clips["truth"])}, {}
    except BadInput as error:
        return {}, {FVD: str(error)}
