"""Charts of losses."""

import re
from itertools import pairwise
from typing import Any

import pytest

from flows.formatting.curves import svg_picture

FIT = {"loss": [20.0, 4.0, 2.0], "Gaussians": [8000, 8511, 9034]}


def chart(series: dict[str, Any]) -> str:
    return svg_picture({"title": "fit", "x": [0, 100, 200], "series": series, "notes": []})


def test_counts_are_told_but_do_not_stretch_the_axis_of_the_losses() -> None:
    both, alone = chart(FIT), chart({"loss": FIT["loss"]})
    assert re.findall("<polyline[^>]*>", both) == re.findall("<polyline[^>]*>", alone)
    assert "20 to 2;" in both
    assert both.count("Gaussians 8,000 to 9,034") == 2  # for eyes and for screen readers
    assert chart({"Gaussians": FIT["Gaussians"]}) == ""


@pytest.mark.parametrize("dark", [False, True])
def test_every_ink_can_be_read_on_the_background_of_both_color_schemes(dark: bool) -> None:
    drawn = chart({f"loss {i}": [1.0, 2.0] for i in range(8)} | {"Gaussians": FIT["Gaussians"]})
    paper, *inks = re.findall(r"light-dark\((#\w{6}), (#\w{6})\)", drawn)
    assert len(set(inks)) == 9  # of the captions and of eight series
    assert all(contrast(ink[dark], paper[dark]) >= 4.5 for ink in inks)
    assert all(
        f'="{light}" style=' in part
        for part, (light, _) in zip(drawn.split("light-dark")[:-1], [paper, *inks], strict=True)
    )


def contrast(ink: str, paper: str) -> float:
    """Return the contrast ratio of WCAG 2."""
    light, dark = sorted((luminance(ink), luminance(paper)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def luminance(color: str) -> float:
    levels = [int(color[start:end], 16) / 255 for start, end in pairwise((1, 3, 5, 7))]
    linear = [level / 12.92 if level <= 0.04045 else ((level + 0.055) / 1.055) ** 2.4 for level in levels]
    return sum(share * value for share, value in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
