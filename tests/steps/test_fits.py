"""The two fitting steps: files in, files out, and what they do when a loss is not a number."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tiny_weights
import torch

from dg4d_lib.assets.formats.web_splats import write_web_splats
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.on_parts import OnParts
from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.fitting.hinge import Cut
from dg4d_lib.fitting.hinge_tracking import HINGE_ITERATIONS, Hinged
from dg4d_lib.fitting.rigid_parts import RigidMotion
from dg4d_lib.gaussians.ply import read_ply
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.settings import FramewiseSettings
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.visual_hull.known import known_view
from steps import fit_gaussians, fit_motion
from steps.artifacts.media import read_png, write_frames, write_png
from steps.artifacts.motions import read_motion, read_states
from steps.fit_gaussians import one_state
from steps.fitting import tracking
from steps.fitting.priors import read_bank
from steps.fitting.tracking import TRACKED_NOTE
from steps.profiles import PREVIEW, revise, step_settings
from steps.runtime.job import Job
from steps.sources.bank_writer import write_bank

SMALL = revise(
    PREVIEW,
    {
        "static.iterations": 3,
        "static.views": 2,
        "static.start.points": 200,
        "static.reference_size": 32,
        "static.prune_scale": 1.0,
        "motion.iterations": 2,
        "motion.fine_tune": False,
        "motion.track_surface": False,
        "motion.reference_size": 32,
        "motion.frames_per_iteration": 0,
        "static.resolution_schedule": [{"until": 1.0, "size": 32}],
        "motion.resolution_schedule": [{"until": 1.0, "size": 32}],
        "prior.kind": "geometric",
        "prior.size": 32,
    },
)


STATIC = ["gaussians", "first_look", "curves", "picture"]  # outputs


def disc(shift: int = 0) -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(48), torch.arange(48), indexing="ij")
    inside = ((rows - 24) ** 2 + (columns - 24 - shift) ** 2 < 14**2).float()
    return torch.stack([inside, columns / 48 * inside, 0 * inside, inside], -1)


def job(tmp_path: Path, settings, inputs: dict[str, Path], outputs: list[str]) -> Job:
    (tmp_path / "pictures").mkdir(exist_ok=True)
    reported = tmp_path / "progress.txt"

    def progress(done: int, total: int, values: dict[str, float]) -> None:
        reported.write_text(f"{done}/{total} {sorted(values)}")

    suffixes = {"picture": ".png"}
    files = {name: tmp_path / f"out_{name}{suffixes.get(name, '')}" for name in outputs}
    return Job(inputs, files, settings, seed=1, progress=progress, pictures=tmp_path / "pictures")


@pytest.fixture
def subject(tmp_path: Path) -> Path:
    write_png(tmp_path / "subject.png", disc())
    return tmp_path / "subject.png"


def fit_settings(settings=SMALL):
    return step_settings("fit_gaussians", settings)


def fitted(tmp_path: Path, subject: Path) -> Job:
    work = job(tmp_path, fit_settings(), {"subject": subject}, STATIC)
    fit_gaussians.run(work)
    return work


def test_static_gaussians_come_out_with_curves_and_a_picture(tmp_path: Path, subject: Path):
    work = fitted(tmp_path, subject)
    assert len(read_ply(work.outputs["gaussians"])) > 100
    curves = json.loads(work.outputs["curves"].read_text())
    assert curves["x"] == [1, 2, 3]
    assert set(curves["series"]) == {"loss", "reference", "guidance", "Gaussians"}
    assert read_png(work.outputs["picture"]).shape == (192, 6 * 192, 3)
    gaussians = read_ply(work.outputs["gaussians"])
    assert work.outputs["first_look"].read_bytes() == write_web_splats(one_state(gaussians), fps=1)
    assert (tmp_path / "progress.txt").read_text().startswith("3/3")


def test_a_motion_comes_out_of_gaussians_and_a_video(tmp_path: Path, subject: Path):
    gaussians = fitted(tmp_path, subject).outputs["gaussians"]
    frames = torch.stack([disc(), disc(2), disc(4)])
    write_frames(tmp_path / "video.zip", DrivingVideo(frames[..., :3], frames[..., 3:], 5.0))
    settings = step_settings("fit_motion", SMALL)
    inputs = {"gaussians": gaussians, "driving_video": tmp_path / "video.zip"}
    (tmp_path / "moving").mkdir()
    work = job(tmp_path / "moving", settings, inputs, ["motion", "gaussians", "curves", "picture"])
    facts = fit_motion.run(work)
    frames_fitted = read_motion(work.outputs["motion"]).frames
    assert frames_fitted == 3
    assert "without a network" in facts.notes[0]
    assert not work.outputs["gaussians"].exists()

    tuned = settings.model_copy(update={"motion": SMALL.motion.model_copy(update={"fine_tune": True})})
    work = job(tmp_path / "moving", tuned, inputs, ["motion", "gaussians", "curves", "picture"])
    facts = fit_motion.run(work)
    before, after = read_ply(gaussians), read_ply(work.outputs["gaussians"])
    assert len(before) == len(after) and not torch.equal(before.harmonics, after.harmonics)
    assert facts.notes[-1] == fit_motion.FINE_TUNED


def test_gaussians_that_tear_away_are_dropped_with_their_motion(
    tmp_path: Path, subject: Path, monkeypatch: pytest.MonkeyPatch
):
    gaussians = fitted(tmp_path, subject).outputs["gaussians"]
    frames = torch.stack([disc(), disc(2), disc(4)])
    write_frames(tmp_path / "video.zip", DrivingVideo(frames[..., :3], frames[..., 3:], 5.0))
    settings = step_settings("fit_motion", SMALL.model_copy(update={"deformation": FramewiseSettings()}))
    inputs = {"gaussians": gaussians, "driving_video": tmp_path / "video.zip"}
    (tmp_path / "moving").mkdir()
    work = job(tmp_path / "moving", settings, inputs, ["motion", "gaussians", "curves", "picture"])

    def fit_and_tear(start, deformation, *_, **__):
        deformation.requires_grad_(False).table[1, 4, :3] = 2.0  # of one Gaussian at one frame
        return start

    monkeypatch.setattr(fit_motion, "fit_motion", fit_and_tear)
    assert fit_motion.run(work).notes[-1] == fit_motion.STRAYS.format(1)
    before, after = read_ply(gaussians), read_ply(work.outputs["gaussians"])
    rest = [i for i in range(len(before)) if i != 4]
    assert torch.equal(after.means, before.means[rest])
    states, _ = read_states(work.outputs["gaussians"], work.outputs["motion"])
    assert states.means.shape[1] == len(rest) and (states.means - after.means).abs().max() < 1


def test_views_of_other_sides_shape_the_start_of_the_fit(tmp_path: Path, subject: Path):
    thin = disc()
    thin[:, :20] = thin[:, 28:] = 0
    write_bank(tmp_path / "known.zip", [[known_view(thin, 90.0)]], tmp_path)
    depths = {}
    for name, more in (("alone", {}), ("known", {"known_views": tmp_path / "known.zip"})):
        (tmp_path / name).mkdir()
        inputs = {"subject": subject, **more}
        work = job(tmp_path / name, fit_settings(), inputs, STATIC)
        facts = fit_gaussians.run(work)
        depths[name] = float(read_ply(work.outputs["gaussians"]).means[:, 2].std())
    assert depths["known"] < depths["alone"] / 2
    assert "visual hull of 2 views" in facts.notes[0]

    frames = torch.stack([disc(), disc(2)])
    write_frames(tmp_path / "video.zip", DrivingVideo(frames[..., :3], frames[..., 3:], 5.0))
    inputs = {"gaussians": work.outputs["gaussians"], "driving_video": tmp_path / "video.zip"}
    (tmp_path / "moving").mkdir()
    moving = job(
        tmp_path / "moving",
        step_settings("fit_motion", SMALL),
        {**inputs, "known_views": tmp_path / "known.zip"},
        ["motion", "gaussians", "curves", "picture"],
    )
    report = fit_motion.run(moving)
    assert "visual hull of 2 views" in report.notes[0] and TRACKED_NOTE not in report.notes


def test_the_tracked_surface_of_known_views_guides_later_frames(
    tmp_path: Path, subject: Path, monkeypatch: pytest.MonkeyPatch
):
    write_bank(tmp_path / "known.zip", [[known_view(disc(), 90.0)]], tmp_path)
    small = {"track_iterations": 2, "joint_iterations": 1, "nodes": 8, "size": 32}
    for name in ("HINGE", "SOFT", "SWING"):
        monkeypatch.setattr(tracking, name, getattr(tracking, name).model_copy(update=small))
    for name in ("BESIDE_SOFT", "SWINGS"):
        monkeypatch.setattr(tracking, name, tuple(one.model_copy(update=small) for one in getattr(tracking, name)))
    settings = revise(SMALL, {"motion.track_surface": True})
    statics = job(tmp_path, fit_settings(), {"subject": subject}, STATIC)
    fit_gaussians.run(statics)
    frames = torch.stack([disc(), disc(2), disc(4)])
    write_frames(tmp_path / "video.zip", DrivingVideo(frames[..., :3], frames[..., 3:], 5.0))
    inputs = {"driving_video": tmp_path / "video.zip", "known_views": tmp_path / "known.zip"}

    def on_a_hinge(free: list[InflatedSurface], *_: object) -> Hinged:
        turns = torch.tensor([1.0, 0, 0, 0]).expand(3, 2, -1)
        parts = RigidMotion(torch.tensor([0, 1]), torch.zeros(2, 3), turns, torch.zeros(3, 2, 3))
        return Hinged(free, parts, Cut(np.array([0.0, 1.0, 0.0]), 0.0))

    for name, count in (("tracked", 3), ("hinged", 3), ("alone", 0)):
        (tmp_path / name).mkdir()
        if name == "hinged":  # two iterations hardly keep the outline
            monkeypatch.setattr(tracking, "LOST", 0.0)
            monkeypatch.setattr(tracking, "track_hinge", on_a_hinge)
        given = inputs if count else {"driving_video": inputs["driving_video"]}
        work = job(
            tmp_path / name,
            step_settings("fit_motion", settings),
            {**given, "gaussians": statics.outputs["gaussians"]},
            ["motion", "gaussians", "curves", "picture"],
        )
        assert (TRACKED_NOTE in fit_motion.run(work).notes) == bool(count)
        ways = settings.motion.trackings + 1  # one serves the search of a hinge
        tracked = ways * (2 * count + 1) + HINGE_ITERATIONS if count else 0
        assert isinstance(read_motion(work.outputs["motion"]).deformation, OnParts) == (name == "hinged")
        assert json.loads(work.outputs["curves"].read_text())["x"][-1] == settings.motion.iterations + tracked


def test_both_fits_run_with_a_trained_prior_and_say_so(tmp_path: Path, subject: Path):
    model = tiny_weights.write_zero123(tmp_path / "tiny")
    trained = revise(SMALL, {"prior.kind": "zero123", "prior.weights": str(model), "motion.views": 1})
    statics = job(tmp_path, fit_settings(trained), {"subject": subject}, STATIC)
    of_the_cloud = fit_gaussians.run(statics)
    frames = torch.stack([disc(), disc(2)])
    write_frames(tmp_path / "video.zip", DrivingVideo(frames[..., :3], frames[..., 3:], 5.0))
    settings = step_settings("fit_motion", trained)
    inputs = {"gaussians": statics.outputs["gaussians"], "driving_video": tmp_path / "video.zip"}
    work = job(tmp_path, settings, inputs, ["motion", "curves", "picture"])
    of_the_motion = fit_motion.run(work)
    for facts in (of_the_cloud, of_the_motion):
        assert any(name.endswith("unet/diffusion_pytorch_model.safetensors") for name in facts.weights)
        assert "Zero-1-to-3" in facts.notes[0] and facts.licenses
    for done in (statics, work):
        curves = json.loads(done.outputs["curves"].read_text())
        assert all(value > 0 for value in curves["series"]["guidance"])


def test_a_loss_that_is_no_number_leaves_a_picture_of_the_last_good_state(tmp_path: Path, subject: Path):
    wild = revise(SMALL, {"static.color_weight": 1e45})
    work = job(tmp_path, fit_settings(wild), {"subject": subject}, STATIC)
    with pytest.raises(FitDiverged, match="the loss became inf at iteration 1 of 3"):
        fit_gaussians.run(work)
    assert read_png(work.pictures / "last_good_state.png").shape[2] == 3
    assert not work.outputs["gaussians"].exists()


def test_the_oracle_without_a_bank_is_refused(tmp_path: Path, subject: Path):
    settings = fit_settings(revise(SMALL, {"prior.kind": "oracle"}))
    with pytest.raises(BadInput, match="--bank"):
        fit_gaussians.run(job(tmp_path, settings, {"subject": subject}, STATIC))


def test_a_bank_is_read_tile_by_tile(tmp_path: Path):
    sheet = torch.zeros(16, 16, 4)
    sheet[..., 3] = 1
    sheet[:8, 8:, 0] = 1.0  # the second tile is red
    write_png(tmp_path / "view.png", sheet)
    about = {"frames": [0, 4], "tile": [2, 2], "tile_size": 8}
    about["views"] = [{"file": "view.png", "azimuth": 22.5, "elevation": -20, "radius": 2.0}]
    with zipfile.ZipFile(tmp_path / "bank.zip", "w") as archive:
        archive.write(tmp_path / "view.png", "view.png")
        archive.writestr("bank.json", json.dumps(about))
    bank = read_bank(tmp_path / "bank.zip", tmp_path)
    color, _ = bank.clean([GuidanceView(OrbitCamera(-20, 22.5, width=8, height=8), frame) for frame in (0, 4)])
    assert color[:, 0, 0, 0].tolist() == [0.0, 1.0]
