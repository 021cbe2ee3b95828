import pytest
import torch
from torch import Tensor

from dg4d_lib.video.contradictions import CONTRADICTORY, WithNegatives, consistent_answers
from dg4d_lib.video.matting import matte
from dg4d_lib.video.segmentation_network import overlap

SIZE = 40
DARK, SURE = 0.2, 0.95


def columns(first: int, last: int, sure: float = SURE) -> Tensor:
    """Probability of a subject in some of the columns, "h w"."""
    answer = torch.full((SIZE, SIZE), 1 - SURE)
    answer[5:35, first:last] = sure
    return answer


class Scripted:
    """Network with one answer to dark pictures and another to their negatives; mirrored pictures have a red corner."""

    def __init__(self, dark: tuple[Tensor, Tensor], negative: tuple[Tensor, Tensor]) -> None:
        self.dark, self.negative, self.asked = dark, negative, []

    def probability(self, picture: Tensor) -> Tensor:
        is_dark, is_mirrored = bool(picture[5, 5, 0] < 0.5), bool(picture[0, 0, 0] != picture[1, 1, 0])
        self.asked.append((is_dark, is_mirrored))
        plain, mirrored = self.dark if is_dark else self.negative
        return mirrored.flip(1) if is_mirrored else plain


def dark_picture() -> Tensor:
    picture = torch.full((SIZE, SIZE, 3), DARK)
    picture[0, -1, 0] = 0.25
    return picture


def ask(network: Scripted) -> tuple:
    return consistent_answers(network, {0: dark_picture()}, (SIZE, SIZE), {})


def test_a_network_that_repeats_its_answer_is_not_asked_about_negatives():
    network = Scripted((columns(10, 30), columns(10, 29)), (columns(0, 5), columns(0, 5)))
    asked, answers = ask(network)
    assert asked is network
    assert network.asked == [(True, False), (True, True)]
    assert answers.agreement == pytest.approx(19 / 20)
    assert torch.equal(answers.plain[0], columns(10, 30))


def test_answers_count_by_the_square_of_their_agreement():
    network = Scripted((columns(10, 30), columns(20, 40)), (columns(10, 30, 0.8), columns(10, 25, 0.8)))
    asked, answers = ask(network)
    share = 0.75**2 / (0.75**2 + (1 / 3) ** 2)
    assert isinstance(asked, WithNegatives)
    assert asked.share == pytest.approx(share)
    odds = (1 - share) * torch.logit(torch.tensor(SURE)) + share * torch.logit(torch.tensor(0.8))
    assert answers.plain[0][20, 15] == pytest.approx(float(odds.sigmoid()))
    assert torch.equal(asked.probability(dark_picture()), answers.plain[0])
    assert overlap(answers.plain[0] > 0.5, columns(10, 30) > 0.5) == 1


def test_negatives_answer_where_the_network_sees_nothing():
    nothing = columns(0, 0)
    asked, answers = ask(Scripted((nothing, nothing), (columns(10, 30), columns(10, 30))))
    assert isinstance(asked, WithNegatives)
    assert asked.share == 1
    assert overlap(answers.plain[0] > 0.5, columns(10, 30) > 0.5) == 1


def test_negatives_without_a_subject_do_not_count():
    network = Scripted((columns(10, 30), columns(20, 40)), (columns(0, 0), columns(0, 0)))
    asked, answers = ask(network)
    assert asked is network
    assert torch.equal(answers.plain[0], columns(10, 30))
    assert answers.agreement == pytest.approx(1 / 3)


def test_negatives_that_take_the_border_along_do_not_count():
    network = Scripted((columns(10, 30), columns(20, 40)), (torch.full((SIZE, SIZE), SURE),) * 2)
    asked, answers = ask(network)
    assert asked is network
    assert torch.equal(answers.plain[0], columns(10, 30))


def test_known_answers_are_not_asked_for_again():
    network = Scripted((columns(10, 30), columns(10, 30)), (columns(0, 5), columns(0, 5)))
    _, answers = consistent_answers(network, {0: dark_picture()}, (SIZE, SIZE), {0: columns(10, 30)})
    assert network.asked == [(True, True)]
    assert answers.agreement == 1 > CONTRADICTORY


def test_a_cutout_follows_the_negatives_of_frames_that_confuse_the_network():
    noise = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    picture = dark_picture() + 0.05 * noise
    picture[0, 0] = picture[1, 1]
    picture[0, -1] = picture[1, -2] + 0.05
    picture[5:35, 10:30, 2] += 0.25 * noise[5:35, 10:30, 2]
    truth = columns(10, 30) > 0.5
    network = Scripted((columns(0, 8), columns(20, 40)), (columns(10, 30), columns(10, 30)))
    frames = matte(torch.stack([picture] * 6), "network", lambda: network).frames
    assert all(overlap(alpha > 0.5, truth) > 0.9 for alpha in frames[..., 3])
