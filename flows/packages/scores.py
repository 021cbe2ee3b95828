"""Scores of a benchmark as tables in the paper's form, as CSV, and as a page with videos side by side."""

import csv
import io
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Any, Literal, NamedTuple
from urllib.parse import quote

from pydantic import BaseModel

from flows.exit_status import exit_status_of
from flows.formatting.escaping import csv_cell
from flows.formatting.escaping import markdown as escaped
from flows.packages.html_pages import render

Figures = dict[str, float]


class Metric(NamedTuple):
    """Column of a table of scores.

    Attributes:
        heading: with an arrow towards better values.
        digits: after the decimal point.
    """

    heading: str
    digits: int


PAPER_METRICS = {
    "lpips": Metric("LPIPS ↓", 3),
    "clip": Metric("CLIP ↑", 3),
    "fvd_consistent4d": Metric("FVD (Consistent4D) ↓", 2),
    "seconds": Metric("time, s ↓", 0),
}
METRICS = {
    "psnr": Metric("PSNR, dB ↑", 2),
    "psnr_obj": Metric("on the object ↑", 2),
    "ssim": Metric("SSIM ↑", 3),
    "iou": Metric("IoU ↑", 3),
    "terr": Metric("temporal error ↓", 3),
    "flicker": Metric("flicker ↓", 2),
    "motion": Metric("motion → 1", 2),
    "fvd": Metric("FVD ↓", 2),
    "chamfer": Metric("chamfer ↓", 4),
    "chamfer_aligned": Metric("aligned ↓", 4),
    "cd_3d": Metric("CD-3D ↓", 4),
    "cd_4d": Metric("CD-4D ↓", 4),
    "cd_m": Metric("CD-M ↓", 4),
    "input_psnr": Metric("input PSNR ↑", 2),
    "input_iou": Metric("input IoU ↑", 3),
    "clip_i": Metric("CLIP-I ↑", 3),
}
GUESSES = {
    "input_repeated": "input at every view",
    "input_frozen": "first input frame at every view",
    "truth_frozen": "first ground-truth frame of every view",
}
PUBLISHED = (
    ("D-NeRF", "0.51", "0.68", "2327.83", "-"),
    ("K-planes", "0.38", "0.72", "2295.68", "-"),
    ("Zero123", "0.15", "0.90", "1571.60", "-"),
    ("Consistent4D", "0.16", "0.87", "1133.44", "2 h"),
    ("DreamGaussian4D, fast", "0.13", "0.91", "775.90", "5 min"),
    ("DreamGaussian4D", "0.12", "0.92", "729.74", "15 min"),
)  # Ren et al. 2024, table "Quantitative Results for Video-to-4D"
PUBLISHED_HEADINGS = ("method", "LPIPS ↓", "CLIP ↑", "FVD ↓", "time ↓")
NONE = "-"


class ObjectScores(BaseModel):
    """Scores of one object.

    Attributes:
        object: name.
        error: reason why there are no scores; empty if there are.
        kind: name of the exception of that failure.
        seconds: compute time of what is scored: up to the motion fit for splats, to the texture for meshes.
        frames: number per view.
        size: of a frame, pixels.
        rows: for every method, values of the input view, of every view, their mean, and of the mesh.
    """

    object: str
    error: str = ""
    kind: str = ""
    seconds: float = 0.0
    frames: int = 0
    size: int = 0
    rows: dict[str, dict[str, Any]] = {}
    notes: list[str] = []


