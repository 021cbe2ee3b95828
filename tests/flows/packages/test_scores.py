"""Tables and pages of scores that are made up."""

import csv
from io import StringIO

import pytest

from flows.packages.scores import ObjectScores, Results, averaged, csv_text, figures_of, markdown, scores_page, table


def row(psnr: float, **more: float) -> dict[str, object]:
    views = {"-75": {"psnr": psnr - 1, **more}, "15": {"psnr": psnr + 1, **more}}
    return {"views": views, "mean": {"psnr": psnr, **more}}


def ours(psnr: float, **more: float) -> dict[str, object]:
    return {**row(psnr, **more), "input": {"psnr": 30.0, "iou": 0.9, "terr": 0.1}, "geometry": {"chamfer": 0.01}}


def results(**changes: object) -> Results:
    objects = [
        ObjectScores(
            object="fox", seconds=10, frames=32, size=256, rows={"input_frozen": row(8.0), "video": ours(20.0)}
        ),
        ObjectScores(
            object="owl", seconds=20, frames=32, size=256, rows={"input_frozen": row(6.0), "video": ours(24.0)}
        ),
        ObjectScores(object="eel", error="it <slipped> away", seconds=99),
    ]
    given = {"title": "three animals", "ours": "video", "drawn": "splats", "objects": objects}
    return Results.model_validate({**given, "mean": averaged(objects, "video"), **changes})


def test_means_are_over_objects_with_scores() -> None:
    mean = results().mean
    assert list(mean) == ["input_frozen", "video"]
    assert mean["video"]["psnr"] == 22
    assert mean["input_frozen"] == {"psnr": 7}
    assert mean["video"]["seconds"] == 15  # without the one that failed


def test_figures_of_a_method_take_the_input_view_under_names_of_its_own() -> None:
    figures = figures_of(ours(20.0))
    assert figures == {"psnr": 20, "chamfer": 0.01, "input_psnr": 30, "input_iou": 0.9}
    assert figures_of({"input": {"psnr": 40.0, "iou": 1.0, "clip_i": 0.8}, "views": {}, "mean": {}}) == {
        "input_psnr": 40, "input_iou": 1, "clip_i": 0.8,
    }  # fmt: skip


def cells(text: str, method: str, heading: str) -> dict[str, str]:
    """The row of a method in the table of Markdown whose heading is there."""
    tables = [part.splitlines() for part in text.split("\n\n") if part.startswith("|")]
    (found,) = [lines for lines in tables if f"| {heading} |" in lines[0] and lines[0].startswith("| method | ")][:1]
    head, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in found]
    return next(dict(zip(head, one, strict=True)) for one in rows if one[0] == method)


def test_the_first_table_has_the_papers_columns_and_missing_is_no_number() -> None:
    text = markdown(results(missing={"lpips": "`dg4d weights pull vgg16` gets it"}))
    assert cells(text, "video", "LPIPS ↓") == {
        "method": "video", "LPIPS ↓": "missing", "CLIP ↑": "-", "FVD (Consistent4D) ↓": "-", "time, s ↓": "15",
    }  # fmt: skip
    assert cells(text, "video", "PSNR, dB ↑")["PSNR, dB ↑"] == "22.00"
    assert cells(text, "first input frame at every view", "PSNR, dB ↑")["chamfer ↓"] == "-"
    assert "- lpips: `dg4d weights pull vgg16` gets it" in text
    assert r"- eel failed: it \<slipped\> away" in text
    assert "Means over 2 objects" in text


def test_published_figures_stand_apart_and_say_that_they_are_of_other_data() -> None:
    before, _, published = markdown(results()).partition("## Published")
    assert "729.74" not in before
    assert "| DreamGaussian4D | 0.12 | 0.92 | 729.74 | 15 min |" in published
    assert "other data" in published


def test_every_view_is_a_row_of_the_csv() -> None:
    rows = list(csv.DictReader(StringIO(csv_text(results()))))
    fox = {(one["method"], one["view"]): one for one in rows if one["object"] == "fox"}
    assert set(fox) == {("input_frozen", view) for view in ("-75", "15", "mean")} | {
        ("video", view) for view in ("input", "-75", "15", "mean")
    }
    assert fox["video", "-75"]["psnr"] == "19.0"
    assert fox["video", "input"]["terr"] == "0.1"
    assert fox["video", "mean"]["chamfer"] == "0.01"
    assert fox["video", "mean"]["seconds"] == "10.0"
    assert not fox["video", "mean"]["lpips"]


def test_the_artifact_has_a_row_per_method() -> None:
    rows = table(results(missing={"clip": "no"}))
    assert [one["method"] for one in rows] == ["first input frame at every view", "video"]
    assert rows[1]["PSNR, dB ↑"] == "22.00"
    assert rows[1]["CLIP ↑"] == "missing"


@pytest.fixture
def films() -> dict[str, dict[str, dict[str, str]]]:
    views = ("input", "view_-75")
    return {"fox": {whose: {view: f"films/fox/{whose}/{view}.mp4" for view in views} for whose in ("truth", "ours")}}


def test_the_page_shows_films_side_by_side_and_escapes_what_others_wrote(
    films: dict[str, dict[str, dict[str, str]]],
) -> None:
    text = scores_page(results(title="<three> animals", missing={"clip": "get <it>"}), films)
    assert text.count("<video") == 4
    assert text.index("films/fox/truth/view_-75.mp4") < text.index("films/fox/ours/view_-75.mp4")
    assert "<th>-75°" in text
    for wrong in ("<three>", "<it>", "<slipped>"):
        assert wrong not in text
    assert "it &lt;slipped&gt; away" in text


def test_a_page_without_any_scores_says_why() -> None:
    nothing = [ObjectScores(object="eel", error="it slipped away")]
    text = scores_page(results(objects=nothing, mean={}), {})
    assert "it slipped away" in text
    assert "<th>method<th>LPIPS" in text


def test_objects_may_be_called_anything() -> None:
    name = "=1|<img src=x>![](http://tracker)"
    one = results(
        objects=[ObjectScores(object=name, error="[a](http://b)"), ObjectScores(object="-1", rows={"video": ours(2.0)})]
    )
    assert "<img" not in scores_page(one, {}) and "&lt;img src=x&gt;" in scores_page(one, {})
    assert r"- =1" not in markdown(
        one
    ) and r"\|\<img src=x\>!\[\](http\://tracker) failed: \[a\](http\://b)" in markdown(one)
    assert {line["object"] for line in csv.DictReader(StringIO(csv_text(one)))} == {"'-1"}
    assert all(float(line["psnr"]) for line in csv.DictReader(StringIO(csv_text(one))))


def test_the_exit_code_is_that_of_all_objects_or_1() -> None:
    good, bad, broken = (
        ObjectScores(object="a", rows={"video": ours(2.0)}),
        ObjectScores(object="b", error="x", kind="StepBadInput"),
        ObjectScores(object="c", error="x", kind="StepCrashed"),
    )
    assert [results(objects=several).exit_code for several in ([good], [bad], [good, bad], [bad, broken])] == [
        0,
        65,
        1,
        1,
    ]
