from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dg4d_lib.input_settings import WarpSettings
from dg4d_lib.video.candidate_ranking import WEIGHTS, Candidate, VideoScore, rank_candidates, score_video
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.warp import MOTIONS, Warp, candidate_settings

SIZE, FRAMES = 96, 14


@pytest.fixture(scope="module")
def subject() -> Tensor:
    """A spotted figure with a head, clear of the border."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE), torch.linspace(-1, 1, SIZE), indexing="ij")
    inside = ((x / 0.3) ** 2 + ((y - 0.2) / 0.5) ** 2 < 1) | (x**2 + (y + 0.45) ** 2 < 0.05)
    spots = (torch.sin(14 * x) * torch.sin(11 * y))[..., None] > 0.2
    color = torch.where(spots, torch.tensor([0.85, 0.4, 0.15]), torch.tensor([0.2, 0.45, 0.6]))
    return torch.cat([color, inside[..., None].float()], -1)


@pytest.fixture(scope="module")
def good(subject: Tensor) -> DrivingVideo:
    return Warp(WarpSettings(motion="sway", frames=FRAMES)).generate(subject, torch.Generator())


def frozen(video: DrivingVideo) -> DrivingVideo:
    return DrivingVideo(video.frames[:1].repeat(FRAMES, 1, 1, 1), video.alpha[:1].repeat(FRAMES, 1, 1, 1), 7.0)


def black(video: DrivingVideo) -> DrivingVideo:
    return replace(video, frames=torch.cat([video.frames[:2], 0.02 * video.frames[2:]]))


def empty(video: DrivingVideo) -> DrivingVideo:
    return replace(video, alpha=torch.cat([video.alpha[:2], torch.zeros_like(video.alpha[2:])]))


def flickering(video: DrivingVideo) -> DrivingVideo:
    light = torch.tensor([1.0, 0.7] * (FRAMES // 2))[:, None, None, None]
    return replace(video, frames=video.frames * light)


def cropped(video: DrivingVideo) -> DrivingVideo:
    """It walks out of the frame, to the right."""
    shifted = [
        torch.cat([video.frames[i], video.alpha[i]], -1).roll(4 * i, 1) * (torch.arange(SIZE) >= 4 * i)[:, None]
        for i in range(FRAMES)
    ]
    stack = torch.stack(shifted)
    return DrivingVideo(stack[..., :3], stack[..., 3:], 7.0)


def swelling(video: DrivingVideo) -> DrivingVideo:
    grown = torch.nn.functional.max_pool2d(video.alpha[7:].movedim(-1, 1), 25, 1, 12).movedim(1, -1)
    return replace(video, alpha=torch.cat([video.alpha[:7], grown]))


def another(video: DrivingVideo) -> DrivingVideo:
    return replace(video, frames=1 - video.frames)


BROKEN = {
    frozen: "hardly anything moves",
    black: "frames are dark or empty",
    empty: "frames are dark or empty",
    flickering: "the video flickers",
    cropped: "the subject leaves the frame",
    swelling: "the subject changes its size",
    another: "the subject does not look like the input",
}


@pytest.mark.parametrize(("breaks", "remark"), BROKEN.items(), ids=lambda value: getattr(value, "__name__", ""))
def test_a_good_motion_beats_a_broken_one(breaks, remark: str, good: DrivingVideo, subject: Tensor) -> None:
    fine, broken = score_video(good, subject), score_video(breaks(good), subject)
    assert broken.total < fine.total - 0.1
    assert remark in broken.remarks and not fine.remarks


def test_a_black_silhouette_is_a_subject(good: DrivingVideo, subject: Tensor) -> None:
    shape = torch.cat([torch.zeros_like(subject[..., :3]), subject[..., 3:]], -1)
    assert score_video(replace(good, frames=torch.zeros_like(good.frames)), shape).alive == 1


def test_a_frozen_video_is_worth_nothing(good: DrivingVideo, subject: Tensor) -> None:
    assert score_video(frozen(good), subject).total == 0


@pytest.mark.parametrize("motion", MOTIONS)
def test_every_made_up_motion_is_good(motion, subject: Tensor) -> None:
    found = score_video(Warp(WarpSettings(motion=motion)).generate(subject, torch.Generator()), subject)
    assert found.total > 0.8 and not found.remarks


def test_a_subject_that_the_input_cuts_off_is_not_blamed_for_it(subject: Tensor) -> None:
    bust = torch.cat([subject[SIZE // 3 :], subject[SIZE // 2 : SIZE // 2 + 1].expand(SIZE // 3, -1, -1)])
    video = Warp(WarpSettings(motion="breathe")).generate(bust, torch.Generator())
    assert score_video(video, bust).whole > 0.7


def test_two_frames_are_enough(good: DrivingVideo, subject: Tensor) -> None:
    short = DrivingVideo(good.frames[[0, 3]], good.alpha[[0, 3]], 7.0)
    assert 0.5 < score_video(short, subject).total <= 1


def test_numbers_lie_between_nothing_and_one(good: DrivingVideo, subject: Tensor) -> None:
    assert sum(WEIGHTS.values()) == pytest.approx(1)
    for video in (good, *(breaks(good) for breaks in BROKEN)):
        found = score_video(video, subject)
        for name in ("alive", *WEIGHTS, "total"):
            assert 0 <= getattr(found, name) <= 1


def test_the_best_comes_first_and_equal_ones_by_number(good: DrivingVideo) -> None:
    high, low = VideoScore(1, 1, 1, 1, 1, ()), VideoScore(1, 1, 0, 1, 1, ())
    given = [Candidate(3, "c", good, high), Candidate(1, "a", good, low), Candidate(2, "b", good, high)]
    assert [each.number for each in rank_candidates(given)] == [2, 3, 1]
    assert given[1].row()["total"] == 0.7
    assert low.weakest == "identity"


def test_candidates_begin_with_the_chosen_motion_and_repeat_none_before_all_are_there() -> None:
    settings = WarpSettings(motion="wave", strength=1.0)
    made = [candidate_settings(settings, number) for number in range(1, 9)]
    assert made[0] == settings
    assert {each.motion for each in made[:6]} == set(MOTIONS)
    assert made[6].motion == "wave" and made[6].strength == pytest.approx(0.6)
