import io
import json
import re
import tomllib
import zipfile
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from jinja2 import UndefinedError

from flows.formatting.curves import HEIGHT, WIDTH
from flows.inputs.conversion_job import ConversionJob
from flows.packages import report
from flows.packages.flow_result import FlowResult, StepRun
from flows.packages.html_pages import render
from flows.packages.summary import Row, Writer
from steps.contract import ArtifactRef, ProvenanceRecord, StepResult
from steps.profiles import PREVIEW, revise
from steps.store.artifact_store import ArtifactStore

FILES = {
    name: {"digest": "sha256:" + "a" * 64, "size_bytes": size}
    for name, size in {
        "asset.glb": 5_400_000,
        "contact_sheet.png": 99_000,
        "preview.mp4": 1,
        "splats/000.ply": 7,
    }.items()
}
CURVES = {"title": "static <fit>", "x": [0, 10, 20], "series": {"loss": [100.0, 1.0, 0.01]}, "notes": []}


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def finished(step: str, store: ArtifactStore, seconds: float, **outputs: ArtifactRef) -> StepRun:
    record = ProvenanceRecord(
        step=step,
        code_version="1",
        request_digest="sha256:" + "b" * 64,
        inputs={},
        outputs={name: ref.digest for name, ref in outputs.items()},
        settings={},
        seed=0,
        backend="cpu",
        notes=("Twice said.", "<b>bold</b>"),
        run_notes=("memory ran out",) if seconds > 5 else (),
        flops={"Unet": 7} if seconds > 5 else {},
        duration_s=seconds,
        peak_memory_mb=seconds * 10,
    )
    result = StepResult(outputs=outputs, provenance=record)
    return StepRun(label=step, cached=seconds > 5, wall_s=seconds, result=result)


@pytest.fixture
def unpacked(tmp_path: Path) -> Path:
    """The files of the package."""
    (tmp_path / "asset.glb").write_bytes(b"a mesh")
    return tmp_path


def made(store: ArtifactStore, seconds: float = 2.0) -> tuple[ConversionJob, FlowResult]:
    source = store.put_bytes(b"s", "application/octet-stream")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr(zipfile.ZipInfo("asset.glb"), b"a mesh")
    package = store.put_bytes(packed.getvalue(), "application/zip")
    curves = store.put_bytes(json.dumps(CURVES).encode(), "application/vnd.dg4d.curves+json")
    job = ConversionJob(
        item="<fox>", source=source, moving=False, profile="preview", settings=PREVIEW, seed=0, source_name="fox.png"
    )
    steps = [finished("fit_gaussians", store, seconds, curves=curves), finished("pack_asset", store, seconds + 1)]
    return job, FlowResult(package=package, steps=steps, flow_run=f"run {seconds}")


