import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest
import tiny_shape_prior
import tiny_weights
import torch
from media_files import disc
from safetensors.torch import save_file

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.guidance.analytic import AnalyticPrior
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.known import KnownShapes
from dg4d_lib.guidance.moved import MovedSurfaces
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.inflation.hints import DepthField, DepthHint
from dg4d_lib.inflation.surface import inflate
from dg4d_lib.settings import (
    GeometricPriorSettings,
    LearnedPriorSettings,
    MotionSettings,
    OraclePriorSettings,
    StaticSettings,
    Zero123PriorSettings,
)
from dg4d_lib.shape_prior import packaged
from steps.artifacts.depth_fields import read_depth_field, write_depth_field
from steps.artifacts.media import write_png, write_zip
from steps.artifacts.pose import Pose, write_pose
from steps.fitting import priors
from steps.fitting.priors import (
    LoadedPrior,
    make_oracle_prior,
    make_prior,
    read_bank,
    read_bank_folder,
    still_views,
    subject_hint,
    subject_shapes,
)
from steps.fitting.tracking import tracking_of

CUTOUTS = [torch.rand(64, 64, 4, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1)]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights.write_zero123(tmp_path_factory.mktemp("weights") / "mine")


def chosen(model: Path, stage: StaticSettings | MotionSettings, cutouts: list[torch.Tensor]) -> LoadedPrior:
    return make_prior(Zero123PriorSettings(weights=str(model)), cutouts, stage, None, model)


def judged(choice: LoadedPrior, frame: int = 0) -> torch.Tensor:
    images = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(2))
    view = GuidanceView(OrbitCamera(10, 40), frame)
    return choice.prior.loss(images, images[..., :1], [view], 0.5, torch.Generator().manual_seed(3))


def test_zero123_comes_from_a_folder_with_its_digests_and_license(model: Path) -> None:
    choice = chosen(model, StaticSettings(), CUTOUTS[:1])
    facts = choice.report("cpu rasterizer")
    assert facts.backend == "cpu rasterizer"
    names = {name.split("/mine/")[1] if "/mine/" in name else name for name in facts.weights}
    assert {"unet/diffusion_pytorch_model.safetensors", "vae/config.json"} <= names
    assert all(digest.startswith("sha256:") and len(digest) == 71 for digest in facts.weights.values())
    assert len(facts.licenses) == 1 and "Zero-1-to-3" in facts.notes[0]


def test_every_stage_has_its_own_timesteps(model: Path) -> None:
    static = judged(chosen(model, StaticSettings(), CUTOUTS[:1]))
    assert torch.equal(static, judged(chosen(model, StaticSettings(iterations=7), CUTOUTS[:1])))
    assert static != judged(chosen(model, MotionSettings(), CUTOUTS[:1]))
    assert static != judged(chosen(model, StaticSettings(t_max_end=0.3), CUTOUTS[:1]))
    assert static != judged(chosen(model, StaticSettings(noise_draw="uniform"), CUTOUTS[:1]))


def test_pictures_are_seen_over_white(model: Path) -> None:
    color, alpha = CUTOUTS[0][..., :3], CUTOUTS[0][..., 3:]
    opaque = torch.cat([color * alpha + 1 - alpha, torch.ones_like(alpha)], -1)
    found, expected = (judged(chosen(model, StaticSettings(), [cutout])) for cutout in (CUTOUTS[0], opaque))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)  # (color + 1) - 1 is rounded


def test_frames_are_told_apart(model: Path) -> None:
    choice = chosen(model, MotionSettings(), CUTOUTS)
    assert judged(choice, 0) != judged(choice, 1)


def test_that_memory_ran_out_is_said_of_the_run_and_of_nothing_else(model: Path) -> None:
    choice = chosen(model, StaticSettings(), CUTOUTS[:1])
    plenty = choice.report("cpu")
    assert len(plenty.notes) == 1 and not plenty.run_notes

    def tight(piece: slice) -> None:
        if piece.stop - piece.start > 3:
            raise torch.OutOfMemoryError("simulated")

    assert choice.batches is not None
    choice.batches.run(tight, 16)
    assert choice.report("cpu").notes == plenty.notes
    assert "memory ran out with 16 views" in choice.report("cpu").run_notes[0]


