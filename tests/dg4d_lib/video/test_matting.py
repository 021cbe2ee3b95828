import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage import data
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.backdrop import fit_backdrop
from dg4d_lib.video.matting import matte, matte_from_first_alpha
from dg4d_lib.video.saliency import fit_mixture

SIZE = 160


def ragged(shift: float = 0.0, holes: bool = False) -> Tensor:
    """Soft alpha of a rounded star, antialiased by four by four samples; "h w"."""
    rows, columns = np.mgrid[: 4 * SIZE, : 4 * SIZE] / (4 * SIZE) * 2 - 1
    x, y = columns - shift, rows
    inside = np.hypot(x, y) < 0.5 + 0.12 * np.cos(5 * np.arctan2(y, x))
    if holes:
        inside &= np.hypot(x, y) > 0.2
    return torch.from_numpy(inside.reshape(SIZE, 4, SIZE, 4).mean((1, 3))).float()


def texture(seed: int = 0) -> Tensor:
    """Smooth reddish and bluish patches, "h w 3"."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).random((SIZE, SIZE)), 6)
    t = torch.from_numpy((noise - noise.min()) / np.ptp(noise)).float()[..., None]
    return t * torch.tensor([0.8, 0.2, 0.1]) + (1 - t) * torch.tensor([0.15, 0.2, 0.6])


def white() -> Tensor:
    return torch.ones(SIZE, SIZE, 3)


def gradient() -> Tensor:
    """A vignette on a ramp of light greens."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE), torch.linspace(-1, 1, SIZE), indexing="ij")
    light = (0.75 + 0.15 * y - 0.10 * (x**2 + y**2))[..., None]
    return light * torch.tensor([0.85, 1.0, 0.9])


def noisy_grey() -> Tensor:
    noise = torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(1))
    return (0.55 + 0.02 * noise).clamp(0, 1)


def over(alpha: Tensor, front: Tensor, back: Tensor) -> Tensor:
    return alpha[..., None] * front + (1 - alpha[..., None]) * back


def iou(alpha: Tensor, truth: Tensor) -> float:
    return float(torch.minimum(alpha, truth).sum() / torch.maximum(alpha, truth).sum())


@pytest.mark.parametrize("backdrop", [white, gradient, noisy_grey])
def test_a_known_alpha_is_recovered_before_a_plain_backdrop(backdrop):
    truth = ragged()
    result = matte(over(truth, texture(), backdrop())[None])
    assert result.method == "backdrop"
    assert iou(result.frames[0, ..., 3], truth) > 0.97


@pytest.mark.parametrize("backdrop", [white, gradient])
def test_the_backdrop_does_not_shine_through_in_the_color(backdrop):
    truth = ragged()
    frame = matte(over(truth, texture(), backdrop())[None]).frames[0]
    soft = (truth > 0.3) & (truth < 0.9)
    error = (frame[..., :3] - texture()).abs()[soft].mean()
    shining = (over(truth, texture(), backdrop()) - texture()).abs()[soft].mean()
    assert error < 0.25 * shining


def test_a_large_hole_stays_a_hole():
    truth = ragged(holes=True)
    assert iou(matte(over(truth, texture(), gradient())[None]).frames[0, ..., 3], truth) > 0.97


def test_a_highlight_of_the_backdrop_s_color_is_no_hole():
    truth, front = ragged(), texture()
    front[78:80, 78:80] = 1
    assert matte(over(truth, front, white())[None]).frames[0, 76:82, 76:82, 3].min() == 1


def test_a_gap_between_limbs_is_a_hole():
    truth = ragged()
    truth[70:86, 78:84] = 0
    assert matte(over(truth, texture(), white())[None]).frames[0, 72:84, 80:82, 3].max() < 0.1


def test_a_subject_that_leaves_the_frame_below_is_found():
    truth = torch.cat([torch.zeros(60, SIZE), ragged()[:-60]])
    assert truth[-1].max() == 1
    assert iou(matte(over(truth, texture(), gradient())[None]).frames[0, ..., 3], truth) > 0.97


def test_a_soft_shadow_belongs_to_the_backdrop():
    truth = ragged()
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE), torch.linspace(-1, 1, SIZE), indexing="ij")
    shadow = 1 - 0.22 * torch.exp(-(((x / 0.5) ** 2) + ((y - 0.55) / 0.14) ** 2))
    result = matte(over(truth, texture(), 0.9 * shadow[..., None].expand(-1, -1, 3))[None])
    assert iou(result.frames[0, ..., 3], truth) > 0.95


def test_specks_of_dust_are_dropped():
    truth, back = ragged(), white()
    back[10:13, 10:13] = 0.2
    assert matte(over(truth, texture(), back)[None]).frames[0, :20, :20, 3].max() == 0


def test_the_matte_of_a_still_video_stands_still():
    truth = ragged()
    generator = torch.Generator().manual_seed(0)
    clean = over(truth, texture(), gradient())
    frames = torch.stack([clean + 0.008 * torch.randn(clean.shape, generator=generator) for _ in range(6)]).clamp(0, 1)
    alpha = matte(frames).frames[..., 3]
    single = torch.stack([matte(frame[None]).frames[0, ..., 3] for frame in frames])
    flicker, alone = ((a[1:] - a[:-1]).abs().mean() for a in (alpha, single))
    assert flicker < 0.6 * alone
    assert flicker < 0.002