class Links(HTMLParser):
    """Every tag and every address of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in {"src", "href"} and value]


def test_the_page_is_self_contained_and_escapes_what_it_is_given(store: ArtifactStore, unpacked: Path) -> None:
    job, what = made(store)
    page = report.render_records(job, what, FILES, store, unpacked)["report.html"]
    links = Links(page)
    assert "script" not in links.tags
    assert "fox" not in links.tags
    assert "b" in links.tags
    assert "<b>bold</b>" not in page
    assert not [address for address in links.addresses if re.match(r"\w+:|//", address)]
    assert {"preview.mp4", "contact_sheet.png", "asset.glb", "splats/", "provenance.json"} <= set(links.addresses)
    assert links.tags.count("polyline") == 1
    assert "5.4 MB" in page


def test_the_verdict_and_the_viewer_come_before_the_notes(store: ArtifactStore, unpacked: Path) -> None:
    told = report.build_report(*made(store), FILES, store)
    told["acceptance"] = {"accepted": False, "failing": ["motion"], "gates": []}
    page = report.report_page(told)
    assert Links(page).tags.count("main") == 1
    places = [page.index(part) for part in ("Not accepted: motion", "<iframe", "contact_sheet.png", "Twice said.")]
    assert places == sorted(places)
    assert 'title="3D viewer of &lt;fox&gt;"' in page


def test_plots_have_names_with_their_last_values(told: dict[str, Any]) -> None:
    page = report.report_page(told)
    assert re.search(r'<svg [^>]*role="img" aria-label="static &lt;fit&gt;: 100 to 0.01[^"]*; loss 0.01"', page)


def test_time_on_the_clock_and_time_of_computing_are_two_numbers(store: ArtifactStore) -> None:
    job, what = made(store)  # two steps, of 2 and 3 seconds
    told = report.build_report(job, what.model_copy(update={"wall_s": 3.2}), FILES, store)
    assert (told["wall_s"], told["compute_s"]) == (3.2, 5.0)
    page = report.report_page(told)
    assert "3.2 s wall-clock time of this run; 5.0 s of compute time in all steps" in page


def test_the_banner_is_honest(store: ArtifactStore) -> None:
    job, what = made(store)
    assert "the motion was generated;" in report.banner(job, what)
    moving = what.model_copy(update={"steps": [finished("prepare_subject", store, 1, footage=job.source)]})
    assert "the motion follows the video" in report.banner(job, moving)
    oracle = job.model_copy(update={"settings": revise(PREVIEW, {"prior.kind": "oracle"})})
    assert "ground-truth views were given" in report.banner(oracle, what)


@pytest.mark.parametrize(
    ("kind", "given", "says"),
    [
        ("geometric", "", "shape and unseen sides were predicted without a model, from the silhouette of one picture."),
        ("learned", "", "shape and unseen sides were predicted by the shape network from one view."),
        ("learned", "asset", "; the shape is that of the given model."),
        ("learned", "views", "to the given views; what none of them shows was predicted by the shape network."),
        ("geometric", "views", "to the given views; what none of them shows was predicted without a model."),
    ],
)
def test_the_banner_says_which_shape_was_given(store: ArtifactStore, kind: str, given: str, says: str) -> None:
    job, what = made(store)
    files = {given: job.source} if given else {}
    job = job.model_copy(update={"settings": revise(PREVIEW, {"prior.kind": kind}), **files})
    assert report.banner(job, what).endswith(says)


def with_weights(step: StepRun, licenses: dict[str, str]) -> StepRun:
    record = step.result.provenance.model_copy(
        update={"weights": {f"{name}/unet": "sha256:" + "c" * 64 for name in licenses}, "licenses": licenses}
    )
    return step.model_copy(update={"result": step.result.model_copy(update={"provenance": record})})


def test_the_banner_says_what_models_did(store: ArtifactStore) -> None:
    job, what = made(store)
    plain = job.model_copy(update={"settings": revise(PREVIEW, {"prior.kind": "geometric"})})
    fit, drive = finished("fit_gaussians", store, 1), finished("drive_video", store, 1)
    by_prior = what.model_copy(update={"steps": [with_weights(fit, {"zero123-xl": "x"}), drive]})
    assert "the motion was generated; shape and unseen sides were predicted by a model." in report.banner(
        plain, by_prior
    )
    by_video = what.model_copy(update={"steps": [fit, with_weights(drive, {"svd": "x"})]})
    assert "the motion was generated by a model; " in report.banner(plain, by_video)
    assert "predicted without a model" in report.banner(plain, by_video)
    sides = with_weights(finished("generate_views", store, 1), {"qwen-image-edit-2511": "x"})
    by_views = what.model_copy(update={"steps": [sides, fit, drive]})
    assert report.banner(job, by_views).endswith("shape and unseen sides were predicted by a model.")
    assert by_views.used_weights(*report.GENERATIVE)


def test_what_networks_did_is_said_for_every_step(store: ArtifactStore, unpacked: Path) -> None:
    job, what = made(store)
    fit, pack = what.steps
    record = fit.result.provenance.model_copy(update={"flops": {"Unet": 15_250_000_000_000, "Vae": 3_000_000}})
    fit = fit.model_copy(update={"result": fit.result.model_copy(update={"provenance": record})})
    texts = report.render_records(job, what.model_copy(update={"steps": [fit, pack]}), FILES, store, unpacked)
    stages = json.loads(texts["report.json"])["steps"]
    assert [stage["flops"] for stage in stages] == [record.flops, {}]
    assert texts["report.html"].count("FLOP") == 2
    assert "Unet 15.2 TFLOP, Vae 3.0 MFLOP" in texts["report.html"]
    assert json.loads(texts["provenance.json"])["run"]["steps"][0]["flops"] == record.flops


def test_licenses_follow_the_asset_only_where_weights_were_used(store: ArtifactStore, unpacked: Path) -> None:
    job, what = made(store)
    texts = report.render_records(job, what, FILES, store, unpacked)
    assert "No downloaded weights were used" in texts["report.html"]
    assert json.loads(texts["provenance.json"])["licenses"] == {}
    used = what.model_copy(update={"steps": [with_weights(step, {"svd": "S & Co"}) for step in what.steps]})
    texts = report.render_records(job, used, FILES, store, unpacked)
    assert "No downloaded weights were used" not in texts["report.html"]
    assert "S &amp; Co" in texts["report.html"]
    assert json.loads(texts["provenance.json"])["licenses"] == {"svd": "S & Co"}
    assert json.loads(texts["report.json"])["licenses"] == {"svd": "S & Co"}


def test_notes_are_said_once_and_a_picture_that_only_names_is_mentioned(store: ArtifactStore) -> None:
    job, what = made(store)
    job = job.model_copy(update={"picture_name": "fox.jpg", "source_name": "run.mp4"})
    notes = report.notes(job, what)
    assert notes[1:] == ["Twice said.", "<b>bold</b>"]
    assert report.notes(*made(store, 9.0)) == ["Twice said.", "<b>bold</b>", "memory ran out"]
    assert "run.mp4" in notes[0]
    assert "fox.jpg only names" in notes[0]


def test_provenance_differs_between_runs_only_under_run(store: ArtifactStore, unpacked: Path) -> None:
    one = json.loads(report.render_records(*made(store, 1.0), FILES, store, unpacked)["provenance.json"])
    two = json.loads(report.render_records(*made(store, 9.0), FILES, store, unpacked)["provenance.json"])
    assert one != two
    runs = [record.pop("run")["steps"][0] for record in (one, two)]
    for fact in ("duration_s", "peak_memory_mb", "flops", "run_notes"):
        assert runs[0][fact] != runs[1][fact]
    assert runs[1]["run_notes"] == ["memory ran out"]
    assert one == two
    assert one["files"] == FILES


@pytest.fixture
def told(store: ArtifactStore) -> dict[str, Any]:
    """A report of two steps, the first of which has a curve."""
    return report.build_report(*made(store), FILES, store)


def test_a_curve_goes_from_top_left_to_bottom_right_on_a_logarithmic_scale(told: dict[str, Any]) -> None:
    page = report.report_page(told)
    (points,) = re.findall(r'points="([^"]*)"', page)
    places = [tuple(map(float, pair.split(","))) for pair in points.split()]
    assert places == [(0, 0), (WIDTH / 2, HEIGHT / 2), (WIDTH, HEIGHT)]
    assert "logarithmic" in page
    assert "static &lt;fit&gt;" in page


@pytest.mark.parametrize("values", [[], [1.0], [float("nan"), float("nan")], [0.0, 0.0], [-1.0, 2.0]])
def test_odd_curves_break_no_page(told: dict[str, Any], values: list[float]) -> None:
    curves: dict[str, Any] = {"title": "t", "x": list(range(len(values))), "series": {"a": values}, "notes": []}
    told["steps"][0]["curves"] = [curves]
    assert not re.search(r"\bnan\b", report.report_page(told))


def test_a_template_refuses_a_value_that_it_was_not_given() -> None:
    with pytest.raises(UndefinedError, match="title"):
        render("index.html", rows=[])


def test_a_summary_counts_and_the_overview_links_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b" / "preview.webp").touch()
    rows = [
        Row(item="a b", status="done", seconds=3),
        Row(item="z/y", status="failed", message="<ugly>"),
        Row(item="c", status="unchanged"),
    ]
    Writer(tmp_path).write(rows, 1.0)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["counts"] == {"done": 1, "unchanged": 1, "failed": 1, "skipped": 0}
    assert summary["commercial_only"] is False
    page = (tmp_path / "index.html").read_text()
    assert Links(page).addresses.count("a%20b/preview.webp") == 1
    assert "&lt;ugly&gt;" in page
    assert page.index("z/y") < page.index("a b")


def test_every_page_that_flows_read_is_part_of_the_installed_package() -> None:
    root = Path(report.__file__).parents[2]
    patterns = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    folders = {package: root / package.replace(".", "/") for package in patterns}
    packaged = {path for package, names in patterns.items() for name in names for path in folders[package].glob(name)}
    assert set((root / "flows").rglob("*.html")) <= packaged
