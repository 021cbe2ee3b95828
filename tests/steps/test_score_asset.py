"""A small package against truths that are its own pictures, so that its scores are known."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_judges
import torch
from PIL import Image
from small_package import packed, tracked

from dg4d_lib.asset_settings import ScoreSettings
from dg4d_lib.errors import BadInput
from steps.artifacts.media import read_png, write_png, write_zip
from steps.artifacts.rendering import render_package
from steps.profiles import ScoreAssetSettings
from steps.runtime.job import Job, StepReport
from steps.score_asset import run

SIZE, COUNT = 64, 12
AZIMUTHS = (15.0, 105.0)
NONE = {f"{name}_weights": "" for name in ("vgg", "lpips", "clip", "i3d")}


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return packed(tmp_path_factory.mktemp("package"))


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory, package: Path) -> Path:
    """What the package looks like, and its mesh."""
    folder = tmp_path_factory.mktemp("truth")
    render_package(package, (0.0, *AZIMUTHS), 0.0, SIZE, COUNT, False, folder, rasterizer="reference")
    (folder / "view_0").rename(folder / "input")
    asset = tracked()
    np.savez(
        folder / "mesh.npz", vertices=(asset.mesh.vertices + asset.offsets).numpy(), faces=asset.mesh.faces.numpy()
    )
    return folder


def zipped(folder: Path, out: Path) -> Path:
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    write_zip(out, [(name, (folder / name).read_bytes()) for name in names])
    return out


def score(
    out: Path,
    truth: Path,
    package: Path | None = None,
    mesh: bool = False,
    actionbench: bool = False,
    max_frames: int = 0,
    **knobs: object,
) -> tuple[dict, StepReport]:
    out.mkdir(parents=True, exist_ok=True)
    inputs = {"truth": zipped(truth, out / "truth.zip")}
    if package is not None:
        inputs["package"] = zipped(package, out / "package.zip")
    settings = ScoreSettings.model_validate({**NONE, "samples": 2000, **knobs})
    job = Job(
        inputs=inputs,
        outputs={"scores": out / "scores.json", "films": out / "films.zip"},
        settings=ScoreAssetSettings(
            rasterizer="reference", mesh=mesh, actionbench=actionbench, max_frames=max_frames, score=settings
        ),
        seed=0,
        progress=lambda done, total, values: None,
        pictures=out,
    )
    facts = run(job)
    return json.loads(job.outputs["scores"].read_text()), facts


def test_an_asset_that_is_the_truth_is_perfect(package: Path, truth: Path, tmp_path: Path) -> None:
    report, _ = score(tmp_path, truth, package)
    assert (report["frames"], report["size"], report["notes"]) == (COUNT, SIZE, [])
    row = report["rows"]["asset"]
    perfect = {"psnr": 60, "psnr_obj": 60, "ssim": 1, "iou": 1, "flicker": 0, "terr": 0, "motion": 1}
    for figures in (row["mean"], row["input"], *row["views"].values()):
        assert figures == pytest.approx(perfect)
    assert list(row["views"]) == ["15", "105"]
    spacing = 0.05  # of 2000 points on a gem of radius 0.3
    assert 0 < row["geometry"]["chamfer"] < spacing
    assert 0 < row["geometry"]["chamfer_aligned"] < spacing


def test_a_video_that_was_sampled_is_scored_at_the_times_of_its_frames(
    package: Path, truth: Path, tmp_path: Path
) -> None:
    whole = tmp_path / "truth"  # 6 frames, of which a video of 3 keeps 0, 2 and 4; at the end it stands
    for name in ("view_0", "view_15"):
        render_package(package, (float(name[5:]),), 0.0, SIZE, 6, False, whole, rasterizer="reference", end=0.8)
    (whole / "view_0").rename(whole / "input")
    assert (whole / "input/004.png").read_bytes() == (whole / "input/005.png").read_bytes()
    sampled, _ = score(tmp_path / "a", whole, package, max_frames=3)
    assert sampled["rows"]["asset"]["mean"]["psnr"] == pytest.approx(60)
    stretched, _ = score(tmp_path / "b", whole, package)
    assert stretched["rows"]["asset"]["mean"]["psnr"] < 40


def test_true_meshes_may_have_more_frames_than_a_video_that_was_sampled(
    package: Path, truth: Path, tmp_path: Path
) -> None:
    whole = small_truth(tmp_path / "truth", truth, lambda v: v, 6)  # of which a video of 3 keeps 0, 2 and 4
    asset = tracked(9)
    vertices = (asset.mesh.vertices + asset.offsets).numpy()  # 0 to 8 of 11; then it stands
    np.savez(whole / "mesh.npz", vertices=vertices[[*range(9), 8, 8]], faces=asset.mesh.faces.numpy())
    (sampled, _), (stretched, _) = (
        score(tmp_path / str(most), whole, package, max_frames=most, samples=4000) for most in (3, 0)
    )
    assert sampled["rows"]["asset"]["geometry"]["chamfer"] < 0.012  # with points 0.007 apart
    assert stretched["rows"]["asset"]["geometry"]["chamfer"] > 0.018


def test_a_mesh_elsewhere_is_far_until_it_is_aligned(package: Path, truth: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    for folder in ("input", "view_15"):
        (moved / folder).mkdir(parents=True)
        for path in (truth / folder).iterdir():
            (moved / folder / path.name).write_bytes(path.read_bytes())
    with np.load(truth / "mesh.npz") as mesh:
        weights = np.ones(len(mesh["faces"]))
        np.savez(moved / "mesh.npz", vertices=mesh["vertices"] * 0.5 + 0.7, faces=mesh["faces"], face_weight=weights)
    report, _ = score(tmp_path / "out", moved, package)
    geometry = report["rows"]["asset"]["geometry"]
    assert geometry["chamfer"] > 0.5
    assert geometry["chamfer_aligned"] < 0.05


def actionbench(truth: Path, package: Path, out: Path) -> dict[str, float]:
    few = {"actionbench_points": 3000, "icp_points": 200}
    report, _ = score(out, truth, package, actionbench=True, **few)
    return report["rows"]["asset"]["geometry"]


def small_truth(out: Path, truth: Path, change: Callable[[np.ndarray], np.ndarray], frames: int = 3) -> Path:
    """The truth with fewer frames and other vertices."""
    for folder in ("input", "view_15"):
        (out / folder).mkdir(parents=True)
        for i in range(frames):
            (out / folder / f"{i:03d}.png").write_bytes((truth / folder / f"{i:03d}.png").read_bytes())
    asset = tracked(frames)
    vertices = (asset.mesh.vertices + asset.offsets).numpy()
    np.savez(out / "mesh.npz", vertices=change(vertices), faces=asset.mesh.faces.numpy())
    return out


@pytest.mark.slow
def test_the_metrics_of_actionbench_forgive_the_pose_and_not_the_motion(
    package: Path, truth: Path, tmp_path: Path
) -> None:
    same = actionbench(small_truth(tmp_path / "a", truth, lambda v: v), package, tmp_path / "a/out")
    spacing = 0.05  # of 3000 points on a gem of radius 0.6 in units of the box
    assert all(0 < same[name] < 2 * spacing for name in ("cd_3d", "cd_4d", "cd_m")), same
    larger = actionbench(small_truth(tmp_path / "b", truth, lambda v: 1.5 * v + 0.3), package, tmp_path / "b/out")
    assert larger["chamfer"] > 0.3
    assert larger["cd_3d"] < 0.12  # CD-4D: so even a gem also fits the first frame in other poses
    still = actionbench(
        small_truth(tmp_path / "c", truth, lambda v: np.repeat(v[:1], 3, 0)), package, tmp_path / "c/out"
    )
    assert still["cd_3d"] < 0.2 and 0.4 < still["cd_4d"] < still["cd_m"], still
    reach = 0.4 / float(tracked().mesh.vertices.abs().max())  # of the motion, in halves of the gem, which fills the box
    assert still["cd_m"] == pytest.approx(2 * reach * (0 + 0.5 + 1) / 3, rel=0.15)


def test_the_mesh_is_judged_where_it_is_asked_for(package: Path, truth: Path, tmp_path: Path) -> None:
    """The gem is larger than the ball of splats."""
    report, _ = score(tmp_path, truth, package, mesh=True)
    mean = report["rows"]["asset"]["mean"]
    assert 0.3 < mean["iou"] < 0.95
    assert mean["psnr"] < 30


def test_naive_guesses_are_the_input_and_what_stands_still(truth: Path, tmp_path: Path) -> None:
    report, _ = score(tmp_path, truth)
    rows = report["rows"]
    assert set(rows) == {"input_repeated", "input_frozen", "truth_frozen"}
    for name in ("input_frozen", "truth_frozen"):
        assert rows[name]["mean"]["terr"] == pytest.approx(1)
        assert rows[name]["mean"]["motion"] == 0
    assert rows["truth_frozen"]["mean"]["iou"] > rows["input_frozen"]["mean"]["iou"]
    assert rows["input_repeated"]["views"]["15"]["psnr"] > rows["input_repeated"]["views"]["105"]["psnr"]
    assert rows["input_repeated"]["views"]["15"]["motion"] == pytest.approx(1, abs=0.2)


def test_figures_of_a_frame_off_are_what_the_pictures_say(package: Path, truth: Path, tmp_path: Path) -> None:
    """Means over frames, then over views, by hand for one of them: the mean squared error of whole pictures."""
    late = tmp_path / "late"
    for folder in ("input", "view_15"):
        (late / folder).mkdir(parents=True)
        for i in range(COUNT):
            content = (truth / folder / f"{min(i + 3, COUNT - 1):03d}.png").read_bytes()
            (late / folder / f"{i:03d}.png").write_bytes(content)
    report, _ = score(tmp_path / "out", late, package)
    psnrs = []
    for i in range(COUNT):
        a, b = (read_png(root / "view_15" / f"{i:03d}.png") for root in (truth, late))
        on_white = [picture[..., :3] * picture[..., 3:] + 1 - picture[..., 3:] for picture in (a, b)]
        error = float((on_white[0] - on_white[1]).square().mean())
        psnrs.append(min(60.0, -10 * np.log10(error)) if error else 60.0)
    assert report["rows"]["asset"]["mean"]["psnr"] == pytest.approx(np.mean(psnrs), abs=1e-3)


def test_missing_weights_are_named_with_the_command_and_give_no_number(
    package: Path, truth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path / "none"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    names = {
        f"{name}_weights": ScoreSettings.model_fields[f"{name}_weights"].default for name in ("vgg", "lpips", "i3d")
    }
    report, facts = score(tmp_path, truth, package, **names)
    assert set(report["missing"]) == {"lpips", "clip", "fvd_consistent4d"}
    for command in ("dg4d weights pull vgg16", "dg4d weights pull lpips-vgg"):
        assert command in report["missing"]["lpips"]
    assert "dg4d weights pull i3d" in report["missing"]["fvd_consistent4d"]
    assert "turned off" in report["missing"]["clip"]
    assert not set(report["missing"]) & set(report["rows"]["asset"]["mean"])
    assert facts.weights == {}


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    root = tmp_path_factory.mktemp("networks")
    return {
        "vgg_weights": str(tiny_judges.write_vgg16(root / "vgg16")),
        "lpips_weights": str(tiny_judges.write_lpips(root / "lpips-vgg")),
        "clip_weights": str(tiny_judges.write_clip(root / "clip")),
        "i3d_weights": str(tiny_judges.write_i3d(root / "i3d")),
    }


def test_networks_find_the_truth_perfect_and_a_guess_worse(
    package: Path, truth: Path, networks: dict[str, str], tmp_path: Path
) -> None:
    report, facts = score(tmp_path / "ours", truth, package, size=64, **networks)
    guessed, _ = score(tmp_path / "guessed", truth, size=64, **networks)
    ours, guess = report["rows"]["asset"]["mean"], guessed["rows"]["input_frozen"]["mean"]
    assert report["missing"] == {}
    perfect = {"lpips": 0, "clip": 1, "fvd_consistent4d": 0}
    assert {name: ours[name] for name in perfect} == pytest.approx(perfect, abs=1e-5)
    assert guess["lpips"] > 1e-3
    assert guess["clip"] < 0.9999
    assert guess["fvd_consistent4d"] > 1e-3
    assert {name.split("/")[-1] for name in facts.weights} >= {"model.safetensors", "i3d_torchscript.pt"}
    assert [len(numbers) for numbers in report["clips"].values()] == [tiny_judges.ACTIONS] * len(AZIMUTHS)
    assert report["clips"]["15"] == pytest.approx(guessed["clips"]["15"])  # the truth's


def test_an_input_alone_is_judged_from_its_own_side(
    package: Path, truth: Path, networks: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "alone" / "input").mkdir(parents=True)
    (tmp_path / "alone" / "input" / "000.png").write_bytes((truth / "input" / "000.png").read_bytes())
    report, _ = score(tmp_path / "out", tmp_path / "alone", package, size=64, **networks)
    row = report["rows"]["asset"]
    assert row["views"] == row["mean"] == {}
    assert row["input"]["psnr"] == 60  # the first frame
    assert 0.5 < row["input"]["clip_i"] < 1  # of all frames, which move away
    assert "terr" not in row["input"]
    assert "10 frames or more; these have 1" in report["missing"]["fvd_consistent4d"]
    with zipfile.ZipFile(tmp_path / "out" / "films.zip") as films:
        assert films.namelist() == ["input.mp4"]


def test_of_opaque_pictures_what_is_not_white_is_the_subject(package: Path, truth: Path, tmp_path: Path) -> None:
    opaque = tmp_path / "opaque"
    for folder in ("input", "view_15"):
        (opaque / folder).mkdir(parents=True)
        for path in (truth / folder).iterdir():
            picture = read_png(path)
            write_png(opaque / folder / path.name, picture[..., :3] * picture[..., 3:] + 1 - picture[..., 3:])
    report, _ = score(tmp_path / "out", opaque, package)
    mean = report["rows"]["asset"]["mean"]
    assert mean["psnr"] > 45  # rounding at the rim
    assert 0.3 < mean["iou"] < 0.7  # what is nearly transparent is not white
    assert report["notes"] == ["ground-truth masks are estimated, because these pictures are opaque: input, view_15"]


def test_frames_that_are_not_square_or_of_several_sizes_are_refused(package: Path, truth: Path, tmp_path: Path) -> None:
    odd = tmp_path / "odd"
    (odd / "input").mkdir(parents=True)
    write_png(odd / "input" / "000.png", torch.zeros(40, 50, 4))
    with pytest.raises(BadInput, match="frames of input must be square and of one size; found 50 x 40"):
        score(tmp_path / "out", odd, package)
    write_png(odd / "input" / "000.png", torch.zeros(SIZE, SIZE, 4))
    (odd / "view_15").mkdir()
    write_png(odd / "view_15" / "000.png", torch.zeros(32, 32, 4))
    with pytest.raises(BadInput, match="frames of view_15 must be 64 x 64, as those of the input; found 32 x 32"):
        score(tmp_path / "out", odd, package)


def test_frames_of_the_truth_are_turned_upright(truth: Path, tmp_path: Path) -> None:
    for folder, turn, orientation in (("input", 0, 1), ("view_15", 90, 6)):
        (tmp_path / "turned" / folder).mkdir(parents=True)
        exif = Image.Exif()
        exif[0x0112] = orientation
        with Image.open(truth / "input" / f"{COUNT - 1:03d}.png") as picture:
            picture.rotate(turn).save(tmp_path / "turned" / folder / "000.png", exif=exif)
    report, _ = score(tmp_path / "out", tmp_path / "turned")
    assert report["rows"]["input_frozen"]["mean"]["psnr"] == 60


def test_gray_frames_keep_their_alpha(package: Path, truth: Path, tmp_path: Path) -> None:
    (tmp_path / "gray/input").mkdir(parents=True)
    with Image.open(truth / "input/000.png") as picture:
        picture.convert("LA").save(tmp_path / "gray/input/000.png")
    report, _ = score(tmp_path / "out", tmp_path / "gray", package)
    assert report["notes"] == []
    assert report["rows"]["asset"]["input"]["iou"] == 1


def test_a_broken_mesh_of_the_truth_is_refused(package: Path, truth: Path, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    (broken / "input").mkdir(parents=True)
    (broken / "input" / "000.png").write_bytes((truth / "input" / "000.png").read_bytes())
    np.savez(broken / "mesh.npz", points=np.zeros(3))
    with pytest.raises(BadInput, match="holds no meshes"):
        score(tmp_path / "out", broken, package)


def test_the_same_again_gives_the_same_bytes(package: Path, truth: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "1", tmp_path / "2"
    score(first, truth, package)
    score(second, truth, package)
    for name in ("scores.json", "films.zip"):
        assert (first / name).read_bytes() == (second / name).read_bytes()
