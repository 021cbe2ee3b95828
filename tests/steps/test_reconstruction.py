"""A static stage that starts from what LGM reconstructs, with tiny random weights."""

import json
from pathlib import Path

import pytest
import tiny_imagedream
import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.fitting import static
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.gaussians.ply import read_ply
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import LgmStartSettings, StaticSettings
from steps import fit_gaussians
from steps.artifacts.media import read_png, write_png
from steps.fit_gaussians import fine_tuning_settings
from steps.fitting.reconstruction import NOTE, Reconstruction, reconstruct_subject
from steps.profiles import PREVIEW, step_settings
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import open_weights, weights_in


@pytest.fixture(scope="module")
def lgm(tmp_path_factory: pytest.TempPathFactory) -> LgmStartSettings:
    folder = tmp_path_factory.mktemp("weights")
    views = tiny_imagedream.write_imagedream(folder / "imagedream")
    weights = tiny_imagedream.write_lgm(folder / "lgm")
    return LgmStartSettings(weights=str(weights), views_weights=str(views), precision="fp32", num_inference_steps=2)


def subject() -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
    inside = ((rows - 32) ** 2 + (columns - 32) ** 2 < 20**2).float()
    return torch.stack([inside, columns / 64 * inside, 0 * inside, inside], -1)


@pytest.mark.slow
def test_the_fit_starts_from_the_reconstruction_that_the_seed_decides(
    lgm: LgmStartSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = {"iterations": 0, "views": 0, "start": lgm, "reference_size": 32}
    stage = PREVIEW.static.model_copy(update=changes)
    given = []
    fit = static.fit_gaussians
    monkeypatch.setattr(fit_gaussians, "fit_gaussians", lambda *a, **named: given.append(a) or fit(*a, **named))
    write_png(tmp_path / "subject.png", subject())
    outputs = {name: tmp_path / name for name in ("gaussians", "first_look", "curves", "picture.png")}
    outputs["picture"] = outputs.pop("picture.png")
    settings = step_settings("fit_gaussians", PREVIEW.model_copy(update={"rasterizer": "cpu", "static": stage}))
    inputs = {"subject": tmp_path / "subject.png"}
    facts = fit_gaussians.run(Job(inputs, outputs, settings, 1, lambda *_: None, tmp_path))

    start, used = given[0][0], given[0][4]
    exact = read_png(tmp_path / "subject.png")
    expected = reconstruct_subject(exact, lgm, get_rasterizer("cpu"), torch.Generator().manual_seed(1))
    assert torch.equal(start.means, expected.gaussians.means)
    assert torch.equal(read_ply(outputs["gaussians"]).means, start.means)
    assert used.means_lr == pytest.approx(0.1 * 4 / 3 * stage.means_lr)  # LGM's lengths are 3/4 of ours
    assert NOTE in facts.notes
    assert NOTE in json.loads(outputs["curves"].read_text())["notes"]
    assert {Path(name).parent.name for name in facts.weights} >= {"unet", "vae", "lgm"}
    assert set(facts.licenses) == {lgm.weights, lgm.views_weights}


def test_what_the_prior_brought_stays_in_the_record(lgm: LgmStartSettings) -> None:
    opened = open_weights(lgm.weights), open_weights(lgm.views_weights)
    made = Reconstruction(blob(16, 0.5, torch.Generator()), opened)
    facts = made.add_to(StepReport("cpu", {"prior": "sha256:1"}, {"prior": "free"}, ("a prior",)))
    assert facts.notes == ("a prior", NOTE)
    assert facts.weights["prior"] == "sha256:1"
    assert len(facts.licenses) == 3


def test_means_of_a_reconstruction_move_a_tenth_as_fast_in_lgms_lengths() -> None:
    slow = fine_tuning_settings(StaticSettings())
    assert (slow.means_lr, slow.means_lr_end) == pytest.approx((1e-3 * 4 / 3, 2e-5 * 4 / 3))
    assert slow.color_lr == StaticSettings().color_lr


def test_weights_are_asked_for_only_where_they_are_used() -> None:
    blob, start = StaticSettings(), StaticSettings(start={"kind": "lgm"})
    assert list(weights_in(blob.model_dump())) == []
    assert list(weights_in(start.model_dump())) == ["lgm", "imagedream"]
    assert StaticSettings.model_validate(start.model_dump()) == start


def test_a_start_has_its_own_knobs_and_no_others() -> None:
    for kind, knob in (("lgm", "points"), ("blob", "weights"), ("lgm", "speed")):
        with pytest.raises(ValueError, match=knob):
            StaticSettings.model_validate({"start": {"kind": kind, knob: 3}})


def test_weights_of_something_else_are_refused(lgm: LgmStartSettings) -> None:
    wrong = lgm.model_copy(update={"weights": lgm.views_weights})
    with pytest.raises(BadInput, match="model_fp16_fixrot"):
        reconstruct_subject(subject(), wrong, get_rasterizer("cpu"), torch.Generator())
