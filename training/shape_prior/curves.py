"""Training curves as a picture."""

from collections.abc import Sequence

from PIL import Image, ImageDraw

WIDTH, HEIGHT, MARGIN = 360, 220, 36
PANELS = ("iou", "bce", "train_occupancy", "color", "plane_deg", "rate")


def draw_curves(curve: Sequence[dict[str, float]]) -> Image.Image:
    """Return one panel per figure over the number of samples shown."""
    names = [name for name in PANELS if curve and name in curve[-1]]
    image = Image.new("RGB", (WIDTH * 3, HEIGHT * 2), "white")
    draw = ImageDraw.Draw(image)
    for i, name in enumerate(names):
        _panel(draw, i % 3 * WIDTH, i // 3 * HEIGHT, name, [(row["shown"], row[name]) for row in curve if name in row])
    return image


def _panel(draw: ImageDraw.ImageDraw, left: int, top: int, name: str, points: list[tuple[float, float]]) -> None:
    most, values = max(x for x, _ in points), [y for _, y in points]
    low, high = min(values), max(values)
    span = max(high - low, 1e-9)
    box = (left + MARGIN, top + MARGIN, left + WIDTH - 12, top + HEIGHT - MARGIN)
    draw.rectangle(box, outline="gray")
    line = [(box[0] + x / most * (box[2] - box[0]), box[3] - (y - low) / span * (box[3] - box[1])) for x, y in points]
    draw.line(line, fill="blue", width=2)
    draw.text((box[0], top + 12), f"{name}: {low:.4g} to {high:.4g}, now {values[-1]:.4g}", fill="black")
    draw.text((box[2] - 90, box[3] + 6), f"{most:.0f} samples", fill="black")
