"""Scores of many objects as people read them: tables in the paper's form, CSV, a page with the films side by side."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any, Literal
from urllib.parse import quote

from pydantic import BaseModel

from flows.exit_status import EXIT_BAD_INPUT, EXIT_FAILED
from flows.formatting.escaping import cell
from flows.formatting.escaping import markdown as escaped
from flows.packages.html_pages import render
from flows.packages.summary import BAD_INPUT

Figures = dict[str, float]


@dataclass(frozen=True)
class Metric:
    """How a number is shown.

    Attributes:
        heading: with an arrow to where it is better.
        digits: after the point.
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
    "input_psnr": Metric("input PSNR ↑", 2),
    "input_iou": Metric("input IoU ↑", 3),
    "clip_i": Metric("CLIP-I ↑", 3),
}
GUESSES = {
    "input_repeated": "the input at every view",
    "input_frozen": "its first frame at every view",
    "truth_frozen": "every view's true first frame",
}
PUBLISHED = (
    ("D-NeRF", "0.51", "0.68", "2327.83", "-"),
    ("K-planes", "0.38", "0.72", "2295.68", "-"),
    ("Zero123", "0.15", "0.90", "1571.60", "-"),
    ("Consistent4D", "0.16", "0.87", "1133.44", "2 h"),
    ("DreamGaussian4D, fast", "0.13", "0.91", "775.90", "5 min"),
    ("DreamGaussian4D", "0.12", "0.92", "729.74", "15 min"),
)  # method, LPIPS, CLIP, FVD, time (Ren et al. 2024, table "Quantitative Results for Video-to-4D")
NONE = "-"


class ObjectScores(BaseModel):
    """One object.

    Attributes:
        object: its name.
        error: why there are no scores; empty where there are.
        kind: of that failure, the name of its exception.
        seconds: that the steps of the asset took to compute.
        frames: of every view.
        size: of a frame, pixels.
        rows: for every method, figures of the input view, of every view, their mean, and of the mesh.
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
    """What a benchmark found.

    Attributes:
        title: what was judged.
        ours: the method of the assets, a name of `rows` like the naive guesses' names.
        drawn: which form of the assets was judged.
        objects: in the order of the data set.
        mean: of every method over the objects that have the figure.
        missing: for every metric that was not computed, why, and what mends it.
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
        """0 if every object has scores, 65 if none has and bad input is to blame for all, else 1."""
        if not self.failed:
            return 0
        bad = all(one.error and one.kind in BAD_INPUT for one in self.objects)
        return EXIT_BAD_INPUT if bad else EXIT_FAILED


def figures_of(judgment: Mapping[str, Any]) -> Figures:
    """The figures of a method on one object: means of the views, of the mesh, and how well the input view is met."""
    found: Figures = {**judgment.get("mean", {}), **judgment.get("geometry", {})}
    of_input = judgment.get("input", {})
    found |= {f"input_{name}": of_input[name] for name in ("psnr", "iou") if name in of_input}
    return found | ({"clip_i": of_input["clip_i"]} if "clip_i" in of_input else {})


def averaged(objects: list[ObjectScores], ours: str) -> dict[str, Figures]:
    """The mean of every method over the objects, naive guesses first."""
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
    """A row per method with its means; for the Prefect UI."""
    shown = PAPER_METRICS | _present(results, METRICS)
    return [
        {"method": called(method), **{metric.heading: _cell(figures, name, results) for name, metric in shown.items()}}
        for method, figures in results.mean.items()
    ]


def csv_text(results: Results) -> str:
    """A row per object, method and view; `mean` is over the views, `input` the input view."""
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
                    writer.writerow([cell(one.object), cell(method), view, *(figures.get(name, "") for name in names)])
    return text.getvalue()


def markdown(results: Results) -> str:
    """The tables: the paper's columns, the others, every object, what is missing, what was published."""
    scored = len(results.objects) - len(results.failed)
    several = "One object" if scored == 1 else f"Means over {scored} objects"
    more = _present(results, METRICS)
    means = [(called(method), figures) for method, figures in results.mean.items()]
    every = [
        (f"{escaped(one.object)}: {called(method)}", figures_of(judgment) | _time(one, method == results.ours))
        for one in results.objects
        for method, judgment in one.rows.items()
    ]
    failures = [f"- {escaped(one.object)} failed: {escaped(one.error)}" for one in results.failed]
    notes = [f"- {escaped(one.object)}: {escaped(note)}" for one in results.objects for note in one.notes]
    missing = [f"- {metric}: {why}" for metric, why in results.missing.items()]
    parts = [
        [f"# {escaped(results.title)}"],
        [f"{several}, {results.drawn}; all frames and views weigh the same."],
        _lines(PAPER_METRICS, means, results),
        _lines(more, means, results),
        *([["## Missing"], missing] if missing else []),
        *([failures] if failures else []),
        *([notes] if notes else []),
        ["## Every object"],
        _lines({**_present(results, PAPER_METRICS), **more}, every, results),
        ["## Published"],
        ["On Consistent4D's seven videos (Ren et al. 2024): other data, other figures."],
        _table_lines(["method", "LPIPS ↓", "CLIP ↑", "FVD ↓", "time ↓"], [list(row) for row in PUBLISHED]),
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def page(results: Results, films: Mapping[str, Mapping[str, Mapping[str, str]]]) -> str:
    """The tables and, for every object, the films of the truth above those of the asset.

    Args:
        results: what to show.
        films: by object, by whose they are ("truth", "ours") and by view: where the film lies, relative to the page.
    """
    return render(
        "scores.html",
        title=results.title,
        metrics=(PAPER_METRICS | _present(results, METRICS)).values(),
        table=table(results),
        ours=list(results.mean).index(results.ours) if results.ours in results.mean else None,
        missing=results.missing,
        objects=[_section(one, results.ours, films.get(one.object, {})) for one in results.objects],
        quote=quote,
    )


def called(method: str) -> str:
    """What people call a method."""
    return GUESSES.get(method, method)


def _section(one: ObjectScores, ours: str, films: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """Return what the page shows of an object."""
    figures = figures_of(one.rows.get(ours, {}))
    return {
        "name": one.object,
        "error": one.error,
        "facts": [
            f"{metric.heading} {figures[key]:.{metric.digits}f}" for key, metric in METRICS.items() if key in figures
        ],
        "views": list(next(iter(films.values()), {})),
        "films": films,
    }


def _present(results: Results, metrics: Mapping[str, Metric]) -> dict[str, Metric]:
    """Those that some method has."""
    return {name: metric for name, metric in metrics.items() if any(name in one for one in results.mean.values())}


def _cell(figures: Mapping[str, float], name: str, results: Results) -> str:
    if name in figures:
        return f"{figures[name]:.{(PAPER_METRICS | METRICS)[name].digits}f}"
    return "missing" if name in results.missing else NONE


def _time(one: ObjectScores, ours: bool) -> Figures:
    return {"seconds": one.seconds} if ours and one.seconds else {}


def _lines(metrics: Mapping[str, Metric], rows: Sequence[tuple[str, Figures]], results: Results) -> list[str]:
    """Methods and their figures as a table of Markdown."""
    heads = ["method", *(metric.heading for metric in metrics.values())]
    return _table_lines(heads, [[name, *(_cell(figures, key, results) for key in metrics)] for name, figures in rows])


def _table_lines(heads: list[str], rows: list[list[str]]) -> list[str]:
    return [f"| {' | '.join(cells)} |" for cells in (heads, ["---"] * len(heads), *rows)]
