"""Loss curves as drawings, for the report and the Prefect UI."""

import html
import math
from collections.abc import Iterator
from typing import Any

WIDTH, HEIGHT = 420, 150  # pixels
LINE = 14  # pixels, of the text below a drawing that stands alone
INKS = ("#2563eb", "#dc2626", "#059669", "#d97706", "#7c3aed", "#0891b2", "#be185d", "#4d7c0f")


def drawing(curves: dict[str, Any]) -> str:
    """Losses over iterations as the elements of an SVG of `WIDTH` x `HEIGHT`; empty if there is nothing to draw.

    The scale is logarithmic where all values are positive and differ much.

    Args:
        curves: what a `curves` artifact holds.
    """
    values = _values(curves)
    if not values:
        return ""
    scale = math.log10 if is_logarithmic(curves) else float
    low, high = scale(min(values)), scale(max(values))
    first, last = curves["x"][0], curves["x"][-1]
    across, down = WIDTH / ((last - first) or 1), HEIGHT / ((high - low) or 1)
    lines = []
    for ink, _, points in inked(curves):
        places = " ".join(
            f"{across * (x - first):.1f},{down * (high - scale(y)):.1f}"
            for x, y in zip(curves["x"], points, strict=False)
            if math.isfinite(y)
        )
        lines.append(f'<polyline points="{places}" fill="none" stroke-width="1.5" stroke="{ink}"/>')
    return "".join(lines)


def picture(curves: dict[str, Any]) -> str:
    """An SVG file: the drawing, with its range and its last values in words; empty if there is nothing to draw."""
    drawn = drawing(curves)
    if not drawn:
        return ""
    words = [("#666", summary(curves)), *((ink, f"{name} {amount(points[-1])}") for ink, name, points in inked(curves))]
    below = "".join(
        f'<text x="0" y="{HEIGHT + LINE * number}" fill="{ink}">{html.escape(text)}</text>'
        for number, (ink, text) in enumerate(words, 1)
    )
    width, height = WIDTH + 8, HEIGHT + LINE * len(words) + 12
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="-4 -4 {width} {height}" '
        f'font-family="sans-serif" font-size="11"><rect x="-4" y="-4" width="{width}" height="{height}" fill="#fff"/>'
        f"{drawn}{below}</svg>"
    )


def summary(curves: dict[str, Any]) -> str:
    """The range of what is drawn, in words."""
    values = _values(curves)
    scale = ", logarithmic" if is_logarithmic(curves) else ""
    return f"{amount(max(values))} to {amount(min(values))}{scale}; iterations {curves['x'][0]} to {curves['x'][-1]}"


def amount(value: float) -> str:
    """A value as people read it: four digits; counts, which are whole, with all of theirs."""
    return f"{value:,.0f}" if abs(value) >= 1000 and float(value).is_integer() else f"{value:.4g}"


def inked(curves: dict[str, Any]) -> Iterator[tuple[str, str, list[float]]]:
    """Color, name and values of every series that is drawn."""
    series = {name: values for name, values in curves["series"].items() if len(values) > 1}
    for number, (name, values) in enumerate(series.items()):
        yield INKS[number % len(INKS)], name, values


def is_logarithmic(curves: dict[str, Any]) -> bool:
    """Whether the drawing has a logarithmic scale."""
    values = _values(curves)
    return min(values) > 0 and max(values) / min(values) > 10


def _values(curves: dict[str, Any]) -> list[float]:
    return [value for _, _, points in inked(curves) for value in points if math.isfinite(value)]
