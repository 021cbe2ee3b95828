import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from small_package import FRAMES, cloud, gem, inputs, job, tracked
from torch import Tensor

from dg4d_lib.asset_settings import GateSettings
from dg4d_lib.assets.animated import Asset4D, states_between
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.metrics.gates import GateInputs, evaluate_gates
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import read_png
from steps.catalog import STEPS
from steps.check_asset import LoadedAsset, collect_evidence, gates_as_json, run
from steps.pack_asset import run as pack
from steps.profiles import PREVIEW, step_settings
from steps.runtime.job import Job, StepReport

NAMES = [
    "fidelity", "silhouette", "consistency", "flicker", "floaters", "flaws", "folds", "agreement", "sharpness",
    "motion",
]  # fmt: skip


def checked(folder: Path, mode: str = "tracked", splats: bool = True, **bounds: float) -> tuple[StepReport, Job]:
    """Pack the small package and ask its gates."""
    packing = job(inputs(folder / "inputs", mode), folder / "out", splats=splats, rig=False, usd=False, spz=False)
    pack(packing)
    given = {name: packing.inputs[name] for name in ("driving_video", "subject")}
    asking = replace(
        packing,
        inputs={"package": packing.outputs["package"], **given},
        outputs={"gates": folder / "gates.json", "picture": folder / "picture.png"},
        settings=step_settings(
            "check_asset",
            PREVIEW.model_copy(update={"rasterizer": "reference", "gates": GateSettings(**bounds)}),
        ),
    )
    return run(asking), asking


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[StepReport, Job]:
    return checked(tmp_path_factory.mktemp("checked"))


def said(asking: Job) -> dict[str, dict[str, float]]:
    return {gate["name"]: gate for gate in json.loads(asking.outputs["gates"].read_text())["gates"]}


def test_a_ball_in_front_of_a_full_blue_picture_is_not_accepted(done: tuple[StepReport, Job]) -> None:
    facts, asking = done
    answer = json.loads(asking.outputs["gates"].read_text())
    assert [gate["name"] for gate in answer["gates"]] == NAMES
    assert not answer["accepted"]
    assert "silhouette" in answer["failing"]
    assert facts.notes[0].startswith(f"Not accepted: {', '.join(answer['failing'])}.")
    assert {gate["name"] for gate in answer["gates"] if not gate["passed"]} == set(answer["failing"])


def test_the_picture_has_a_column_per_moment_and_five_rows(done: tuple[StepReport, Job]) -> None:
    shown = read_png(done[1].outputs["picture"])
    assert shown.shape[0] > 5 * 128
    assert shown.shape[1] > 3 * 128
    assert shown.std() > 0.05


def test_the_ports_are_those_of_the_catalog(done: tuple[StepReport, Job]) -> None:
    assert set(done[1].inputs) | {"cutout_gates"} == set(STEPS["check_asset"].inputs)  # of estimated cut-outs only
    assert set(done[1].outputs) == set(STEPS["check_asset"].outputs)


def test_without_stored_splats_the_fitted_motion_is_judged_alike(done: tuple[StepReport, Job], tmp_path: Path) -> None:
    _, bare = checked(tmp_path, splats=False)
    for name, gate in said(bare).items():
        assert gate["value"] == pytest.approx(said(done[1])[name]["value"], abs=2e-3)


def test_a_mesh_per_frame_can_be_judged(tmp_path: Path) -> None:
    _, asking = checked(tmp_path, mode="per_frame", agreement_least=1.0)
    assert said(asking)["flaws"]["value"] == 0
    assert said(asking)["agreement"]["value"] < 0.9  # gems that grow where they are, and splats that slide
    advice = said(asking)["agreement"]["advice"]
    assert advice and "mesh.mode" not in advice


def test_bounds_come_from_the_settings(done: tuple[StepReport, Job], tmp_path: Path) -> None:
    _, lenient = checked(tmp_path, silhouette_least=0, fidelity_least=0)
    changed = {name for name, gate in said(done[1]).items() if gate["passed"] != said(lenient)[name]["passed"]}
    assert changed == {"silhouette", "fidelity"}


def test_equal_packages_give_equal_bytes(done: tuple[StepReport, Job], tmp_path: Path) -> None:
    _, again = checked(tmp_path)
    for name, path in done[1].outputs.items():
        assert path.read_bytes() == again.outputs[name].read_bytes()


def sliding(frames: int) -> Gaussians:
    """The small package's cloud on its way along x, at so many frames."""
    rest = cloud()
    way = torch.zeros(frames, len(rest), 3)
    way[..., 0] = 0.4 * torch.arange(frames)[:, None] / frames
    scales, quats = (part.expand(frames, -1, -1) for part in (rest.log_scales, rest.quats))
    return replace(rest, means=rest.means + way, log_scales=scales, quats=quats)


def seen(asset: LoadedAsset, video: DrivingVideo | None = None) -> GateInputs:
    footage = video or DrivingVideo(torch.zeros(FRAMES, 32, 32, 3), torch.ones(FRAMES, 32, 32, 1), 24.0)
    cutout = torch.cat([footage.frames, footage.alpha], -1)[0]
    return collect_evidence(asset, footage, cutout, get_rasterizer("reference"))


def parts_of(frames: int, surface: Asset4D) -> LoadedAsset:
    return LoadedAsset(partial(states_between, sliding(frames)), surface, frames)


