import json
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from typing import NoReturn

import pytest
import torch
from tiny_weights import write_zero123

from benchmarks import ablations, fits
from benchmarks.ablations import ABLATIONS, IMPERFECT, QUICK, Ablation, Claim, Row, Variant, main, settings_of, verdict
from benchmarks.fits import Figures, fits_per_frame, moving_fit, score, static_fit, subsample_frames
from benchmarks.objects.specimens import Specimen
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.guidance.interface import GuidancePrior, GuidanceView
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import LgmStartSettings
from steps.artifacts.media import write_png

SIZE, FRAMES = 32, 4
CHANGES = {
    **QUICK,
    "static.start.points": 60,
    "static.iterations": 40,
    "motion.iterations": 30,
    "motion.plane_lr": 0.05,
}


def ball(frame: int):
    """A few colored balls that slide along x."""
    generator = torch.Generator().manual_seed(4)
    means = (torch.rand(12, 3, generator=generator) - 0.5) * 0.6 + torch.tensor([0.1 * frame, 0.0, 0.0])
    return isotropic(means, torch.full((12,), 0.12), torch.rand(12, 3, generator=generator), 0.95)


@pytest.fixture(scope="module")
def specimen() -> Specimen:
    rasterize = get_rasterizer("cpu")
    scored = (OrbitCamera(0, 15, width=SIZE, height=SIZE), OrbitCamera(0, 105, width=SIZE, height=SIZE))
    known = tuple(OrbitCamera(0, 45 * i, width=SIZE, height=SIZE) for i in range(8))
    states = [ball(frame) for frame in range(FRAMES)]

    def cutouts(cameras):
        pictures = [rasterize(state, cameras, torch.zeros(3)) for state in states]
        rows = [torch.cat([p.color / p.alpha.clamp(min=1e-6), p.alpha], -1).clamp(0, 1) for p in pictures]
        return torch.stack(rows, 1)

    bank = Bank(known, tuple(range(FRAMES)), (cutouts(known) * 255).round().to(torch.uint8))
    return Specimen("balls", cutouts(known[:1])[0], bank, scored, cutouts(scored))


def test_the_truth_has_the_best_figures(specimen):
    perfect = score(specimen, [ball(frame) for frame in range(FRAMES)])
    assert perfect.psnr > 50 and perfect.iou == 1 and perfect.terr < 0.01
    frozen = score(specimen, [ball(0)] * FRAMES)
    assert frozen.terr == pytest.approx(1.0) and frozen.psnr_obj < perfect.psnr_obj - 20
    assert score(specimen, [ball(0)]).terr is None


def test_a_fit_reaches_more_than_a_still_one(specimen):
    settings = settings_of(CHANGES, SIZE, FRAMES)
    rest = static_fit(specimen, settings, 0)
    moved = score(specimen, moving_fit(specimen, rest, settings, 0))
    still = score(specimen, [rest] * FRAMES)
    assert moved.psnr_obj > still.psnr_obj + 0.5 and moved.terr < 0.9 < still.terr


@pytest.mark.slow
def test_every_frame_can_be_fitted_for_itself(specimen):
    alone = fits_per_frame(specimen, settings_of(CHANGES, SIZE, FRAMES), 0)
    assert len(alone) == FRAMES
    assert score(specimen, alone).psnr_obj > score(specimen, [alone[0]] * FRAMES).psnr_obj


def test_every_frame_can_be_fitted_from_the_static_stage(specimen, monkeypatch):
    starts = []

    def fit(start: Gaussians, subject: torch.Tensor, *_: object) -> Gaussians:
        starts.append((start, subject))
        return start

    monkeypatch.setattr(fits, "fit_gaussians", fit)
    rest = ball(0)
    fits_per_frame(specimen, settings_of(CHANGES, SIZE, FRAMES), 0, start=rest)
    assert len(starts) == FRAMES and all(start is rest for start, _ in starts)
    assert all(torch.equal(subject, specimen.cutouts[frame]) for frame, (_, subject) in enumerate(starts))
    ablations.Laboratory(CHANGES, SIZE).figures(specimen, Variant(per_frame=True, from_static=True), 0, still=False)
    first, *others = [len(start) for start, _ in starts[FRAMES:]]
    assert others == [first] * FRAMES and all(start is starts[FRAMES][0] for start, _ in starts[FRAMES:])


