"""Finished assets against the truth, one after the other; their means as a table in the Prefect UI."""

import json
from typing import Any, Literal

from prefect import flow
from prefect.artifacts import create_table_artifact

from dg4d_lib.errors import BadInput
from flows import home
from flows.engine.step_tasks import Conversion, flow_context
from flows.formatting.escaping import markdown
from flows.packages import scores
from flows.packages.scores import ObjectScores, Results
from flows.step_errors import StepError
from flows.tasks import score_asset
from steps.contract import ArtifactRef, Frozen
from steps.profiles import PREVIEW, ScoreAssetSettings

FVD = "fvd"


class Entry(Frozen):
    """An object to judge.

    Attributes:
        name: of the object.
        truth: what it should look like.
        package: the asset; None where making it failed.
        error: why there is no asset.
        kind: of that failure, the name of its exception.
        seconds: that it took.
    """

    name: str
    truth: ArtifactRef
    package: ArtifactRef | None = None
    error: str = ""
    kind: str = ""
    seconds: float = 0.0


class Judged(Frozen):
    """What the flow gives: the results, and the films of every object: the truth's and the asset's."""

    results: Results
    films: dict[str, dict[Literal["truth", "ours"], ArtifactRef]]


@flow(name="score-assets", flow_run_name="{title}", persist_result=False)
def benchmark(entries: list[Entry], settings: ScoreAssetSettings, title: str, ours: str, seed: int = 0) -> Judged:
    """Judge every asset, and the naive guesses beside it; an object that fails stops no other."""
    objects: list[ObjectScores] = []
    films: dict[str, dict[Literal["truth", "ours"], ArtifactRef]] = {}
    missing: dict[str, str] = {}
    crowds: dict[str, list[list[float]]] = {"truth": [], "ours": []}
    for entry in entries:
        one = ObjectScores(object=entry.name, error=entry.error, kind=entry.kind, seconds=entry.seconds)
        if entry.package is not None:
            try:
                guessed, judged = _judge(entry, settings, seed)
            except StepError as error:
                one = one.model_copy(update={"error": error.message, "kind": type(error).__name__})
            else:
                theirs, mine = (_read(made["scores"]) for made in (guessed, judged))
                films[entry.name] = {"truth": guessed["films"], "ours": judged["films"]}
                missing |= mine["missing"]
                crowds["truth"] += theirs["clips"].values()
                crowds["ours"] += mine["clips"].values()
                rows = {**theirs["rows"], ours: mine["rows"]["asset"]}
                facts = {name: mine[name] for name in ("frames", "size", "notes")}
                one = one.model_copy(update={"rows": rows, **facts})
        objects.append(one)
    mean = scores.averaged(objects, ours)
    figures, troubles = _fvd(crowds, missing.get("fvd_consistent4d", ""))
    mean.get(ours, {}).update(figures)
    results = Results(
        title=title,
        ours=ours,
        drawn="mesh" if settings.mesh else "splats",
        settings=settings.model_dump(mode="json"),
        objects=objects,
        mean=mean,
        missing=missing | troubles,
    )
    create_table_artifact(table=scores.table(results), key="benchmark", description=markdown(title))
    return Judged(results=results, films=films)


def judge(entries: list[Entry], settings: ScoreAssetSettings, title: str, ours: str, seed: int = 0) -> Judged:
    """Run the flow."""
    with flow_context():
        return benchmark(entries, settings, title, ours, seed)


def _judge(
    entry: Entry, settings: ScoreAssetSettings, seed: int
) -> tuple[dict[str, ArtifactRef], dict[str, ArtifactRef]]:
    """What the naive guesses score, and what the asset does."""
    conversion = Conversion(item=entry.name, settings=PREVIEW, seed=seed)  # score_asset has settings of its own
    guessed = score_asset(entry.truth, settings.model_copy(update={"mesh": False}), conversion)
    return guessed.outputs, score_asset(entry.truth, settings, conversion, entry.package).outputs


def _read(ref: ArtifactRef) -> dict[str, Any]:
    report: dict[str, Any] = json.loads(home.store().path(ref).read_text(encoding="utf-8"))
    return report


def _fvd(crowds: dict[str, list[list[float]]], without: str) -> tuple[scores.Figures, dict[str, str]]:
    """The distance of all films from all true ones, or why there is none; `without` says why no film has outputs."""
    if not crowds["ours"]:
        return {}, {FVD: without} if without else {}
    from dg4d_lib.metrics.fvd import fvd  # noqa: PLC0415 - brings torch

    try:
        return {FVD: fvd(crowds["ours"], crowds["truth"])}, {}
    except BadInput as error:
        return {}, {FVD: str(error)}
