from dataclasses import replace

import pytest
import torch

from benchmarks.ablations import ABLATIONS, IMPERFECT, QUICK, Ablation, Claim, Row, Variant, settings_of, verdict
from benchmarks.fits import Figures, fits_per_frame, moving_fit, score, static_fit, thinned
from benchmarks.objects.specimens import Specimen
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.rasterizer.interface import choose_rasterizer

SIZE, FRAMES = 32, 4
CHANGES = {**QUICK, "static.points": 60, "static.iterations": 40, "motion.iterations": 30, "motion.plane_rate": 0.05}


def ball(frame: int):
    """A few colored balls that slide along x."""
    generator = torch.Generator().manual_seed(4)
    means = (torch.rand(12, 3, generator=generator) - 0.5) * 0.6 + torch.tensor([0.1 * frame, 0.0, 0.0])
    return isotropic(means, torch.full((12,), 0.12), torch.rand(12, 3, generator=generator), 0.95)


@pytest.fixture(scope="module")
def specimen() -> Specimen:
    rasterize = choose_rasterizer("cpu")
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


def test_every_frame_can_be_fitted_for_itself(specimen):
    alone = fits_per_frame(specimen, settings_of(CHANGES, SIZE, FRAMES), 0)
    assert len(alone) == FRAMES
    assert score(specimen, alone).psnr_obj > score(specimen, [alone[0]] * FRAMES).psnr_obj


def test_half_of_the_frames_are_every_second_one(specimen):
    half, stride = thinned(specimen, 2)
    assert stride == 2 and len(half.cutouts) == 2 and half.bank.frames == (0, 1)
    assert torch.equal(half.cutouts[1], specimen.cutouts[2])
    assert torch.equal(half.bank.pictures[:, 1], specimen.bank.pictures[:, 2])
    sparse = replace(specimen, bank=replace(specimen.bank, frames=(0, 3), pictures=specimen.bank.pictures[:, [0, 3]]))
    assert thinned(sparse, 2)[0].bank.frames == (0,)


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
        ([5.0, 6.0, 7.0], [5.5, 5.5, 7.1], Claim("a", "b", "psnr_obj", alike=True), "Reproduced"),
        ([5.0, 6.0, 7.0], [4.0, 5.1, 5.9], Claim("a", "b", "psnr_obj", alike=True), "Not reproduced"),
        ([5.0], [4.0], Claim("a", "b", "psnr_obj"), "Not decided"),
    ],
)
def test_the_verdict_follows_from_pairs_and_their_spread(first, second, claim, outcome):
    ablation = Ablation("a is better", {"a": Variant(), "b": Variant()}, (claim,))
    sentence = verdict(ablation, rows(first, second))
    assert sentence.startswith(f"{outcome}: a is better")
    assert sentence.endswith(f"{claim.figure}.")