def test_an_imperfect_oracle_has_the_same_errors_of_a_frame_in_every_fit(specimen, monkeypatch):
    still = specimen.bank.pictures[:, :1].expand(-1, FRAMES, -1, -1, -1)
    subject = replace(specimen, bank=replace(specimen.bank, pictures=still))  # only the errors differ between frames
    seen = list[GuidancePrior]()

    def fit_first(start: Gaussians, subject: torch.Tensor, prior: GuidancePrior, *_: object) -> Gaussians:
        seen.append(prior)
        return start

    def fit_all(rest: Gaussians, field: object, video: object, prior: GuidancePrior, *_: object) -> Gaussians:
        seen.append(prior)
        return rest

    monkeypatch.setattr(fits, "fit_gaussians", fit_first)
    monkeypatch.setattr(fits, "fit_motion", fit_all)
    errors = {"prior.color_gain": 0.2, "prior.pose_deg": 4.0}
    settings = settings_of({**CHANGES, **errors}, SIZE, FRAMES)
    half = settings_of({**CHANGES, **errors, "subject.max_frames": 2}, SIZE, FRAMES)
    fits_per_frame(subject, settings, 0)
    rest = static_fit(subject, settings, 0)
    for chosen in (settings, half):
        moving_fit(subject, rest, chosen, 0)
    assert len({prior.viewpoints for prior in seen}) == 1

    def color(prior: GuidancePrior, frame: int) -> list[float]:
        camera = replace(prior.viewpoints[1], width=SIZE, height=SIZE)
        return prior.clean([GuidanceView(camera, frame)])[0].mean((0, 1, 2)).tolist()

    *single, static, whole, sparse = seen
    wanted = [color(whole, frame) for frame in range(FRAMES)]
    assert len({tuple(values) for values in wanted}) == FRAMES
    assert [color(prior, 0) for prior in single] == wanted and color(static, 0) == wanted[0]
    assert [color(sparse, frame) for frame in (0, 1)] == [wanted[0], wanted[2]]


def test_another_prior_than_the_oracle_is_conditioned_on_the_cut_outs(specimen):
    few = {**CHANGES, "prior.kind": "geometric", "static.iterations": 1, "motion.iterations": 1}
    settings = settings_of(few, SIZE, FRAMES)
    rest = static_fit(specimen, settings, 0)
    assert len(moving_fit(specimen, rest, settings, 0)) == FRAMES
    with pytest.raises(BadInput, match=r"static.start.kind is lgm; these fits start with blob or surface"):
        lgm = settings.static.model_copy(update={"start": LgmStartSettings()})
        static_fit(specimen, settings.model_copy(update={"static": lgm}), 0)


def test_half_of_the_frames_are_every_second_one(specimen):
    half, stride = subsample_frames(specimen, 2)
    assert stride == 2 and len(half.cutouts) == 2 and half.bank.frames == (0, 1)
    assert torch.equal(half.cutouts[1], specimen.cutouts[2])
    assert torch.equal(half.bank.pictures[:, 1], specimen.bank.pictures[:, 2])
    sparse = replace(specimen, bank=replace(specimen.bank, frames=(0, 3), pictures=specimen.bank.pictures[:, [0, 3]]))
    assert subsample_frames(sparse, 2)[0].bank.frames == (0,)


@pytest.mark.parametrize("name", ABLATIONS)
def test_every_variant_is_made_of_settings_of_the_pipeline_and_every_claim_of_variants(name):
    ablation = ABLATIONS[name]
    for variant in ablation.variants.values():
        settings = settings_of({**IMPERFECT, **variant.changes}, 64, 16)
        assert settings.prior.kind == "oracle" and settings.subject.max_frames in (8, 16)
    assert {side for claim in ablation.claims for side in (claim.better, claim.other)} <= set(ablation.variants)


def rows(first: list[float], second: list[float]) -> list[Row]:
    pairs = (("a", first), ("b", second))
    return [Row("x", name, "o", seed, Figures(0, v, 0, v)) for name, values in pairs for seed, v in enumerate(values)]


