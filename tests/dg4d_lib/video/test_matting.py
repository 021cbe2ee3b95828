import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage import data
from skimage.color import rgb2lab
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.backdrop import fit_backdrop
from dg4d_lib.video.border_colors import BorderDistances, color_evidence, missing_parts
from dg4d_lib.video.matting import Matte, _closer, matte, matte_from_first_alpha
from dg4d_lib.video.u2netp import packaged_network

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


class Answering:
    """Network that knows one picture, its mirrored one, and every part of both."""

    def __init__(self, truth: Tensor, picture: Tensor) -> None:
        self.truth, self.picture, self.calls = truth, picture, 0

    def probability(self, picture: Tensor) -> Tensor:
        self.calls += 1
        height, width = picture.shape[:2]
        fits = [
            ((picture - known[top : top + height, left : left + width]).abs().mean(), truth[top:, left:])
            for known, truth in ((self.picture, self.truth), (self.picture.flip(1), self.truth.flip(1)))
            for top in range(known.shape[0] - height + 1)
            for left in range(known.shape[1] - width + 1)
        ]
        return min(fits, key=lambda fit: fit[0])[1][:height, :width]


def by_backdrop(frames: Tensor) -> Matte:
    return matte(frames, "backdrop")


def iou(alpha: Tensor, truth: Tensor) -> float:
    return float(torch.minimum(alpha, truth).sum() / torch.maximum(alpha, truth).sum())


@pytest.mark.parametrize("backdrop", [white, gradient, noisy_grey])
def test_a_known_alpha_is_recovered_before_a_plain_backdrop(backdrop):
    truth = ragged()
    result = by_backdrop(over(truth, texture(), backdrop())[None])
    assert result.method == "backdrop"
    assert iou(result.frames[0, ..., 3], truth) > 0.97


@pytest.mark.parametrize("backdrop", [white, gradient])
def test_the_backdrop_does_not_shine_through_in_the_color(backdrop):
    truth = ragged()
    frame = by_backdrop(over(truth, texture(), backdrop())[None]).frames[0]
    soft = (truth > 0.3) & (truth < 0.9)
    error = (frame[..., :3] - texture()).abs()[soft].mean()
    shining = (over(truth, texture(), backdrop()) - texture()).abs()[soft].mean()
    assert error < 0.25 * shining


def test_a_large_hole_stays_a_hole():
    truth = ragged(holes=True)
    assert iou(by_backdrop(over(truth, texture(), gradient())[None]).frames[0, ..., 3], truth) > 0.97


def test_a_highlight_of_the_backdrop_s_color_is_no_hole():
    truth, front = ragged(), texture()
    front[78:80, 78:80] = 1
    assert by_backdrop(over(truth, front, white())[None]).frames[0, 76:82, 76:82, 3].min() == 1


def test_a_gap_between_limbs_is_a_hole():
    truth = ragged()
    truth[70:86, 78:84] = 0
    assert by_backdrop(over(truth, texture(), white())[None]).frames[0, 72:84, 80:82, 3].max() < 0.1


def test_a_subject_that_leaves_the_frame_below_is_found():
    truth = torch.cat([torch.zeros(60, SIZE), ragged()[:-60]])
    assert truth[-1].max() == 1
    assert iou(by_backdrop(over(truth, texture(), gradient())[None]).frames[0, ..., 3], truth) > 0.97


def test_a_soft_shadow_belongs_to_the_backdrop():
    truth = ragged()
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE), torch.linspace(-1, 1, SIZE), indexing="ij")
    shadow = 1 - 0.22 * torch.exp(-(((x / 0.5) ** 2) + ((y - 0.55) / 0.14) ** 2))
    result = by_backdrop(over(truth, texture(), 0.9 * shadow[..., None].expand(-1, -1, 3))[None])
    assert iou(result.frames[0, ..., 3], truth) > 0.95


def test_specks_of_dust_are_dropped():
    truth, back = ragged(), white()
    back[10:13, 10:13] = 0.2
    assert by_backdrop(over(truth, texture(), back)[None]).frames[0, :20, :20, 3].max() == 0


def test_the_matte_of_a_still_video_stands_still():
    truth = ragged()
    generator = torch.Generator().manual_seed(0)
    clean = over(truth, texture(), gradient())
    frames = torch.stack([clean + 0.008 * torch.randn(clean.shape, generator=generator) for _ in range(6)]).clamp(0, 1)
    alpha = by_backdrop(frames).frames[..., 3]
    single = torch.stack([by_backdrop(frame[None]).frames[0, ..., 3] for frame in frames])
    flicker, alone = ((a[1:] - a[:-1]).abs().mean() for a in (alpha, single))
    assert flicker < 0.6 * alone
    assert flicker < 0.002


