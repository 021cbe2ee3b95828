import pytest
import torch

from benchmarks.ablations import Variant
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.diffusion.video_model import karras_sigmas
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import locate_texels
from dg4d_lib.refiner_settings import TextureSettings
from dg4d_lib.texture.refine import RefinedTextures
from experiments import oracle_refinement
from experiments.oracle_refinement import FLICKER, NOISE, VARIANTS, Model, Oracle, refine_model, score_model

FRAMES, SIZE = 3, 64
FRONT = [OrbitCamera(width=SIZE, height=SIZE)] * FRAMES


@pytest.fixture(scope="module")
def board() -> Model:
    """A board that stands still, striped; to refine: gray."""
    corners = torch.tensor([[-0.6, 0.6, 0.0], [0.6, 0.6, 0.0], [0.6, -0.6, 0.0], [-0.6, -0.6, 0.0]])
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = torch.tensor([[0, 3, 2], [0, 2, 1]], dtype=torch.int32)
    stripes = torch.tensor([[0.3, 0.4, 0.5], [0.7, 0.6, 0.5]]).repeat_interleave(4, 0).repeat(4, 1)
    mesh = TexturedMesh(corners, faces, uvs, stripes[None].expand(32, 32, 3).contiguous())
    texels = locate_texels(corners, torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3), faces, uvs, 32)
    return Model(mesh, torch.zeros(FRAMES, 4, 3), texels, torch.full((32, 32, 3), 0.5))


def answer(model: Model, video: torch.Tensor, sigma: float, whole_videos: bool) -> torch.Tensor:
    return Oracle(model, lambda progress: sigma, whole_videos).refine(
        video, FRONT, 0.0, torch.Generator().manual_seed(0)
    )


def test_without_noise_the_oracle_changes_nothing_and_with_all_of_it_the_answer_is_what_it_believes(
    board: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(oracle_refinement, "STAINS", 0.0)
    video = torch.full((FRAMES, SIZE, SIZE, 3), 0.4)
    torch.testing.assert_close(answer(board, video, 0.0, whole_videos=False), video)
    monkeypatch.setattr(oracle_refinement, "UNIT", 0.0)
    truth = board.draw([board.mesh.texture] * FRAMES, FRONT)[..., :3]
    torch.testing.assert_close(answer(board, video, 1e6, whole_videos=True), truth, atol=1e-5, rtol=0)


def test_whole_videos_agree_with_themselves_and_single_pictures_do_not(
    board: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(oracle_refinement, "UNIT", 0.0)
    video = board.draw([board.blurred] * FRAMES, FRONT)[..., :3]
    whole, single = (answer(board, video, 1.273, whole_videos=together) for together in (True, False))
    assert whole.diff(dim=0).abs().max() == 0
    changes = single.diff(dim=0)[:, 16:48, 16:48]
    keep = 0.5 / (0.5**2 + 1.273**2) ** 0.5
    assert changes.std().item() == pytest.approx((1 - keep) * 0.1 * 2**0.5, rel=0.3)


def test_stains_have_their_spread_and_lie_on_the_surface(board: Model) -> None:
    generator = torch.Generator().manual_seed(0)
    off = torch.stack([board.stained(generator) - board.mesh.texture for _ in range(50)])
    assert off.std().item() == pytest.approx(oracle_refinement.STAINS, rel=0.1)
    assert off.diff(dim=1).std() < off.std() / 2  # smooth


def test_the_loop_restores_what_the_oracle_knows(board: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(oracle_refinement, "STAINS", 0.0)
    settings = TextureSettings(size=SIZE, iterations=60, azimuth_step_deg=0.0)
    variant = VARIANTS["video to video, 0.4"]
    before, after = (
        score_model(board, made, SIZE)
        for made in (RefinedTextures(board.blurred), refine_model(board, variant, settings, seed=0))
    )
    assert refine_model(board, Variant(), settings, seed=0).texture is board.blurred
    assert after.psnr_obj > before.psnr_obj + 10
    assert before.flicker == 0 and after.flicker == 0  # one texture for all frames


def test_the_noise_of_a_variant_falls_over_the_iterations(board: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[float]()

    def refine(self: Oracle, video: torch.Tensor, cameras: object, progress: float, generator: object) -> torch.Tensor:
        seen.append(self.sigma_at(progress))
        return video

    monkeypatch.setattr(Oracle, "refine", refine)
    settings = TextureSettings(size=SIZE, iterations=3)
    refine_model(board, VARIANTS["video to video, 0.3 to 0.05"], settings, seed=0)
    levels = karras_sigmas(25)
    assert seen == [levels[17], levels[20], levels[23]]


def test_claims_are_about_variants_that_there_are() -> None:
    named = {name for claim in (*FLICKER.claims, *NOISE.claims) for name in (claim.better, claim.other)}
    assert named <= set(VARIANTS)