class Results(BaseModel):
    """Results of a benchmark.

    Attributes:
        title: name of the data set and profile.
        ours: method of the assets, a key of `rows` like those of the baselines.
        drawn: evaluated form of the assets.
        objects: in the order of the data set.
        mean: of every method over the objects that have the value.
        missing: for every metric that was not computed, the reason and the remedy.
    """

    format: Literal[1] = 1
    title: str
    ours: str
    drawn: Literal["splats", "mesh"]
    settings: dict[str, Any] = {}
    objects: list[ObjectScores]
    mean: dict[str, Figures] = {}
    missing: dict[str, str] = {}

    @property
    def failed(self) -> list[ObjectScores]:
        """Objects without scores."""
        return [one for one in self.objects if one.error]

    @property
    def exit_code(self) -> int:
        """Exit status: 0 if every object has scores, else that of `exit_status_of`."""
        if not self.failed:
            return 0
        return exit_status_of(one.kind for one in self.objects)


def figures_of(judgment: Mapping[str, Any]) -> Figures:
    """Return the values of a method on one object: means of the views, of the mesh, and of the input view."""
    names = {"psnr": "input_psnr", "iou": "input_iou", "clip_i": "clip_i"}
    of_input = {names[name]: value for name, value in judgment.get("input", {}).items() if name in names}
    return {**judgment.get("mean", {}), **judgment.get("geometry", {}), **of_input}


def averaged(objects: list[ObjectScores], ours: str) -> dict[str, Figures]:
    """Return the mean of every method over the objects, baselines first."""
    found: dict[str, Figures] = {}
    for method in (*GUESSES, ours):
        every = [figures_of(one.rows[method]) for one in objects if method in one.rows]
        names = dict.fromkeys(name for figures in every for name in figures)
        if every:
            found[method] = {name: fmean(figures[name] for figures in every if name in figures) for name in names}
    times = [one.seconds for one in objects if one.seconds and not one.error]
    if ours in found and times:
        found[ours]["seconds"] = fmean(times)
    return found


def table(results: Results) -> list[dict[str, str]]:
    """Return a row per method with its means, for the page and the Prefect UI."""
    return _rows(PAPER_METRICS | _present(results, METRICS), _means(results), results)


def csv_text(results: Results) -> str:
    """Return a row per object, method and view; `mean` is over the views, `input` the input view."""
    names = [name for name in {**PAPER_METRICS, **METRICS} if not name.startswith("input_")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["object", "method", "view", *names])
    for one in results.objects:
        for method, judgment in one.rows.items():
            views = {"input": judgment.get("input", {}), **judgment["views"]}
            whole = {**judgment["mean"], **judgment.get("geometry", {})}
            whole |= _time(one, method == results.ours)
            for view, figures in {**views, "mean": whole}.items():
                if figures:
                    writer.writerow(
                        [csv_cell(one.object), csv_cell(method), view, *(figures.get(name, "") for name in names)]
                    )
    return text.getvalue()


