"""Loss curves as SVG, for the report and the Prefect UI."""

import html
import math
from typing import Any

from flows.formatting.numbers import format_number

WIDTH, HEIGHT = 420, 150  # pixels, of the plot
LINE = 14  # pixels, of the text below the plot
LOG_SPAN = 10  # ratio of the largest to the smallest value, from which the scale is logarithmic
COUNTS = ("Gaussians",)  # series that are not losses; they are not on the axis of losses
# in light and in dark color schemes; inks have at least 4.5:1 on the paper, as WCAG AA asks of text
PAPER, CAPTION = ("#ffffff", "#1f1f25"), ("#666666", "#a1a1aa")
INKS = (
    ("#2563eb", "#60a5fa"),
    ("#dc2626", "#f87171"),
    ("#047857", "#34d399"),
    ("#b45309", "#fbbf24"),
    ("#7c3aed", "#a78bfa"),
    ("#0e7490", "#22d3ee"),
    ("#be185d", "#f472b6"),
    ("#4d7c0f", "#a3e635"),
)


def svg_picture(curves: dict[str, Any]) -> str:
    """Plot losses over iterations, with range and last values below; return "" if there is nothing to plot.

    Counts are not plotted; their first and last values stand below.

    Args:
        curves: content of a `curves` artifact.
    """
    longer = {name: values for name, values in curves["series"].items() if len(values) > 1}
    series = {name: values for name, values in longer.items() if name not in COUNTS}
    finite = [value for values in series.values() for value in values if math.isfinite(value)]
    if not finite:
        return ""
    low, high = min(finite), max(finite)
    logarithmic = low > 0 and high / low > LOG_SPAN
    scale = math.log10 if logarithmic else float
    first, last = curves["x"][0], curves["x"][-1]
    across, down = WIDTH / ((last - first) or 1), HEIGHT / ((scale(high) - scale(low)) or 1)
    span = f"{format_number(high)} to {format_number(low)}{', logarithmic' if logarithmic else ''}"
    lines, texts = [], [(CAPTION, f"{span}; iterations {first} to {last}")]
    for number, (name, values) in enumerate(series.items()):
        ink = INKS[number % len(INKS)]
        texts.append((ink, f"{name} {format_number(values[-1])}"))
        points = " ".join(
            f"{across * (x - first):.1f},{down * (scale(high) - scale(y)):.1f}"
            for x, y in zip(curves["x"], values, strict=False)
            if math.isfinite(y)
        )
        lines.append(f'<polyline points="{points}" fill="none" stroke-width="1.5" {_paint("stroke", ink)}/>')
    counts = {name: values for name, values in longer.items() if name in COUNTS}
    texts += [(CAPTION, f"{name} {format_number(v[0])} to {format_number(v[-1])}") for name, v in counts.items()]
    legend = [
        f'<text x="0" y="{HEIGHT + LINE * number}" {_paint("fill", ink)}>{html.escape(text)}</text>'
        for number, (ink, text) in enumerate(texts, 1)
    ]
    name = html.escape(f"{curves.get('title', 'curves')}: {'; '.join(text for _, text in texts)}")
    width, height = WIDTH + 8, HEIGHT + LINE * len(texts) + 12
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="{name}" '
        f'width="{width}" height="{height}" viewBox="-4 -4 {width} {height}" '
        'font-family="sans-serif" font-size="11" style="color-scheme: light dark">'
        f'<rect x="-4" y="-4" width="{width}" height="{height}" {_paint("fill", PAPER)}/>'
        f"{''.join([*lines, *legend])}</svg>"
    )


def _paint(name: str, colors: tuple[str, str]) -> str:
    """Return attributes of a color in both color schemes; browsers that know no `light-dark` show the light one."""
    light, dark = colors
    return f'{name}="{light}" style="{name}: light-dark({light}, {dark})"'