def test_the_matte_follows_a_subject_that_moves():
    truths = [ragged(0.06 * i - 0.15) for i in range(6)]
    fronts = [torch.roll(texture(), round(0.06 * i * SIZE / 2), 1) for i in range(6)]
    frames = torch.stack([over(a, front, gradient()) for a, front in zip(truths, fronts, strict=True)])
    for alpha, truth in zip(by_backdrop(frames).frames[..., 3], truths, strict=True):
        assert iou(alpha, truth) > 0.97


def busy() -> Tensor:
    noise = ndimage.gaussian_filter(np.random.default_rng(3).random((SIZE, SIZE, 3)), (3, 3, 0))
    return 0.35 + 1.8 * torch.from_numpy(noise - noise.mean()).float() * torch.tensor([0.5, 1.0, 0.6])


def orange() -> Tensor:
    return torch.tensor([0.85, 0.30, 0.10]) + 0.2 * (texture() - 0.4)


def coarse(truth: Tensor) -> Tensor:
    """A network's answer: a tenth of the resolution, and unsure."""
    small = torch.nn.functional.avg_pool2d(truth[None], 10)
    return 0.1 + 0.8 * torch.nn.functional.interpolate(small[None], truth.shape, mode="bilinear")[0, 0]


def test_a_coarse_answer_of_the_network_is_refined_to_the_edges_of_the_picture():
    truth = ragged()
    picture = over(truth, orange(), busy()).clamp(0, 1)
    result = matte(picture[None], "auto", lambda: Answering(coarse(truth), picture))
    assert result.method == "network" and result.used_network and result.agreement > 0.98
    assert iou(coarse(truth) > 0.5, truth > 0.5) < 0.95
    assert iou(result.frames[0, ..., 3], truth) > 0.96


def test_the_background_does_not_shine_through_in_the_colors_of_a_refined_cutout():
    truth, picture = ragged(), over(ragged(), orange(), busy()).clamp(0, 1)
    frame = matte(picture[None], "network", lambda: Answering(coarse(truth), picture)).frames[0]
    soft = (truth > 0.3) & (truth < 0.9)
    error = (frame[..., :3] - orange()).abs()[soft].mean()
    assert error < 0.6 * (picture - orange()).abs()[soft].mean()


def test_a_still_subject_keeps_its_outline_within_a_hundredth_of_its_pixels():
    """Frames and answers differ by noise, as those of a video do."""
    truth, clean = ragged(), over(ragged(), orange(), busy()).clamp(0, 1)
    generator = torch.Generator().manual_seed(0)

    def noisy(picture: Tensor, sigma: float) -> Tensor:
        return (picture + sigma * torch.randn(picture.shape, generator=generator)).clamp(0, 1)

    class Flickering(Answering):
        def probability(self, picture: Tensor) -> Tensor:
            return noisy(super().probability(picture), 0.2)

    frames = torch.stack([noisy(clean, 0.01) for _ in range(6)])
    masks = matte(frames, "network", lambda: Flickering(coarse(truth), clean)).frames[..., 3] > 0.5
    changed = (masks[1:] != masks[:-1]).sum((1, 2)).max()
    assert changed <= 0.01 * masks[0].sum()
    assert iou(masks[0], truth > 0.5) > 0.95


def test_a_moving_subject_is_not_averaged_over_time():
    truths = [ragged(0.12 * i - 0.2) for i in range(4)]
    pictures = [over(truth, torch.roll(orange(), round(0.06 * i * SIZE), 1), busy()) for i, truth in enumerate(truths)]

    class Following(Answering):
        def probability(self, picture: Tensor) -> Tensor:
            for truth, known in zip(truths, pictures, strict=True):
                if (picture - known).abs().mean() < 1e-6:
                    return coarse(truth)
            return coarse(truths[0])

    found = matte(torch.stack(pictures), "network", lambda: Following(truths[0], pictures[0])).frames[..., 3]
    for alpha, truth in zip(found, truths, strict=True):
        assert iou(alpha, truth) > 0.93


def test_before_a_plain_backdrop_the_network_only_checks():
    truth, picture = ragged(), over(ragged(), texture(), white())
    agreeing = matte(picture[None], "auto", lambda: Answering(coarse(truth), picture))
    assert agreeing.method == "backdrop" and agreeing.agreement > 0.9
    assert iou(agreeing.frames[0, ..., 3], truth) > 0.97


