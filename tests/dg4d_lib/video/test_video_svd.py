import pytest
import torch
from tiny_svd import save_tiny_svd
from torch import Tensor

from dg4d_lib.diffusion.video_model import VideoCondition, VideoModel
from dg4d_lib.images import over_white
from dg4d_lib.input_settings import SvdSettings
from dg4d_lib.settings import VideoModelSettings
from dg4d_lib.video import matting
from dg4d_lib.video.canvas import cut_out
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.svd import StableVideo

pytestmark = pytest.mark.usefixtures("quick_segmentation")

SIZE, FRAMES = 48, 4
SETTINGS = SvdSettings(frames=FRAMES, height=64, width=64, model=VideoModelSettings(num_inference_steps=2))


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> VideoModel:
    folder = save_tiny_svd(tmp_path_factory.mktemp("svd"))
    return VideoModel.load(folder, SETTINGS.model, torch.device("cpu"))


@pytest.fixture(scope="module")
def subject() -> Tensor:
    return disc(0)


def disc(shift: int) -> Tensor:
    """An orange disc that moved to the right by some pixels."""
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    alpha = (14.5 - torch.hypot(x - SIZE / 2 - shift, y - SIZE / 2)).clamp(0, 1)
    return torch.cat([torch.tensor([0.9, 0.5, 0.1]).expand(SIZE, SIZE, 3), alpha[..., None]], -1)


class Known(VideoModel):
    """A model that shows the disc move over the canvas that it was given."""

    def encode_condition(self, picture: Tensor, generators: object) -> VideoCondition:
        self.canvas = picture
        return super().encode_condition(picture, generators)

    def denoise(self, latents: Tensor, condition: VideoCondition, sigmas: object) -> Tensor:
        return latents

    def decode(self, latents: Tensor) -> Tensor:
        frames = self.canvas.expand(len(latents), -1, -1, -1)
        return torch.stack([frame.roll(2 * i, 1) for i, frame in enumerate(frames)])


def rng(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def generate(maker: StableVideo, subject: Tensor, seed: int) -> DrivingVideo:
    return maker.generate_all(subject, [rng(seed)])[0]


def test_the_video_has_the_wanted_length_and_size_and_follows_the_generator(model: VideoModel, subject: Tensor) -> None:
    maker = StableVideo(SETTINGS, model)
    video = generate(maker, subject, 3)
    assert video.frames.shape == (FRAMES, SIZE, SIZE, 3) and video.fps == 7
    assert torch.equal(video.frames, generate(maker, subject, 3).frames)
    assert not torch.equal(video.frames, generate(maker, subject, 4).frames)


@pytest.mark.slow
def test_several_candidates_are_those_of_their_seeds(model: VideoModel, subject: Tensor) -> None:
    maker = StableVideo(SETTINGS, model)
    both = maker.generate_all(subject, [rng(3), rng(4)])
    alone = generate(maker, subject, 4)
    torch.testing.assert_close(both[1].frames, alone.frames, rtol=0, atol=3e-4)  # sums of float32 in another order


def test_another_number_of_frames_than_trained_is_said(model: VideoModel) -> None:
    assert not StableVideo(SETTINGS, model).notes
    longer = StableVideo(SETTINGS.model_copy(update={"frames": 6}), model)
    assert "trained on 4 frames and generated 6" in longer.notes[0]


@pytest.mark.parametrize(("height", "width"), [(64, 64), (64, 128), (128, 64)])
def test_the_subject_stands_in_the_middle_of_a_white_canvas_and_comes_back_cut_out(
    model: VideoModel, subject: Tensor, height: int, width: int
) -> None:
    settings = SETTINGS.model_copy(update={"height": height, "width": width})
    known = Known(model.unet, model.vae, model.image_encoder, settings.model, model.device)
    video = generate(StableVideo(settings, known), subject, 0)
    side = min(height, width)
    assert known.canvas.shape == (height, width, 3)
    assert (known.canvas[0] > 0.99).all() and (known.canvas[:, 0] > 0.99).all()
    orange = known.canvas[height // 2, width // 2]
    torch.testing.assert_close(orange, torch.tensor([0.9, 0.5, 0.1]), atol=0.02, rtol=0)
    assert torch.equal(video.alpha[0], subject[..., 3:])
    for frame in (1, 3):
        truth = disc(round(2 * frame * SIZE / side))[..., 3:]
        shown = torch.minimum(video.alpha[frame], truth).sum() / torch.maximum(video.alpha[frame], truth).sum()
        assert shown > 0.9


def test_where_nothing_can_be_told_the_outline_stays_and_it_is_said(model: VideoModel, subject: Tensor) -> None:
    class Gray(Known):
        def decode(self, latents: Tensor) -> Tensor:
            return torch.full((len(latents), 64, 64, 3), 0.5)

    maker = StableVideo(SETTINGS, Gray(model.unet, model.vae, model.image_encoder, SETTINGS.model, model.device))
    video = generate(maker, subject, 0)
    assert torch.equal(video.alpha, subject[..., 3:].expand(FRAMES, -1, -1, -1))
    assert any("keeps the outline" in note for note in maker.notes)


@pytest.mark.parametrize(("shift", "matted"), [(0, True), (2, True), (0, False)])
def test_cut_outs_over_white_are_the_generated_frames(
    shift: int, matted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colors along the outline must be free of white, or they are mixed with it twice."""
    if not matted:
        monkeypatch.setattr(matting, "MIN_AREA", 1.0)  # no subject is large enough
    discs = torch.stack([disc(shift * i) for i in range(FRAMES)])
    frames = over_white(discs)
    video, notes = cut_out(frames, discs[0], fps=7.0)
    assert bool(notes) != matted
    soft = (discs[..., 3] > 0.02) & (discs[..., 3] < 0.98)
    error = (video.over(torch.ones(3)) - frames).abs().mean(-1)
    assert all(error[i][soft[i]].mean() < 0.01 for i in range(FRAMES))
