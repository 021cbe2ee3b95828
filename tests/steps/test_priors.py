from pathlib import Path

import pytest
import tiny_weights
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.guidance.interface import View
from dg4d_lib.settings import GeometricPriorSettings, MotionSettings, StaticSettings, Zero123PriorSettings
from steps.priors import ChosenPrior, make_prior

CUTOUTS = [torch.rand(64, 64, 4, generator=torch.Generator().manual_seed(seed)) for seed in (0, 1)]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_weights.write_zero123(tmp_path_factory.mktemp("weights") / "mine")


def chosen(model: Path, stage: StaticSettings | MotionSettings, cutouts: list[torch.Tensor]) -> ChosenPrior:
    return make_prior(Zero123PriorSettings(weights=str(model)), cutouts, stage, None, model)


def judged(choice: ChosenPrior, frame: int = 0) -> torch.Tensor:
    images = torch.rand(1, 64, 64, 3, generator=torch.Generator().manual_seed(2))
    view = View(OrbitCamera(10, 40), frame)
    return choice.prior.loss(images, images[..., :1], [view], 0.5, torch.Generator().manual_seed(3))


def test_zero123_comes_from_a_folder_with_its_digests_and_license(model: Path) -> None:
    choice = chosen(model, StaticSettings(), CUTOUTS[:1])
    facts = choice.facts("cpu rasterizer")
    assert facts.backend == "cpu rasterizer"
    names = {name.split("/mine/")[1] if "/mine/" in name else name for name in facts.weights}
    assert {"unet/diffusion_pytorch_model.safetensors", "vae/config.json"} <= names
    assert all(digest.startswith("sha256:") and len(digest) == 71 for digest in facts.weights.values())
    assert len(facts.licenses) == 1 and "Zero-1-to-3" in facts.notes[0]


def test_every_stage_has_its_own_timesteps(model: Path) -> None:
    static = judged(chosen(model, StaticSettings(), CUTOUTS[:1]))
    assert torch.equal(static, judged(chosen(model, StaticSettings(iterations=7), CUTOUTS[:1])))
    assert static != judged(chosen(model, MotionSettings(), CUTOUTS[:1]))
    assert static != judged(chosen(model, StaticSettings(noise_end=0.3), CUTOUTS[:1]))
    assert static != judged(chosen(model, StaticSettings(noise_draw="uniform"), CUTOUTS[:1]))


def test_pictures_are_seen_over_white(model: Path) -> None:
    color, alpha = CUTOUTS[0][..., :3], CUTOUTS[0][..., 3:]
    opaque = torch.cat([color * alpha + 1 - alpha, torch.ones_like(alpha)], -1)
    found, expected = (judged(chosen(model, StaticSettings(), [cutout])) for cutout in (CUTOUTS[0], opaque))
    assert torch.equal(found, expected)


def test_frames_are_told_apart(model: Path) -> None:
    choice = chosen(model, MotionSettings(), CUTOUTS)
    assert judged(choice, 0) != judged(choice, 1)


def test_memory_that_ran_out_is_in_the_notes(model: Path) -> None:
    choice = chosen(model, StaticSettings(), CUTOUTS[:1])
    assert len(choice.facts("cpu").notes) == 1

    def tight(piece: slice) -> None:
        if piece.stop - piece.start > 3:
            raise torch.OutOfMemoryError("simulated")

    assert choice.batches is not None
    choice.batches.run(tight, 16)
    assert "memory ran out with 16 views" in choice.facts("cpu").notes[1]


@pytest.mark.parametrize(
    ("weights", "variant"), [("stable-zero123", "xl"), ("ashawkey/zero123-xl-diffusers", "stable")]
)
def test_known_weights_with_the_wrong_cameras_are_refused(weights: str, variant: str) -> None:
    settings = Zero123PriorSettings.model_validate({"weights": weights, "variant": variant})
    with pytest.raises(BadInput, match=r"set prior\.variant="):
        make_prior(settings, CUTOUTS[:1], StaticSettings(), None, Path())


def test_weights_that_are_not_here_are_named_with_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path))
    with pytest.raises(BackendUnavailable, match="dg4d weights pull zero123-xl"):
        make_prior(Zero123PriorSettings(), CUTOUTS[:1], StaticSettings(), None, tmp_path)


def test_the_prior_without_weights_has_none_in_its_facts(tmp_path: Path) -> None:
    settings = GeometricPriorSettings(size=32)
    facts = make_prior(settings, CUTOUTS[:1], StaticSettings(), None, tmp_path).facts("cpu")
    assert facts.weights == {} and facts.licenses == {} and len(facts.notes) == 1