def test_the_matte_follows_a_subject_that_moves():
    truths = [ragged(0.06 * i - 0.15) for i in range(6)]
    fronts = [torch.roll(texture(), round(0.06 * i * SIZE / 2), 1) for i in range(6)]
    frames = torch.stack([over(a, front, gradient()) for a, front in zip(truths, fronts, strict=True)])
    for alpha, truth in zip(matte(frames).frames[..., 3], truths, strict=True):
        assert iou(alpha, truth) > 0.97


def test_a_subject_before_a_busy_background_is_found_by_color():
    truth = ragged()
    noise = np.random.default_rng(3).random((SIZE, SIZE, 3))
    busy = ndimage.gaussian_filter(noise, (3, 3, 0))
    busy = 0.35 + 1.8 * torch.from_numpy(busy - busy.mean()).float() * torch.tensor([0.5, 1.0, 0.6])
    front = torch.tensor([0.85, 0.30, 0.10]) + 0.2 * (texture() - 0.4)
    result = matte(over(truth, front, busy).clamp(0, 1)[None])
    assert result.method == "color models"
    assert iou(result.frames[0, ..., 3], truth) > 0.9


def test_a_cup_on_a_table_is_found_in_a_photograph():
    photo = torch.from_numpy(data.coffee()).float()[None] / 255
    result = matte(photo)
    alpha = result.frames[0, ..., 3]
    assert result.method == "color models"
    assert alpha[60:330, 170:440].mean() > 0.85  # cup and saucer
    assert alpha[:40].mean() < 0.1 and alpha[:, :60].mean() < 0.1  # the table


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_picture_of_one_color_has_no_subject(value):
    with pytest.raises(BadInput, match=r"no subject found.*transparent background"):
        matte(torch.full((1, 64, 64, 3), value))


def test_a_gradient_alone_has_no_subject():
    with pytest.raises(BadInput, match="no subject found"):
        matte(gradient()[None])


def test_noise_has_no_subject():
    noise = torch.rand(1, 96, 96, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(BadInput, match="no subject found"):
        matte(noise)


def test_a_speck_is_no_subject():
    frame = white()
    frame[80:84, 80:84] = 0
    with pytest.raises(BadInput, match="no subject found"):
        matte(frame[None])


def test_equal_pictures_give_equal_mattes():
    frames = over(ragged(), texture(), noisy_grey())[None]
    assert torch.equal(matte(frames).frames, matte(frames).frames)


def test_a_backdrop_is_fitted_past_the_subject_that_touches_the_border():
    lab = np.zeros((1, 80, 80, 3))
    rows, columns = np.mgrid[-1:1:80j, -1:1:80j]
    lab[0, ..., 0] = 60 + 10 * columns - 5 * rows**2
    truth = lab[0].copy()
    lab[0, 40:, 25:55] = (20, 40, -10)
    error = np.abs(fit_backdrop(lab).color(80, 80) - truth).max()
    assert error < 1.0


def test_a_mixture_finds_its_clusters():
    random = np.random.default_rng(0)
    centers = np.array([(20, 0, 0), (50, 40, 0), (70, -30, 20), (90, 0, 60), (40, 0, -50)], float)
    colors = (centers[:, None] + random.normal(0, 2, (5, 300, 3))).reshape(-1, 3)
    means = fit_mixture(colors, np.ones(len(colors))).means
    gaps = np.linalg.norm(means[:, None] - centers, axis=2).min(0)
    assert gaps.max() < 1


def test_what_is_known_of_the_first_frame_steadies_the_rest():
    """Noise on every frame lets single mattes flicker along the outline; the subject stands still."""
    truth = ragged()
    generator = torch.Generator().manual_seed(0)
    still = over(truth, texture(), white())
    frames = torch.stack(
        [(still + 0.015 * torch.randn(still.shape, generator=generator)).clamp(0, 1) for _ in range(6)]
    )
    alone, after = matte(frames).frames[..., 3], matte_from_first_alpha(frames, truth)[..., 3]
    assert torch.equal(after[0], truth)
    flicker = [(alpha[1:] - alpha[:-1]).abs().mean() for alpha in (alone, after)]
    assert flicker[1] < 0.85 * flicker[0]
    assert (after - truth).abs().mean() < 0.85 * (alone - truth).abs().mean()


def test_a_moving_subject_leaves_no_trail_when_the_first_frame_is_known():
    alphas = torch.stack([ragged(0.08 * step) for step in range(4)])
    frames = torch.stack([over(alpha, texture(), white()) for alpha in alphas])
    found = matte_from_first_alpha(frames, alphas[0])[..., 3]
    for alpha, known in zip(found, alphas, strict=True):
        assert iou(alpha, known) > 0.97


def test_a_rocket_before_an_evening_sky_is_a_guess():
    assert matte(torch.from_numpy(data.rocket().copy()).float()[None] / 255).method == "uneven backdrop"


@pytest.mark.parametrize("backdrop", [white, gradient, noisy_grey])
@pytest.mark.parametrize("cut", [0, 60])
def test_plain_backdrops_are_no_guess(backdrop, cut):
    truth = torch.cat([torch.zeros(cut, SIZE), ragged()[: SIZE - cut]])
    assert matte(over(truth, texture(), backdrop())[None]).method == "backdrop"