def markdown(results: Results) -> str:
    """Return tables of the paper's metrics, the others, every object, and published values."""
    scored = len(results.objects) - len(results.failed)
    several = "One object" if scored == 1 else f"Means over {scored} objects"
    more, means = _present(results, METRICS), _means(results)
    every = [
        (f"{escaped(one.object)}: {display_name(method)}", figures_of(judgment) | _time(one, method == results.ours))
        for one in results.objects
        for method, judgment in one.rows.items()
    ]
    failures = [f"- {escaped(one.object)} failed: {escaped(one.error)}" for one in results.failed]
    notes = [f"- {escaped(one.object)}: {escaped(note)}" for one in results.objects for note in one.notes]
    missing = [f"- {metric}: {why}" for metric, why in results.missing.items()]
    parts = [
        [f"# {escaped(results.title)}"],
        [f"{several}, {results.drawn}; all frames and views have equal weight."],
        _markdown_table(_rows(PAPER_METRICS, means, results)),
        _markdown_table(_rows(more, means, results)),
        *([["## Missing"], missing] if missing else []),
        *([failures] if failures else []),
        *([notes] if notes else []),
        ["## Every object"],
        _markdown_table(_rows({**_present(results, PAPER_METRICS), **more}, every, results)),
        ["## Published"],
        ["On the seven videos of Consistent4D (Ren et al. 2024), so not comparable: other data."],
        _markdown_table([dict(zip(PUBLISHED_HEADINGS, row, strict=True)) for row in PUBLISHED]),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def titled_tables(results: Results) -> list[tuple[str, list[dict[str, str]]]]:
    """Return the tables for a terminal with their titles: means, then every object if there are several."""
    scored = len(results.objects) - len(results.failed)
    several = "one object" if scored == 1 else f"means over {scored} objects"
    paper, more = _present(results, PAPER_METRICS), _present(results, METRICS)
    named = [(f"{results.title}: {several}, {results.drawn}", _rows(more, _means(results), results))]
    if paper:
        named.append(("Metrics of the paper", _rows(paper, _means(results), results)))
    if scored > 1:
        every = [
            (f"{one.object}: {display_name(method)}", figures_of(judgment) | _time(one, method == results.ours))
            for one in results.objects
            for method, judgment in one.rows.items()
        ]
        named.append(("Every object", _rows({**paper, **more}, every, results)))
    return named


def remarks(results: Results) -> list[str]:
    """Return missing metrics with their remedies, and notes on objects, a line each."""
    missing = [f"{metric} is missing: {why}" for metric, why in results.missing.items()]
    return [*missing, *(f"{one.object}: {note}" for one in results.objects for note in one.notes)]


def scores_page(results: Results, videos: Mapping[str, Mapping[str, Mapping[str, str]]]) -> str:
    """Render the tables and, for every object, the ground-truth videos above those of the asset.

    Args:
        results: of the benchmark.
        videos: paths of the videos relative to the page, by object, by source ("truth", "ours") and by view.
    """
    return render(
        "scores.html",
        title=results.title,
        metrics=(PAPER_METRICS | _present(results, METRICS)).values(),
        table=table(results),
        ours=list(results.mean).index(results.ours) if results.ours in results.mean else None,
        missing=results.missing,
        objects=[_section(one, results.ours, videos.get(one.object, {})) for one in results.objects],
        quote=quote,
    )


def display_name(method: str) -> str:
    """Return the displayed name of a method."""
    return GUESSES.get(method, method)


def _section(one: ObjectScores, ours: str, videos: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """Return the values of an object for the page."""
    figures = figures_of(one.rows.get(ours, {}))
    return {
        "name": one.object,
        "error": one.error,
        "facts": [
            f"{metric.heading} {figures[key]:.{metric.digits}f}" for key, metric in METRICS.items() if key in figures
        ],
        "views": list(next(iter(videos.values()), {})),
        "videos": videos,
    }


def _present(results: Results, metrics: Mapping[str, Metric]) -> dict[str, Metric]:
    """Return the metrics that some method has."""
    return {name: metric for name, metric in metrics.items() if any(name in one for one in results.mean.values())}


def _cell(figures: Mapping[str, float], name: str, results: Results) -> str:
    if name in figures:
        return f"{figures[name]:.{(PAPER_METRICS | METRICS)[name].digits}f}"
    return "missing" if name in results.missing else NONE


def _time(one: ObjectScores, ours: bool) -> Figures:
    return {"seconds": one.seconds} if ours and one.seconds else {}


def _means(results: Results) -> list[tuple[str, Figures]]:
    return [(display_name(method), figures) for method, figures in results.mean.items()]


def _rows(
    metrics: Mapping[str, Metric], methods: Sequence[tuple[str, Figures]], results: Results
) -> list[dict[str, str]]:
    """Return a row per method, by heading."""
    return [
        {"method": name, **{metric.heading: _cell(figures, key, results) for key, metric in metrics.items()}}
        for name, figures in methods
    ]


def _markdown_table(rows: list[dict[str, str]]) -> list[str]:
    heads = list(rows[0]) if rows else ["method"]
    return [f"| {' | '.join(cells)} |" for cells in (heads, ["---"] * len(heads), *(row.values() for row in rows))]
