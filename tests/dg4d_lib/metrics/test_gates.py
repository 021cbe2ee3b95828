import math
import re
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dg4d_lib.asset_settings import GateSettings
from dg4d_lib.cameras.orbit import OrbitCamera, viewmats
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.metrics import gates
from dg4d_lib.metrics.gates import (
    MESH,
    SPLATS,
    Gate,
    GateInputs,
    RgbaImages,
    Turntable,
    consistency,
    evaluate_gates,
    fidelity,
    flicker,
    floaters,
    motion,
    sharpness,
)

SIZE = 64


def disk(x: float = 0.0, radius: float = 0.5, gray: float = 0.3) -> RgbaImages:
    """Return a striped disk at x, in halves of the image."""
    line = (torch.arange(SIZE) + 0.5) / SIZE * 2 - 1
    v, u = torch.meshgrid(line, line, indexing="ij")
    inside = (((u - x) ** 2 + v**2) < radius**2).float()[None, ..., None]
    stripes = gray + 0.2 * torch.sin(20 * (u - x))[None, ..., None]
    return RgbaImages((stripes * inside + 1 - inside).expand(1, SIZE, SIZE, 3).contiguous(), inside)


def film(places: list[float]) -> RgbaImages:
    disks = [disk(x) for x in places]
    return RgbaImages(torch.cat([d.color for d in disks]), torch.cat([d.alpha for d in disks]))


def ball_turn(radius: float = 0.5, count: int = 24) -> Turntable:
    """Return a ball around the origin with depth in closed form."""
    cameras = turntable(count, OrbitCamera(width=SIZE, height=SIZE))
    focal = cameras[0].focal
    line = (torch.arange(SIZE) + 0.5 - SIZE / 2) / focal
    y, x = torch.meshgrid(line, line, indexing="ij")
    a, b, c = x**2 + y**2 + 1, torch.tensor(-2 * 2.0), 4 - radius**2  # |depth * ray - (0, 0, 2)| = radius
    root = (b**2 - 4 * a * c).clamp(min=0).sqrt()
    hit = (b**2 - 4 * a * c > 0).float()
    depth = torch.where(hit > 0, (-b - root) / (2 * a), 0.0)
    everywhere = (count, SIZE, SIZE, 1)
    return Turntable(
        hit[None, ..., None].expand(everywhere).contiguous(),
        depth[None, ..., None].expand(everywhere).contiguous(),
        viewmats(cameras),
        focal,
    )


def evidence(pictures: RgbaImages, video: RgbaImages) -> GateInputs:
    forms = {SPLATS: pictures, MESH: pictures}
    return GateInputs(RgbaImages(video.color[:1], video.alpha[:1]), video, forms, forms, ball_turn(), 0.0, 0.0)


SWAYING = film([0.1 * math.sin(t) for t in range(8)])


def test_the_video_itself_passes_every_gate() -> None:
    gates = evaluate_gates(evidence(SWAYING, SWAYING), GateSettings())
    assert [gate.name for gate in gates if not gate.passed] == []
    assert {gate.name: gate.value for gate in gates} == {
        "fidelity": pytest.approx(60, abs=1e-3),
        "silhouette": 1,
        "consistency": pytest.approx(1, abs=0.04),  # the rim is a large part of so few pixels
        "flicker": 0,
        "floaters": 0,
        "flaws": 0,
        "folds": 0,
        "agreement": 1,
        "sharpness": 1,
        "motion": 1,
    }


@pytest.mark.parametrize(
    ("pictures", "failing"),
    [
        (film([0.0] * 8), {"motion", "flicker"}),
        (film([0.4 * math.sin(t) for t in range(8)]), {"motion", "flicker", "silhouette", "fidelity"}),
        (RgbaImages((SWAYING.color + 1) / 2, SWAYING.alpha), {"fidelity", "motion", "sharpness"}),
    ],
    ids=["frozen", "four times the motion", "washed out"],
)
def test_what_is_wrong_is_named(pictures: RgbaImages, failing: set[str]) -> None:
    gates = evaluate_gates(evidence(pictures, SWAYING), GateSettings())
    assert failing <= {gate.name for gate in gates if not gate.passed}
    assert {"consistency", "flaws", "agreement", "floaters"} <= {gate.name for gate in gates if gate.passed}


@pytest.mark.parametrize(("own_model", "passed"), [(False, False), (True, True)])
def test_parts_of_a_given_model_may_slide_into_each_other(own_model: bool, passed: bool) -> None:
    crossing = replace(evidence(SWAYING, SWAYING), folds=0.05, own_model=own_model)
    found = {gate.name: gate for gate in evaluate_gates(crossing, GateSettings())}
    assert found["folds"].passed is passed


