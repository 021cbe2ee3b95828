"""Spans of animation tracks."""

import numpy as np
import pytest

from dg4d_lib.assets.formats.tracks import Span, split_into_spans


@pytest.mark.parametrize(("frames", "longest"), [(1, 1), (5, 1), (5, 2), (6, 3), (300, 128)])
def test_every_frame_is_in_one_span(frames: int, longest: int) -> None:
    spans = split_into_spans(frames, longest)
    assert [frame for span in spans for frame in range(span.first, span.end)] == list(range(frames))
    assert max(span.end - span.first for span in spans) <= longest


def test_a_span_ends_with_the_first_pose_of_the_next() -> None:
    first, second = split_into_spans(4, 2)
    assert (first.keys, first.poses) == ([0, 1, 2], [1, 2])
    assert (second.keys, second.poses) == ([2, 3, 4], [2, 3])


def test_a_whole_animation_starts_and_ends_at_the_base() -> None:
    (span,) = split_into_spans(3, 8)
    assert span.poses == [1, 2]
    assert np.array_equal(span.weights(), [[0, 0], [1, 0], [0, 1], [0, 0]])


def test_a_single_frame_has_a_pose_because_gltf_wants_one() -> None:
    (span,) = split_into_spans(1, 8)
    assert span.poses == [0]


@pytest.mark.parametrize("span", [Span(0, 1, 1), Span(0, 2, 5), Span(2, 4, 5), Span(3, 5, 5), Span(0, 5, 5)])
def test_a_node_is_shown_in_its_span_and_in_the_next_round(span: Span) -> None:
    keys, scales = span.visibility()
    for frame in range(span.total + 1):
        shown = scales[np.searchsorted(keys, frame, side="right") - 1]
        assert (shown == float(span.first <= frame % span.total < span.end)).all()
    assert (keys[0], keys[-1]) == (0, span.total)