def test_a_backdrop_that_hides_half_of_the_subject_loses_to_the_network():
    """The left half of the subject has the color of the backdrop."""
    truth = ragged()
    front = texture()
    front[:, : SIZE // 2] = 0.995
    picture = over(truth, front, white())
    result = matte(picture[None], "auto", lambda: Answering(coarse(truth), picture))
    assert result.method == "network"
    assert result.frames[0, 60:100, 45:75, 3].mean() > 0.5


def test_a_network_that_takes_the_border_for_the_subject_loses_to_a_plain_backdrop():
    truth, picture = ragged(), over(ragged(), texture(), white())
    result = matte(picture[None], "auto", lambda: Answering(1 - truth, picture))
    assert result.method == "backdrop" and result.agreement < 0.1
    assert iou(result.frames[0, ..., 3], truth) > 0.95


def test_what_the_network_misses_before_an_even_backdrop_is_kept():
    """The network knows the upper half; the backdrop's color tells the rest."""
    truth, picture = ragged(), over(ragged(), texture(), gradient())
    half = coarse(truth)
    half[SIZE // 2 :] = 0.02
    result = matte(picture[None], "auto", lambda: Answering(half, picture))
    assert result.agreement < 0.7
    assert iou(result.frames[0, ..., 3], truth) > 0.95


def test_a_pale_drawing_keeps_the_body_that_the_network_does_not_see():
    rows, columns = np.mgrid[:SIZE, :SIZE]
    head, body = (np.hypot(rows - row, columns - 80) - radius for row, radius in ((45, 25), (105, 38)))
    truth = torch.from_numpy((head < 0) | (body < 0)).float()
    line = torch.from_numpy((abs(head + 2) < 2) | (abs(body + 2) < 2)).float()
    pale = over(truth, torch.full((SIZE, SIZE, 3), 0.85), white())
    picture = over(line, torch.full((SIZE, SIZE, 3), 0.2), pale)
    found = coarse(torch.from_numpy(head < 0).float())
    result = matte(picture[None], "auto", lambda: Answering(found, picture))
    assert iou(result.frames[0, ..., 3], truth) > 0.95


def test_spots_of_a_backdrop_that_is_even_along_the_border_are_not_kept():
    truth, back = ragged(), gradient()
    for row, column in ((14, 20), (14, 120), (136, 20), (136, 130)):
        back[row : row + 12, column : column + 12] = torch.tensor([0.2, 0.3, 0.1])
    picture = over(truth, texture(), back)
    half = coarse(truth)
    half[SIZE // 2 :] = 0.02
    alpha = matte(picture[None], "auto", lambda: Answering(half, picture)).frames[0, ..., 3]
    assert alpha[14:26, 20:32].max() < 0.1 and alpha[136:148, 130:142].max() < 0.1


def test_a_second_look_from_close_finds_what_is_small():
    """Answers have 32 cells on a side, whatever the picture shows."""
    truth = torch.zeros(SIZE, SIZE)
    small = ragged()[::3, ::3]
    truth[60 : 60 + len(small), 20 : 20 + small.shape[1]] = small
    picture = over(truth, orange(), busy()).clamp(0, 1)

    class Blocks(Answering):
        def probability(self, picture: Tensor) -> Tensor:
            known = super().probability(picture)[None, None]
            cells = torch.nn.functional.interpolate(known, (32, 32), mode="area")
            return torch.nn.functional.interpolate(cells, known.shape[2:], mode="bilinear")[0, 0].clamp(0, 1)

    network = Blocks(truth, picture)
    far, closer = network.probability(picture), _closer(picture, network.probability(picture), network)
    errors = [float((answer - truth).abs().mean()) for answer in (far, closer)]
    assert errors[1] < 0.6 * errors[0]


def test_a_thing_of_the_subject_s_colors_that_the_network_does_not_see_is_dropped():
    truth, front = ragged(), orange()
    picture = over(truth, front, busy()).clamp(0, 1)
    picture[4:20, 140:156] = front[4:20, 140:156]
    alpha = matte(picture[None], "network", lambda: Answering(coarse(truth), picture)).frames[0, ..., 3]
    assert alpha[4:20, 140:156].max() < 0.1
    assert iou(alpha, truth) > 0.95


def test_no_network_is_loaded_if_the_backdrop_is_asked_for():
    def refuse() -> Answering:
        raise AssertionError("loaded")

    assert matte(over(ragged(), texture(), white())[None], "backdrop", refuse).used_network is False


def test_the_cat_of_a_photograph_is_cut_out_whole():
    """The photograph that color models alone tore to two eyes and a nose."""
    photo = torch.from_numpy(data.chelsea()[::2, ::2].copy()).float()[None] / 255
    result = matte(photo)
    alpha = result.frames[0, ..., 3]
    assert result.method == "network" and result.used_network
    assert alpha[40:120, 60:150].mean() > 0.97  # face
    assert alpha[:30, -30:].mean() < 0.02  # upper right corner, beside the ear


def test_noise_has_no_subject_for_the_network():
    noise = torch.rand(1, 96, 96, 3, generator=torch.Generator().manual_seed(0))
    with pytest.raises(BadInput, match=r"no subject found.*--mask"):
        matte(noise, "network", packaged_network)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_a_picture_of_one_color_has_no_subject(value):
    with pytest.raises(BadInput, match=r"no subject found.*transparent background"):
        by_backdrop(torch.full((1, 64, 64, 3), value))


def test_a_gradient_alone_has_no_subject():
    with pytest.raises(BadInput, match="no subject found"):
        by_backdrop(gradient()[None])


def test_a_speck_is_no_subject():
    frame = white()
    frame[80:84, 80:84] = 0
    with pytest.raises(BadInput, match="no subject found"):
        by_backdrop(frame[None])


def test_equal_pictures_give_equal_mattes():
    frames = over(ragged(), texture(), noisy_grey())[None]
    assert torch.equal(by_backdrop(frames).frames, by_backdrop(frames).frames)


def test_a_backdrop_is_fitted_past_the_subject_that_touches_the_border():
    lab = np.zeros((1, 80, 80, 3))
    rows, columns = np.mgrid[-1:1:80j, -1:1:80j]
    lab[0, ..., 0] = 60 + 10 * columns - 5 * rows**2
    truth = lab[0].copy()
    lab[0, 40:, 25:55] = (20, 40, -10)
    error = np.abs(fit_backdrop(lab).color(80, 80) - truth).max()
    assert error < 1.0


def test_what_is_known_of_the_first_frame_steadies_the_rest():
    """Noise on every frame lets single mattes flicker along the outline; the subject stands still."""
    truth = ragged()
    generator = torch.Generator().manual_seed(0)
    still = over(truth, texture(), white())
    frames = torch.stack(
        [(still + 0.015 * torch.randn(still.shape, generator=generator)).clamp(0, 1) for _ in range(6)]
    )
    alone = torch.cat([by_backdrop(frame[None]).frames[..., 3] for frame in frames])
    after = matte_from_first_alpha(frames, truth)[..., 3]
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


@pytest.mark.parametrize("backdrop", [white, gradient, noisy_grey])
@pytest.mark.parametrize("cut", [0, 60])
def test_plain_backdrops_are_no_guess(backdrop, cut):
    truth = torch.cat([torch.zeros(cut, SIZE), ragged()[: SIZE - cut]])
    assert by_backdrop(over(truth, texture(), backdrop())[None]).method == "backdrop"


def test_a_highlight_of_the_background_s_color_inside_the_subject_is_no_hole():
    truth, front = ragged(), orange()
    picture = over(truth, front, busy()).clamp(0, 1)
    picture[70:90, 70:90] = busy()[10:30, 10:30].clamp(0, 1)
    result = matte(picture[None], "network", lambda: Answering(coarse(truth), picture))
    assert result.frames[0, 65:95, 65:95, 3].min() == 1


def checks() -> Tensor:
    cells = torch.arange(SIZE) // 20
    dark = (cells[:, None] + cells[None]) % 2 == 0
    return torch.where(dark[..., None], torch.tensor([0.45, 0.45, 0.5]), torch.tensor([0.85, 0.8, 0.7]))


def dotted() -> Tensor:
    places = torch.arange(SIZE) % 20 - 10
    dots = torch.hypot(*torch.meshgrid(places.float(), places.float(), indexing="ij")) < 5
    dots[:10] = dots[-10:] = dots[:, :10] = dots[:, -10:] = False
    return torch.where(dots[..., None], torch.tensor([0.75, 0.4, 0.4]), torch.tensor([0.93, 0.9, 0.86]))


@pytest.mark.parametrize(
    ("answer", "agrees"), [("upper half", True), ("upper half of a striped one", False), ("nothing", False)]
)
def test_what_the_network_misses_before_a_pattern_is_found_by_its_colors(answer, agrees):
    """Colors confirm what the network found, unless part of that has colors of the backdrop, or it found nothing."""
    truth, front = ragged(), torch.tensor([0.1, 0.6, 0.2]).expand(SIZE, SIZE, 3).clone()
    if "striped" in answer:
        front[50:80] = torch.tensor([0.45, 0.45, 0.5])
    picture = over(truth, front, checks())
    known = torch.zeros(SIZE, SIZE) if answer == "nothing" else coarse(truth)
    known[SIZE // 2 :] = 0
    result = matte(picture[None], "auto", lambda: Answering(known, picture))
    assert result.agreement > 0.9 if agrees else result.agreement < 0.7
    assert iou(result.frames[0, ..., 3], truth) > 0.95


def test_things_beside_the_subject_in_colors_of_the_border_or_with_soft_outlines_are_not_added():
    truth = ragged()
    back = checks()
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE), torch.linspace(-1, 1, SIZE), indexing="ij")
    glow = torch.exp(-((x / 0.3).square() + ((y - 0.45) / 0.3).square()))[..., None]
    back = back + 0.5 * glow * (torch.tensor([0.2, 0.9, 0.9]) - back)
    picture = over(truth, torch.tensor([0.7, 0.1, 0.5]).expand(SIZE, SIZE, 3), back)
    result = matte(picture[None], "network", lambda: Answering(coarse(truth), picture))
    assert iou(result.frames[0, ..., 3], truth) > 0.93


def test_colors_of_the_border_speak_against_a_subject_and_others_for_it():
    truth = ragged() > 0.5
    lab = rgb2lab(over(truth.float(), torch.tensor([0.1, 0.6, 0.2]).expand(SIZE, SIZE, 3), checks()).numpy())
    known = torch.where(truth, 0.9, 0.01)
    known[SIZE // 2 :] = 0.4  # the network is unsure below
    (evidence,) = color_evidence(BorderDistances.of(lab[None]), known[None].double().numpy())
    below, deep = evidence[SIZE // 2 + 3 :], ndimage.binary_erosion(truth.numpy(), iterations=3)[SIZE // 2 + 3 :]
    assert below[deep] == pytest.approx(np.log(0.9 / 0.1))  # the bounds of both shares
    away = ~ndimage.binary_dilation(truth.numpy(), iterations=3)[SIZE // 2 + 3 :]
    assert below[away] == pytest.approx(0.5 * np.log(0.1 / 0.9))


@pytest.mark.parametrize("case", ["a subject in the colors of its backdrop", "nothing is sure"])
def test_colors_that_tell_nothing_are_no_evidence(case):
    truth = ragged() > 0.5
    front = checks().flip(0) if "subject" in case else torch.tensor([0.1, 0.6, 0.2]).expand(SIZE, SIZE, 3)
    lab = rgb2lab(over(truth.float(), front, checks()).numpy())
    known = torch.where(truth, 0.9, 0.01) if "subject" in case else torch.full((SIZE, SIZE), 0.4)
    assert not color_evidence(BorderDistances.of(lab[None]), known[None].double().numpy()).any()


def test_frames_that_the_subject_has_left_stay_empty():
    """A green thing in the last frame is no part of a subject that the network finds in the first one alone."""
    truth, green = ragged(), torch.tensor([0.1, 0.6, 0.2]).expand(SIZE, SIZE, 3)
    first = over(truth, green, checks())
    last = over(ragged()[::2, ::2].repeat(2, 2), green, checks())
    lab = np.stack([rgb2lab(frame.numpy()) for frame in (first, last)])
    added = missing_parts(lab, BorderDistances.of(lab), np.stack([truth.numpy() > 0.5, np.zeros((SIZE, SIZE), bool)]))
    assert not added[1].any()
    assert missing_parts(lab[1:], BorderDistances.of(lab[1:]), np.zeros((1, SIZE, SIZE), bool)).mean() > 0.1


def test_dots_that_touch_the_subject_belong_to_a_dotted_backdrop():
    truth = ragged()
    picture = over(truth, torch.tensor([0.1, 0.3, 0.2]).expand(SIZE, SIZE, 3), dotted())
    assert iou(by_backdrop(picture[None]).frames[0, ..., 3], truth) > 0.97


def test_a_subject_in_the_color_of_the_spots_around_it_is_kept():
    truth = ragged()
    picture = over(truth, torch.tensor([0.75, 0.4, 0.4]).expand(SIZE, SIZE, 3), dotted())
    assert iou(by_backdrop(picture[None]).frames[0, ..., 3], truth) > 0.8
