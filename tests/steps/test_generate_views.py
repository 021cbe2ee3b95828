"""Views of other sides drawn by tiny random networks, or by stand-ins that draw a known solid."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from media_files import disc
from tiny_qwen_edit import save_tiny_lora, save_tiny_qwen_edit, shrink_inputs

from dg4d_lib.diffusion.view_drawing import DrawnDirection, ViewDrawer
from dg4d_lib.errors import BadInput
from dg4d_lib.visual_hull.judging import Judgment
from dg4d_lib.visual_hull.known import known_view
from steps.artifacts.media import read_png, write_png
from steps.fitting.priors import known_views, read_bank
from steps.generate_views import cut_views, judgment_notes, run, weighted_views
from steps.profiles import PREVIEW, revise, step_settings
from steps.runtime.job import Job, StepReport
from steps.sources.bank_writer import write_bank
from steps.sources.banks import BANK_JSON
from steps.sources.networks import open_network

TINY = {"size": 64, "num_inference_steps": 2, "azimuths_deg": [90, 180], "elevations_deg": [0], "min_weight": 0.0}


def generate(folder: Path, **views: Any) -> StepReport:
    changes = {"views.kind": "image_edit", **{f"views.{name}": value for name, value in {**TINY, **views}.items()}}
    settings = step_settings("generate_views", revise(PREVIEW, changes))
    write_png(folder / "subject.png", torch.from_numpy(disc()) / 255)
    outputs = {"known_views": folder / "known.zip", "picture": folder / "picture.png"}
    return run(Job({"subject": folder / "subject.png"}, outputs, settings, 0, lambda *_: None, folder))


def test_a_model_draws_a_bank_and_the_record_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_inputs(monkeypatch)
    real = ViewDrawer.draw

    def draw(self: ViewDrawer, *given: Any) -> list[torch.Tensor]:
        assert [picture.shape for picture in real(self, *given)] == [(64, 64, 3)] * 2  # noise: its weights are random
        return [drawn(), drawn()]

    monkeypatch.setattr(ViewDrawer, "draw", draw)
    model, lora = save_tiny_qwen_edit(tmp_path / "qwen"), save_tiny_lora(tmp_path / "lora")
    (model / "README.md").write_text("---\nlicense: apache-2.0\n---\n")
    report = generate(tmp_path, weights=str(model), lora_weights=str(lora))
    (tmp_path / "bank").mkdir()
    bank = read_bank(tmp_path / "known.zip", tmp_path / "bank")
    assert bank.frames == (0,) and [camera.azimuth_deg for camera in bank.cameras] == [90, 180]
    assert all(weight > 0.8 for weight in bank.weights)
    assert any("transformer" in name for name in report.weights) and any("lora" in name for name in report.weights)
    assert set(report.licenses) >= {str(model), str(lora)}
    assert f"License found for {model}: apache-2.0: commercial use is allowed." in report.notes
    assert report.notes[0].startswith("2 views of other sides were generated")
    assert read_png(tmp_path / "picture.png").shape == (2 * 96, 3 * 96, 3)


def test_without_a_model_the_knob_is_named(tmp_path: Path) -> None:
    settings = step_settings("generate_views", PREVIEW)
    write_png(tmp_path / "subject.png", torch.from_numpy(disc()) / 255)
    job = Job({"subject": tmp_path / "subject.png"}, {}, settings, 0, lambda *_: None, tmp_path)
    with pytest.raises(BadInput, match=r"--set views\.kind=image_edit"):
        run(job)


def drawn(shift: int = 0) -> torch.Tensor:
    """A red disc on white, as a model draws it."""
    cutout = torch.from_numpy(disc()).float() / 255
    picture = cutout[..., :3] * cutout[..., 3:] + 1 - cutout[..., 3:]
    return picture.roll(shift, 1)


def test_drawn_pictures_are_cut_out_and_empty_ones_left_out_with_a_note() -> None:
    segmenter = open_network("backdrop").segmenter
    directions = [DrawnDirection(90, 0), DrawnDirection(180, 0)]
    views, notes = cut_views([drawn(3), torch.ones(64, 64, 3)], directions, 64, "backdrop", segmenter)
    assert [view.camera.azimuth_deg for view in views] == [90] and views[0].cutout.shape == (64, 64, 4)
    assert len(notes) == 1 and notes[0].startswith("generated view at azimuth 180, elevation 0 shows no subject")
    with pytest.raises(BadInput, match=r"no generated picture shows the subject .*views\.kind=none"):
        cut_views([torch.ones(64, 64, 3)], directions[:1], 64, "backdrop", segmenter)


@pytest.mark.slow
def test_views_that_agree_are_kept_with_their_weights() -> None:
    cutout = torch.from_numpy(disc()).float() / 255
    front = known_view(cutout)
    kept, judgments, notes = weighted_views(front, [known_view(cutout, azimuth) for azimuth in (90, 180, 270)], 0.2)
    assert len(kept) == len(judgments) == 3 and not notes
    assert all(view.weight > 0.8 for view in kept)
    with pytest.raises(BadInput, match="none of the 3 generated views agrees"):
        weighted_views(front, [known_view(cutout, azimuth) for azimuth in (90, 180, 270)], 1.1)


def test_low_weights_are_named_with_their_reason() -> None:
    views = [known_view(torch.zeros(8, 8, 4), name=name) for name in ("one", "two", "three")]
    found = judgment_notes(views, [Judgment(1, 1), Judgment(0.2, 0.9), Judgment(1, 0.3)])
    assert found == (
        "generated views that contradict the others have a low weight: two (0.18: outline); three (0.30: colors)",
    )
    assert not judgment_notes(views[:1], [Judgment(0.9, 0.9)])


def test_weights_survive_the_bank(tmp_path: Path) -> None:
    cutout = torch.from_numpy(disc()).float() / 255
    views = [replace(known_view(cutout, azimuth), weight=weight) for azimuth, weight in ((90, 0.25), (180, 1.0))]
    write_bank(tmp_path / "bank.zip", [views], tmp_path)
    (tmp_path / "out").mkdir()
    bank = read_bank(tmp_path / "bank.zip", tmp_path / "out")
    assert bank.weights == (0.25, 1.0) and [view.weight for view in known_views(bank)] == [0.25, 1.0]
    index = json.loads((tmp_path / "out" / BANK_JSON).read_text())
    assert [view["weight"] for view in index["views"]] == [0.25, 1.0]