def test_a_copy_of_stable_zero123_is_known_by_its_digest(model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unet = hashlib.sha256((model / "unet" / "diffusion_pytorch_model.safetensors").read_bytes()).hexdigest()
    monkeypatch.setattr(priors, "STABLE_UNET", unet)
    with pytest.raises(BadInput, match=r"of the variant stable; set prior\.variant=stable"):
        chosen(model, StaticSettings(), CUTOUTS[:1])
    stable = Zero123PriorSettings(weights=str(model), variant="stable")
    assert make_prior(stable, CUTOUTS[:1], StaticSettings(), None, model).opened


def test_weights_that_are_not_here_are_named_with_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path))
    with pytest.raises(BackendUnavailable, match="dg4d weights pull zero123-xl"):
        make_prior(Zero123PriorSettings(), CUTOUTS[:1], StaticSettings(), None, tmp_path)


def test_the_prior_without_weights_has_none_in_its_facts(tmp_path: Path) -> None:
    settings = GeometricPriorSettings(size=32)
    facts = make_prior(settings, CUTOUTS[:1], StaticSettings(), None, tmp_path).report("cpu")
    assert facts.weights == {} and facts.licenses == {} and len(facts.notes) == 1


@pytest.mark.parametrize("settings", [GeometricPriorSettings(size=32), LearnedPriorSettings(weight=0.25)])
def test_known_views_of_the_first_frame_guide_all_frames(
    settings: GeometricPriorSettings | LearnedPriorSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(packaged, "packaged_network", tiny_shape_prior.tiny_network)
    alpha = torch.zeros(64, 64, 1)
    alpha[20:44, 20:44] = 1
    cutouts = [torch.cat([torch.full((64, 64, 3), 0.4), alpha.roll(shift, 1)], -1) for shift in (0, 3)]
    sides = Bank((OrbitCamera(0, 90, width=64, height=64),), (0,), (cutouts[0] * 255).to(torch.uint8)[None, None])
    choice = make_prior(settings, cutouts, MotionSettings(), None, tmp_path, sides=sides)
    assert isinstance(choice.prior, AnalyticPrior) and isinstance(choice.shapes, KnownShapes)
    assert choice.prior.frames is None and choice.prior.weights == {0: 1.0} and choice.prior.weight < 1
    for azimuth, sign in ((0, 1), (180, -1)):
        camera = OrbitCamera(0, azimuth, width=64, height=64)
        _, cover = choice.prior.clean([GuidanceView(camera, frame) for frame in (0, 1)])
        middles = (cover[..., 0].sum(1) * torch.arange(64)).sum(1) / cover.sum((1, 2, 3))
        assert sign * float(middles[1] - middles[0]) > 2  # pixels; from behind it moves left
    learned = isinstance(settings, LearnedPriorSettings)
    assert bool(choice.report("cpu").weights) == learned  # the network has guessed frame 1
    tracked = prior_of_a_still_hull(settings, cutouts, sides, tmp_path)
    assert isinstance(tracked.prior, AnalyticPrior) and tracked.prior.weight == 1
    _, still = tracked.prior.clean([GuidanceView(camera, frame) for frame in (0, 1)])
    assert float((still[1] - cover[1]).abs().max()) > 0.1  # pulled towards the tracked shape, which stands still
    assert float((still[0] - still[1]).abs().max()) < 0.1  # that shape alone
    assert bool(tracked.report("cpu").weights) == learned


def prior_of_a_still_hull(
    settings: GeometricPriorSettings | LearnedPriorSettings, cutouts: list[torch.Tensor], sides: Bank, scratch: Path
) -> LoadedPrior:
    """Return the prior of two frames of which known views show the first; its tracked hull stands still."""
    return make_prior(
        settings,
        cutouts,
        MotionSettings(),
        None,
        scratch,
        sides=sides,
        track=lambda first: MovedSurfaces([first] * 2),
    )


def test_optical_flow_counts_beside_a_tracked_hull_of_which_no_view_shows_the_sides(tmp_path: Path) -> None:
    alpha = torch.zeros(64, 64, 1)
    alpha[20:44, 20:40] = 1
    cutouts = [torch.cat([torch.full((64, 64, 3), 0.4), alpha.roll(shift, 1)], -1) for shift in (0, 6)]
    behind = Bank((OrbitCamera(0, 180, width=64, height=64),), (0,), (cutouts[0].flip(1) * 255).byte()[None, None])
    choice = prior_of_a_still_hull(GeometricPriorSettings(size=32), cutouts, behind, tmp_path)
    camera = OrbitCamera(width=64, height=64)
    _, (first, second) = choice.prior.clean([GuidanceView(camera, frame) for frame in (0, 1)])
    assert float(first[32, 37]) > 0.9
    left, entered = float(second[32, 21]), float(second[32, 43])
    assert left == pytest.approx(0.7, abs=0.1)  # where the tracked hull stands still
    assert entered == pytest.approx(0.3, abs=0.1)  # where flow carries the other


@pytest.mark.parametrize("settings", [GeometricPriorSettings(size=32), LearnedPriorSettings()])
def test_the_shape_network_takes_away_what_few_views_allow(
    settings: GeometricPriorSettings | LearnedPriorSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    near = torch.where(torch.arange(64) < 32, 5.0, -5.0).expand(128, 128, 64)  # matter lies in front, in both views
    monkeypatch.setattr(priors, "_predicted_logits", lambda cutout: near)
    alpha = torch.zeros(64, 64, 1)
    alpha[20:44, 20:44] = 1
    cutout = torch.cat([torch.full((64, 64, 3), 0.4), alpha], -1)
    sides = Bank((OrbitCamera(0, 90, width=64, height=64),), (0,), (cutout * 255).to(torch.uint8)[None, None])
    vertices = subject_shapes(settings, [cutout], sides=sides).surface(0).vertices
    far, close = vertices[:, [0, 2]].sum(1).aminmax()
    cut = isinstance(settings, LearnedPriorSettings)  # the corner far from both cameras
    assert (float(-far) < 0.85 * float(close)) == cut
    back = replace(sides, cameras=(OrbitCamera(0, 180, width=64, height=64),))
    for known, noted in ((sides, cut), (back, False)):  # opposite views leave all depths open
        note = make_prior(settings, [cutout], StaticSettings(), None, Path(), sides=known).note
        assert "visual hull of 2 views" in note and ("shape network" in note) == noted


@pytest.mark.parametrize(("count", "tracking"), [(3, "descent"), (16, "flow")])
def test_a_turntable_follows_optical_flow_and_few_views_descend(count: int, tracking: str) -> None:
    cameras = tuple(OrbitCamera(0, 360 * step / count, width=64, height=64) for step in range(count))
    views = Bank(cameras, (0,), torch.zeros(count, 1, 64, 64, 4, dtype=torch.uint8))
    assert tracking_of(views).tracking == tracking


def test_known_views_of_a_later_frame_guide_that_frame_alone(tmp_path: Path) -> None:
    sides = Bank((OrbitCamera(0, 90, width=64, height=64),), (1,), torch.full((1, 1, 64, 64, 4), 255).byte())
    choice = make_prior(GeometricPriorSettings(), CUTOUTS, MotionSettings(), None, tmp_path, sides=sides)
    assert choice.prior.frames == (1,)


def bank_folder(folder: Path) -> Path:
    """Two views of two frames, each of one color."""
    folder.mkdir()
    views = []
    for row, azimuth in enumerate((0.0, 90.0)):
        sheet = torch.ones(8, 16, 4)
        sheet[:, :8, 0], sheet[:, 8:, 0] = 0.2 * row, 0.2 * row + 0.4
        write_png(folder / f"{row}.png", sheet)
        views.append({"file": f"{row}.png", "azimuth": azimuth, "elevation": 0.0, "radius": 2.0})
    about = {"frames": [0, 2], "tile": [1, 2], "tile_size": 8, "views": views}
    (folder / "bank.json").write_text(json.dumps(about))
    return folder


def test_a_bank_is_the_same_from_a_folder_and_from_a_zip(tmp_path: Path) -> None:
    folder = bank_folder(tmp_path / "bank")
    write_zip(tmp_path / "bank.zip", [(path.name, path.read_bytes()) for path in sorted(folder.iterdir())])
    packed, plain = read_bank(tmp_path / "bank.zip", tmp_path / "scratch"), read_bank_folder(folder)
    assert torch.equal(packed.pictures, plain.pictures) and packed.cameras == plain.cameras
    assert packed.pictures[:, :, 0, 0, 0].tolist() == [[0, 102], [51, 153]] and packed.frames == (0, 2)


def test_an_imperfect_oracle_has_the_same_flaws_in_both_stages(tmp_path: Path) -> None:
    bank = read_bank_folder(bank_folder(tmp_path / "bank"))
    flawed = OraclePriorSettings(pose_deg=3.0)
    first, second = (make_oracle_prior(bank, flawed, TimestepSchedule(start)) for start in (0.98, 0.5))
    assert first.viewpoints == second.viewpoints
    assert (
        first.viewpoints
        != make_oracle_prior(bank, OraclePriorSettings(), TimestepSchedule(0.5)).viewpoints
        == bank.cameras
    )


def test_the_learned_prior_records_its_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(packaged, "packaged_network", tiny_shape_prior.tiny_network)
    choice = make_prior(LearnedPriorSettings(), CUTOUTS[:1], StaticSettings(), None, tmp_path)
    assert choice.shapes is not None and choice.shapes.surface(0).faces.numel()
    facts = choice.report("cpu")
    assert facts.weights == packaged.digests() and facts.licenses == {} and "shape network" in facts.notes[0]


def test_the_report_tells_how_much_of_an_unsure_shape_is_inflated(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    unsure = tiny_shape_prior.tiny_network()
    with torch.no_grad():
        unsure.head.weight.zero_()
        unsure.head.bias.fill_(-4.0)
    monkeypatch.setattr(packaged, "packaged_network", lambda: unsure)
    choice = make_prior(LearnedPriorSettings(), CUTOUTS[:1], StaticSettings(), None, tmp_path)
    assert choice.shapes is not None
    assert len(choice.report("cpu").notes) == 1  # nothing was asked yet
    choice.shapes.clean([GuidanceView(OrbitCamera(10, 40, width=32, height=32))])
    assert "100% of its shape is the inflated silhouette" in choice.report("cpu").notes[1]


def test_footage_and_hints_turn_every_prior(tmp_path: Path) -> None:
    for settings, factor in ((GeometricPriorSettings(), 1), (LearnedPriorSettings(), 4 / 3)):
        for shown, found in ((12.0, 12.0 * factor), (0.0, 0.0), (None, None)):
            write_pose(tmp_path / "pose.json", Pose(turn_deg=shown))
            assert subject_hint(settings, tmp_path / "pose.json", None, 0.0) == DepthHint(found)
            assert subject_hint(settings, tmp_path / "pose.json", None, -5.0) == DepthHint(-5)
        assert subject_hint(settings, None, None, 0.0).is_empty


def test_a_depth_field_survives_its_file_and_bends_both_priors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packaged, "packaged_network", tiny_shape_prior.tiny_network)
    known = torch.ones(32, 32, dtype=torch.bool)
    write_depth_field(tmp_path / "field.safetensors", DepthField(torch.full((32, 32), 0.3), known, 0.1))
    field = read_depth_field(tmp_path / "field.safetensors")
    assert field.sigma == 0.1 and torch.equal(field.known, known) and (field.middle == 0.3).all()
    ball = torch.from_numpy(disc()).float() / 255
    for settings in (GeometricPriorSettings(), LearnedPriorSettings()):
        hint = subject_hint(settings, None, tmp_path / "field.safetensors", 0.0)
        behind = DepthHint(0.0, replace(field, middle=-field.middle))
        near, far = (subject_shapes(settings, [ball], each).surface(0) for each in (hint, behind))
        assert float(near.vertices[:, 2].mean() - far.vertices[:, 2].mean()) > 0.2


def test_a_depth_picture_goes_before_a_depth_network(tmp_path: Path) -> None:
    known = torch.ones(32, 32, dtype=torch.bool)
    settings = GeometricPriorSettings(depth_weights=str(tmp_path / "gone"))
    for sigma, runs in ((0.1, False), (0.0, True)):
        hint = DepthHint(0.0, DepthField(torch.zeros(32, 32), known, sigma))
        if runs:  # layers say too little to spare it
            with pytest.raises((BadInput, BackendUnavailable)):
                make_prior(settings, CUTOUTS, StaticSettings(), None, tmp_path, hint)
        else:
            assert "depth" not in make_prior(settings, CUTOUTS, StaticSettings(), None, tmp_path, hint).note


def test_broken_depth_fields_are_refused(tmp_path: Path) -> None:
    known = torch.ones(32, 32, dtype=torch.bool)
    for middle, there in (
        (torch.zeros(32, 16), known),
        (torch.zeros(32, 32), ~known),
        (torch.zeros(32, 32), known + 1.0),
    ):
        tensors = {"middle": middle, "known": there}
        save_file(tensors, tmp_path / "field.safetensors", {"depth_field": '{"sigma": 0.1}'})
        with pytest.raises(BadInput, match="not a depth field"):
            read_depth_field(tmp_path / "field.safetensors")
    (tmp_path / "field.safetensors").write_bytes(b"none")
    with pytest.raises(BadInput, match="not a depth field"):
        read_depth_field(tmp_path / "field.safetensors")


def test_the_geometric_prior_starts_and_judges_as_the_inflation_does(tmp_path: Path) -> None:
    settings = GeometricPriorSettings(size=32)
    shapes, expected = (
        subject_shapes(settings, CUTOUTS, DepthHint(10.0)).surface(1),
        inflate(CUTOUTS[1], 32, DepthHint(10.0)),
    )
    assert torch.equal(shapes.vertices, expected.vertices) and torch.equal(shapes.colors, expected.colors)
    prior = make_prior(settings, CUTOUTS, StaticSettings(), None, tmp_path).prior
    assert isinstance(prior, AnalyticPrior) and prior.weight == 1


def test_random_views_of_shapes_come_from_a_few_cameras_where_that_is_asked_for(tmp_path: Path) -> None:
    settings = GeometricPriorSettings(size=32)
    assert make_prior(settings, CUTOUTS, MotionSettings(), None, tmp_path).prior.viewpoints is None
    radii = {}
    for stage in (StaticSettings(viewpoints=6), MotionSettings(viewpoints=6)):
        cameras = make_prior(settings, CUTOUTS, stage, None, tmp_path).prior.viewpoints
        assert cameras is not None and len(set(cameras)) == 6
        assert all(abs(camera.elevation_deg) <= stage.elevation_deg for camera in cameras)
        radii[type(stage)] = {camera.radius for camera in cameras}
    assert radii[MotionSettings] == {2.0}
    assert len(radii[StaticSettings]) == 6 and all(1.5 <= radius <= 2.5 for radius in radii[StaticSettings])


def test_a_prior_that_keeps_its_views_says_the_same(tmp_path: Path) -> None:
    settings = GeometricPriorSettings(size=32)
    fresh, keeping = (
        make_prior(settings, CUTOUTS, MotionSettings(viewpoints=count), None, tmp_path) for count in (0, 6)
    )
    assert keeping.prior.viewpoints is not None
    view = GuidanceView(replace(keeping.prior.viewpoints[2], width=64, height=64), 1)
    images = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(2))
    losses = [
        prior.loss(images, images[..., :1], [view], 0.5, torch.Generator())
        for prior in (fresh.prior, keeping.prior, keeping.prior)
    ]
    assert losses[1] == losses[2] == pytest.approx(float(losses[0]), rel=1e-4)


def test_only_pictures_of_a_single_moment_join_the_motion_fit() -> None:
    side = OrbitCamera(0, 90, width=8, height=8)
    pictures = torch.zeros(1, 2, 8, 8, 4, dtype=torch.uint8)
    assert list(still_views(Bank((side,), (0,), pictures[:, :1]), 5)) == [0]
    assert still_views(Bank((side,), (0,), pictures[:, :1]), 5)[0][0].camera == side
    assert still_views(Bank((side,), (0, 1), pictures), 5) == {}  # a video of the other side
    assert still_views(Bank((side,), (6,), pictures[:, :1]), 5) == {}
    assert still_views(None, 5) == {}