@pytest.mark.parametrize(
    ("first", "second", "claim", "outcome"),
    [
        ([5.0, 6.0, 7.0], [4.0, 5.1, 5.9], Claim("a", "b", "psnr_obj"), "Reproduced"),
        ([5.0, 6.0, 7.0], [4.0, 5.1, 5.9], Claim("b", "a", "psnr_obj"), "Not reproduced"),
        ([5.0, 6.0, 7.0], [4.0, 5.1, 5.9], Claim("b", "a", "terr"), "Reproduced"),
        ([5.0, 6.0, 7.0], [5.5, 5.5, 7.1], Claim("a", "b", "psnr_obj"), "Not decided"),
        ([5.0, 6.0], [4.0, 5.2], Claim("a", "b", "psnr_obj"), "Not decided"),
        ([5.0, 6.0, 7.0], [5.01, 5.99, 7.01], Claim("a", "b", "psnr_obj", alike=True), "Reproduced"),
        ([5.0, 6.0, 7.0], [5.5, 6.5, 7.5], Claim("a", "b", "psnr_obj", alike=True), "Reproduced"),
        ([5.0, 6.0, 7.0], [5.5, 5.5, 7.1], Claim("a", "b", "psnr_obj", alike=True), "Not decided"),
        ([5.0, 6.0, 7.0], [4.0, 5.1, 5.9], Claim("a", "b", "psnr_obj", alike=True), "Not reproduced"),
        ([5.0], [4.0], Claim("a", "b", "psnr_obj"), "Not decided"),
        ([5.0], [5.0], Claim("a", "b", "psnr_obj", alike=True), "Not decided"),
    ],
)
def test_the_verdict_follows_from_pairs_and_their_spread(first, second, claim, outcome):
    ablation = Ablation("a is better", {"a": Variant(), "b": Variant()}, (claim,))
    sentence = verdict(ablation, rows(first, second))
    assert sentence.startswith(f"{outcome}: a is better")
    assert sentence.endswith(f"{claim.figure}.")


@pytest.fixture
def dataset(specimen: Specimen, tmp_path: Path) -> Path:
    """The balls as a data set has them, and as a picture of which no more is known."""
    views = {
        f"view_{camera.azimuth_deg:g}": film for camera, film in zip(specimen.cameras, specimen.views, strict=True)
    }
    for name, film in {"input": specimen.cutouts, **views}.items():
        (tmp_path / "balls" / name).mkdir(parents=True)
        for i, picture in enumerate(film):
            write_png(tmp_path / "balls" / name / f"{i}.png", picture)
    sheets = tmp_path / "balls" / "bank"
    sheets.mkdir()
    for i, film in enumerate(specimen.bank.pictures):
        write_png(sheets / f"{i}.png", torch.cat(list(film), 1) / 255)
    known = [
        {"file": f"{i}.png", "azimuth": camera.azimuth_deg, "elevation": camera.elevation_deg, "radius": camera.radius}
        for i, camera in enumerate(specimen.bank.cameras)
    ]
    about = {"frames": list(range(FRAMES)), "tile": [1, FRAMES], "tile_size": SIZE, "views": known}
    (sheets / "bank.json").write_text(json.dumps(about))
    copytree(tmp_path / "balls", tmp_path / "picture")
    for frame in range(1, FRAMES):
        (tmp_path / "picture" / "input" / f"{frame}.png").unlink()
    return tmp_path