def test_an_asset_at_another_frame_rate_is_seen_at_the_moments_of_the_video() -> None:
    offsets = sliding(6).means[:, :1] - sliding(6).means[:1, :1]
    slow = tracked()
    fast = replace(slow, offsets=offsets.expand(-1, slow.offsets.shape[1], -1).contiguous())
    twice = seen(parts_of(6, fast))
    once = seen(parts_of(3, replace(fast, offsets=fast.offsets[::2])))
    for form in ("splats", "mesh"):
        assert torch.allclose(twice.input_views[form].color, once.input_views[form].color, atol=1e-5)
        assert torch.allclose(twice.side_views[form].alpha, once.side_views[form].alpha, atol=1e-5)


def test_a_mesh_that_was_filmed_is_seen_as_it_was_filmed() -> None:
    asset = tracked()
    camera = OrbitCamera(width=128, height=128)
    color, coverage = render_mesh(asset.mesh, [camera] * FRAMES, asset.offsets)
    found = seen(parts_of(FRAMES, asset), DrivingVideo(color, coverage, 24.0))
    assert torch.allclose(found.input_views["mesh"].color, found.video.color, atol=1e-5)
    gates = {gate.name: gate.values for gate in evaluate_gates(found, GateSettings())}
    assert gates["fidelity"]["mesh"] > 50
    assert gates["silhouette"]["mesh"] == 1
    assert gates["flicker"]["mesh"] == pytest.approx(0, abs=1e-4)
    assert gates["motion"]["mesh"] == pytest.approx(1, abs=1e-4)


def test_dense_small_splats_are_not_widened_by_the_size_of_the_renders() -> None:
    generator = torch.Generator().manual_seed(0)
    means = 0.3 * torch.nn.functional.normalize(torch.randn(20000, 3, generator=generator), dim=1)
    small = replace(
        cloud().subset(torch.zeros(len(means), dtype=torch.long)),
        means=means,
        log_scales=torch.full((len(means), 3), math.log(0.002)),
        opacity_logits=torch.full((len(means),), 4.0),
    )
    camera = OrbitCamera(width=256, height=256)
    drawn = get_rasterizer("cpu")(small, [camera] * FRAMES, torch.zeros(3))
    color = drawn.color / drawn.alpha.clamp_min(1e-4)
    still = replace(small, **{n: getattr(small, n).expand(FRAMES, -1, -1) for n in ("means", "log_scales", "quats")})
    asset = LoadedAsset(partial(states_between, still), tracked(), FRAMES)
    found = collect_evidence(
        asset, DrivingVideo(color, drawn.alpha, 24.0), torch.cat([color, drawn.alpha], -1)[0], get_rasterizer("cpu")
    )
    gates = {gate.name: gate.values for gate in evaluate_gates(found, GateSettings())}
    assert gates["fidelity"]["splats"] > 40
    assert gates["silhouette"]["splats"] > 0.99


@pytest.mark.parametrize(
    ("faces", "flaws"),
    [
        (gem().faces, 0.0),
        (gem().faces.flip(1), 1.0),  # one piece, turned inside out
        (gem().faces[1:], 3 / 19),  # a triangle is gone: three edges on the rim of a hole
    ],
)
def test_flaws_are_counted_per_triangle(faces: Tensor, flaws: float) -> None:
    asset = tracked()
    spoiled = replace(asset, mesh=replace(asset.mesh, faces=faces))
    assert seen(parts_of(FRAMES, spoiled)).flaws == pytest.approx(flaws)


def test_a_face_that_turns_over_in_one_frame_counts_as_a_fold() -> None:
    asset = tracked()
    assert seen(parts_of(FRAMES, asset)).folds == 0
    center = asset.mesh.vertices.mean(0)
    offsets = asset.offsets.clone()
    corner = (asset.mesh.vertices == asset.mesh.vertices[0]).all(1)  # on both sides of a seam
    offsets[-1, corner] += 1.5 * (center - asset.mesh.vertices[0])
    assert seen(parts_of(FRAMES, replace(asset, offsets=offsets))).folds > 0.2


def test_of_a_given_model_what_it_has_at_rest_does_not_count() -> None:
    asset = tracked()
    open_mesh = replace(asset, mesh=replace(asset.mesh, faces=asset.mesh.faces[1:]))
    own = replace(parts_of(FRAMES, open_mesh), own_model=True)
    assert seen(parts_of(FRAMES, open_mesh)).flaws > 0
    assert seen(own).flaws == 0
    faces = torch.cat([asset.mesh.faces, asset.mesh.faces[:1].flip(1)])  # lies on another one: a fold at rest
    folded = replace(asset, mesh=replace(asset.mesh, faces=faces))
    assert seen(parts_of(FRAMES, folded)).folds > 0
    assert seen(replace(parts_of(FRAMES, folded), own_model=True)).folds == 0


def test_a_verdict_is_plain_json() -> None:
    answer = gates_as_json(evaluate_gates(seen(parts_of(FRAMES, tracked())), GateSettings()))
    assert json.loads(json.dumps(answer, allow_nan=False)) == answer
    assert all(round(gate["value"], 4) == gate["value"] for gate in answer["gates"])


def test_a_file_that_is_no_package_is_refused(done: tuple[StepReport, Job], tmp_path: Path) -> None:
    asking = done[1]
    with pytest.raises(BadInput, match=r"asset\.json"):
        run(replace(asking, inputs={**asking.inputs, "package": asking.inputs["driving_video"]}))
