import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "dg4d_lib" / "visual_hull"))
from creatures import creature, seen

from benchmarks import inputs, prior
from benchmarks.true_views import figures, read_subjects
from steps.artifacts.media import write_png


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a data set of one object that does not move."""
    root = tmp_path_factory.mktemp("objects")
    for name, azimuth in {"input": 0, "view_15": 15, "view_105": 105}.items():
        (root / "thing" / name).mkdir(parents=True)
        for frame in range(2):
            write_png(root / "thing" / name / f"{frame:03d}.png", seen(creature(), azimuth, size=64).cutout)
    (root / "thing" / "static").mkdir()
    for azimuth in (90, 180, 270):
        path = root / "thing" / "static" / f"az_{azimuth:03d}.png"
        write_png(path, seen(creature(), azimuth, size=64).cutout)
    return root


def test_pictures_of_other_sides_beat_the_video_alone(objects, tmp_path):
    overlaps = {}
    for way in ("none", "views"):
        out = tmp_path / f"{way}.json"
        inputs.main([f"--{way}", str(objects), "--first", "--json", str(out), "--sheet", str(tmp_path / f"{way}.png")])
        overlaps[way] = json.loads(out.read_text())["thing"]["iou"]
        assert (tmp_path / f"{way}.png").stat().st_size > 1000
    assert overlaps["views"] > max(0.85, overlaps["none"] + 0.1)


def test_cut_outs_are_scored_over_all_backdrops_and_written(objects, tmp_path, capsys):
    out = tmp_path / "rows.json"
    inputs.main(["--matting", str(objects), "--json", str(out)])
    rows = json.loads(out.read_text())["rows"]
    assert len({row["backdrop"] for row in rows}) == len(rows) == 32
    assert next(row["iou"] for row in rows if row["backdrop"] == "green screen") > 0.9
    assert "procedural: mean" in capsys.readouterr().out


def test_one_way_must_be_chosen(objects):
    with pytest.raises(SystemExit):
        inputs.main(["--views", str(objects), "--none", str(objects)])


def test_a_view_compared_with_itself_is_perfect(objects):
    (subject,) = read_subjects(objects)
    cutouts = subject.views[15.0]
    perfect = figures(cutouts[..., :3] * cutouts[..., 3:] + 1 - cutouts[..., 3:], cutouts[..., 3:], cutouts)
    assert perfect["iou"] == 1 and perfect["psnr"] > 50


def test_priors_are_compared_on_an_object(objects, tmp_path, capsys):
    prior.main([str(objects), "--kinds", "geometric", "--sheet", str(tmp_path / "sheet.png")])
    assert capsys.readouterr().out.splitlines()[-1].startswith("| mean | ")