def test_one_torn_frame_is_enough_for_the_silhouette() -> None:
    torn = SWAYING.alpha.clone()
    torn[3, :, : SIZE // 2] = 0
    found = {
        gate.name: gate for gate in evaluate_gates(evidence(replace(SWAYING, alpha=torn), SWAYING), GateSettings())
    }
    assert found["silhouette"].value < 0.6
    assert found["fidelity"].passed


def test_the_worse_form_counts() -> None:
    still = film([0.0] * 8)
    mixed = replace(evidence(SWAYING, SWAYING), input_views={SPLATS: SWAYING, MESH: still})
    found = {gate.name: gate for gate in evaluate_gates(mixed, GateSettings())}
    assert (found["motion"].form, found["motion"].passed) == (MESH, False)
    assert found["motion"].values[SPLATS] == 1


@pytest.mark.parametrize(
    ("value", "passed"), [(0.75, True), (0.7499, False), (1.25, True), (1.2501, False), (1.0, True)]
)
def test_bounds_belong_to_what_passes(value: float, passed: bool) -> None:
    assert Gate("sharpness", {"mesh": value}, 0.75, 1.25, "", "").passed is passed


def test_a_band_is_left_on_either_side() -> None:
    gate = Gate("motion", {"splats": 0.1, "mesh": 1.1}, 0.6, 1.7, "", "")
    assert (gate.form, gate.value, gate.passed) == ("splats", 0.1, False)
    assert replace(gate, values={"splats": 0.7, "mesh": 5.0}).form == "mesh"


@pytest.mark.parametrize(("least", "most"), [(0.6, 1.7), (0.6, None), (None, 1.7), (None, None)])
def test_a_value_lies_on_a_side_only_where_there_is_a_bound(least: float | None, most: float | None) -> None:
    gate = Gate("motion", {"splats": 1.0}, least, most, "", "")
    sides = ["" if least is None else "low", "", "", "", "" if most is None else "high"]
    assert [gate.side(value) for value in (0.1, 0.6, 1.0, 1.7, 5.0)] == sides


def test_fidelity_looks_at_the_subject_only() -> None:
    dark = RgbaImages(disk().color - 0.1 * disk().alpha, disk().alpha)
    assert fidelity(dark, disk()).item() == pytest.approx(20, abs=1e-3)  # 0.1 off everywhere on the subject


def test_frames_without_the_subject_do_not_pay_for_those_with_it() -> None:
    video = film([0.1 * math.sin(t) for t in range(8)])
    left = torch.arange(8)[:, None, None, None] < 4
    video = RgbaImages(torch.where(left, video.color, 1.0), video.alpha * left)
    wrong = RgbaImages(torch.where(video.alpha > 0, 1 - video.color, video.color), video.alpha)
    found = {gate.name: gate for gate in evaluate_gates(evidence(wrong, video), GateSettings())}
    assert not found["fidelity"].passed
    assert found["fidelity"].value == pytest.approx(float(fidelity(wrong, video)[:4].mean()))


def test_where_the_video_stands_still_no_motion_is_right_and_jumps_are_wrong() -> None:
    still = film([0.0] * 4)
    jumping = film([0.0, 0.1, 0.0, 0.1])
    assert motion(still, still) == 1
    assert flicker(still, still) == 0
    assert motion(jumping, still) > 10
    assert flicker(jumping, still) > 10


def test_a_single_frame_has_nothing_to_flicker() -> None:
    assert flicker(disk(), disk(0.2)) == 0
    assert motion(disk(), disk(0.2)) == 1


def test_motion_counts_changes() -> None:
    video = film([0.0, 0.02])
    gray = replace(video, color=(1 + video.color) / 2)  # half the contrast, half the change
    assert motion(gray, video) == pytest.approx(0.5, abs=0.05)


def test_floaters_are_what_hangs_apart() -> None:
    alpha = torch.zeros(3, SIZE, SIZE, 1)
    alpha[:, 10:20, 10:20] = 1  # 100 pixels
    alpha[1, 40:45, 40:45] = 1  # 25 apart
    alpha[2, 20:25, 20:25] = 1  # 25 that touch a corner
    pictures = RgbaImages(torch.zeros(3, SIZE, SIZE, 3), alpha)
    assert floaters(pictures).tolist() == pytest.approx([0, 0.2, 0])
    assert floaters(RgbaImages(torch.zeros(1, 8, 8, 3), torch.zeros(1, 8, 8, 1))).tolist() == [0]


def test_what_hangs_apart_in_the_video_too_is_no_floater() -> None:
    alpha = SWAYING.alpha.clone()
    alpha[:, :6, :6] = 1
    apart = replace(SWAYING, alpha=alpha)
    found = {gate.name: gate.value for gate in evaluate_gates(evidence(apart, apart), GateSettings())}
    assert found["floaters"] == 0
    assert evaluate_gates(evidence(apart, SWAYING), GateSettings())[4].value > 0.02


def test_a_solid_ball_is_consistent() -> None:
    assert consistency(ball_turn()) > 0.965  # but for its rim, where depth changes within a pixel


def test_depths_that_do_not_fit_each_other_are_not() -> None:
    turn = ball_turn()
    generator = torch.Generator().manual_seed(0)
    flat = turn.alpha * 2.0  # every side shows a disk through the middle, turned towards it
    noisy = turn.depth + 0.2 * torch.randn(turn.depth.shape, generator=generator)
    near = torch.arange(24).reshape(-1, 1, 1, 1) % 2 * 0.3  # every other side shows it nearer
    for depth in (flat, noisy, turn.depth - near):
        assert consistency(replace(turn, depth=depth)) < 0.9
    assert consistency(replace(turn, alpha=torch.zeros_like(turn.alpha))) == 0


def test_blur_and_noise_are_told_by_sharpness() -> None:
    truth = disk(radius=0.8)

    def with_color(color: Tensor) -> float:
        return sharpness(replace(truth, color=color), truth)

    planes = truth.color.movedim(-1, 1)
    blurred = torch.nn.functional.avg_pool2d(planes, 9, 1, 4).movedim(1, -1)
    noise = torch.rand(truth.color.shape, generator=torch.Generator().manual_seed(0))
    assert with_color(truth.color) == 1
    assert with_color(blurred) < 0.8
    assert with_color(truth.color + 0.2 * noise) > 1.3


def test_half_the_contrast_is_half_as_sharp() -> None:
    truth = disk(radius=0.8)
    assert sharpness(replace(truth, color=0.5 + (truth.color - 0.5) / 2), truth) == pytest.approx(0.5, rel=0.02)


def test_a_plain_subject_is_as_sharp_as_can_be() -> None:
    plain = RgbaImages(torch.full((1, SIZE, SIZE, 3), 0.5), disk().alpha)
    assert sharpness(plain, plain) == 1


def test_every_threshold_decides() -> None:
    for knob in set(GateSettings.model_fields) - {"cutout"}:  # gates of another step
        name, _, side = knob.removeprefix("added_").rpartition("_")
        seen = replace(evidence(SWAYING, SWAYING), own_model=knob.startswith("added_"))
        found = {gate.name: gate for gate in evaluate_gates(seen, GateSettings())}
        changed = evaluate_gates(seen, GateSettings(**{knob: getattr(GateSettings(), knob) * 0.5}))
        moved = {gate.name: gate for gate in changed}
        assert getattr(moved[name], side) == pytest.approx(getattr(found[name], side) / 2)
        assert all(moved[other] == found[other] for other in found if other != name)


def advice(**changes: object) -> dict[str, str]:
    """Return the advice on gates that all fail, by gate."""
    impossible = GateSettings(
        fidelity_least=60, silhouette_least=1, consistency_least=1, flicker_most=0, floaters_most=0, flaws_most=0,
        folds_most=0, added_folds_most=0, agreement_least=1, sharpness_least=10, motion_least=10,
        sharpness_most=10, motion_most=100,
    )  # fmt: skip
    torn = SWAYING.alpha.clone()
    torn[:, :6, :6] = 1
    apart = replace(SWAYING, color=(SWAYING.color + 1) / 2, alpha=torn)
    smaller = replace(SWAYING, alpha=SWAYING.alpha * 0)
    failing = evidence(apart, SWAYING)
    failing = replace(failing, side_views={SPLATS: apart, MESH: smaller}, flaws=1.0, folds=1.0, **changes)
    return {gate.name: gate.advice for gate in evaluate_gates(failing, impossible)}


@pytest.mark.parametrize("kind", [{}, {"per_frame": True}, {"own_model": True}], ids=["tracked", "per frame", "own"])
def test_every_failed_gate_gives_advice_with_settings_that_exist(kind: dict[str, bool]) -> None:
    profiles = pytest.importorskip("steps.profiles")
    tree = profiles.PREVIEW.model_dump()
    found = advice(**kind)
    assert all(found.values())
    knobs = {knob for text in found.values() for knob in re.findall(r"\b([a-z]+\.[a-z_]+)\b", text)}
    assert len(knobs) > 4
    assert [knob for knob in knobs if knob.split(".")[1] not in tree[knob.split(".")[0]]] == []


def test_advice_fits_the_mesh() -> None:
    assert "mesh.mode=per_frame" in advice()["folds"] and "mesh.mode=per_frame" in advice()["agreement"]
    assert not [text for text in advice(per_frame=True).values() if "mesh.mode" in text or "mesh.source" in text]
    own = " ".join(advice(own_model=True).values())
    assert re.search(r"asset\.nodes", own) and not re.search(r"static\.|motion\.|mesh\.(?!texture_size)", own)


@pytest.mark.parametrize(
    ("splats", "mesh", "says"),
    [
        (0.35, 0.9, "raise static.iterations"),
        (0.9, 0.35, "raise mesh.texture_size and mesh.render_size"),
        (0.6, 0.35, "splats: raise static.iterations; mesh: raise mesh.texture_size and mesh.render_size"),
        (1.4, 0.9, "lower static.color_lr"),
        (1.4, 0.3, "raise mesh.texture_size and mesh.render_size"),
        (0.9, 0.9, ""),
    ],
)
def test_advice_is_for_the_form_and_the_side_that_fail(
    splats: float, mesh: float, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = iter([splats, mesh])
    monkeypatch.setattr(gates, "sharpness", lambda *_: next(values))
    found = {gate.name: gate.advice for gate in evaluate_gates(evidence(SWAYING, SWAYING), GateSettings())}
    assert found["sharpness"] == says