def called(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr("sys.argv", ["ablations", *words])
    main()


@pytest.mark.slow
def test_a_data_set_is_fitted_and_scored_as_the_objects_are(dataset, specimen, monkeypatch, capsys):
    settings = ["static.start.points=60", "static.iterations=10", "motion.iterations=5"]
    words = [*(f"--set={setting}" for setting in settings), "--objects=balls", "--seeds=1", f"--size={SIZE}"]
    rows = dataset / "rows.json"
    called(monkeypatch, "zero-start", "static", f"--data={dataset}", f"--json={rows}", *words)
    printed = capsys.readouterr().out
    assert f"zero-start: balls; 1 seeds, {FRAMES} frames" in printed and "Not decided" in printed
    found = {row["variant"]: row for row in json.loads(rows.read_text())["rows"]}
    assert set(found) == {"zero", "random", *ABLATIONS["static"].variants}
    chosen = settings_of({"static.start.points": 60, "static.iterations": 10, "motion.iterations": 5}, SIZE, FRAMES)
    direct = score(specimen, moving_fit(specimen, static_fit(specimen, chosen, 0), chosen, 0))
    assert found["zero"]["figures"]["psnr_obj"] == pytest.approx(direct.psnr_obj, abs=0.2)
    assert found["1 view, white"]["figures"]["terr"] is None


@pytest.mark.slow
def test_a_diffusion_prior_runs_the_ablations_without_the_caveats_of_the_oracle(dataset, tmp_path, monkeypatch, capsys):
    weights = write_zero123(tmp_path / "zero123")
    words = ["--set=prior.kind=zero123", f"--set=prior.weights={weights}", "--quick", "--objects=balls"]
    few = ["--set=static.iterations=2", "--set=motion.iterations=2", "--set=static.views=1", "--set=motion.views=1"]
    called(monkeypatch, "noise", f"--data={dataset}", *words, *few)
    printed = " ".join(capsys.readouterr().out.split())
    assert "T_max 0.98" in printed and "Not decided: in the dynamic stage" in printed


def test_objects_may_stand_before_the_names_of_ablations_as_in_the_usage(monkeypatch):
    given = []
    monkeypatch.setattr(ablations, "run", lambda options, console: given.append(options))
    called(monkeypatch, "--objects", "newt,parrot", "static", "noise")
    assert given[0].objects == ["newt", "parrot"] and given[0].names == ["static", "noise"]


@pytest.mark.parametrize(
    ("words", "sizes"), [([], (16, 96)), (["--quick"], (4, 48)), (["--quick", "--size=32"], (4, 32))]
)
def test_given_sizes_go_before_those_of_a_smoke_test(words, sizes, monkeypatch):
    asked = []

    def find(data: None, names: None, frames: int, size: int) -> NoReturn:
        asked.append((frames, size))
        raise BadInput("enough")

    monkeypatch.setattr(ablations, "find_specimens", find)
    with pytest.raises(SystemExit):
        called(monkeypatch, "static", *words)
    assert asked == [sizes]


@pytest.mark.parametrize("base", [{}, QUICK, {"static.iterations": 500, "motion.iterations": 200}])
def test_longer_fits_are_as_much_longer_whatever_the_base(base):
    recipe = ABLATIONS["recipe"].variants

    def iterations(name: str) -> tuple[int, int]:
        variant = recipe[name]
        settings = settings_of({**base, **variant.changes}, SIZE, 8, variant.factors)
        return settings.static.iterations, settings.motion.iterations

    static, motion = iterations("paper")
    assert iterations("and twice as long") == (static, 2 * motion)
    assert iterations("and a longer static stage") == (2 * static, 2 * motion)


def test_what_cannot_be_run_is_refused_with_what_can(dataset, monkeypatch, capsys):
    for words, message in (
        (["noise", f"--data={dataset}", "--objects", "cat"], "unknown objects cat; choose from balls, picture"),
        (["static", "--objects", "cat"], "unknown objects cat; choose from newt, parrot, jellyfish, excavator"),
        (["static", "noise", f"--data={dataset}"], "noise: needs videos; picture has one frame only"),
        (["static", f"--data={dataset / 'nowhere'}"], "is not a data set"),
        (["static", "--seeds", "0"], "--seeds is 0; give at least 1"),
        (["static", "--frames", "0"], "--frames is 0; give at least 1"),
        (["static", "--size=-3"], "--size is -3; give at least 1"),
        (["noise", f"--data={dataset}", "--objects=balls", "--set=prior.kind=zero123"], "dg4d weights pull"),
    ):
        with pytest.raises(SystemExit) as ended:
            called(monkeypatch, *words)
        assert ended.value.code == 2 and message in " ".join(capsys.readouterr().err.split())


def test_fractions_are_of_the_frames_there_are():
    settings = settings_of({"subject.max_frames": 0.5, "deformation.temporal": 0.5}, SIZE, 12)
    assert settings.subject.max_frames == settings.deformation.temporal == 6
    assert settings_of({"subject.max_frames": 5}, SIZE, 12).subject.max_frames == 5
    assert settings_of({}, SIZE, 12).subject.max_frames == 12
