"""Quality gates of an estimated cut-out: pieces, holes, contact with the border, agreement of two methods."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from torch import Tensor

from dg4d_lib.asset_settings import CutoutGateSettings
from dg4d_lib.metrics.gates import CONNECTIVITY, SUBJECT_ALPHA, Gate

FORM = "cut-out"
SMALLEST_HOLE = 4e-4  # share of the filled subject; smaller holes are highlights and noise
BORDER = 0.01  # width of the border, as a share of the longest side
ADVICE = "give a mask (--mask FILE) or a box (--box X,Y,W,H), or choose another subject.matting"


def evaluate_cutout(alpha: Float[Tensor, "t h w"], agreement: float | None, settings: CutoutGateSettings) -> list[Gate]:
    """Evaluate the gates of a cut-out in the frame of its source; the worst frame counts.

    Args:
        alpha: of all frames.
        agreement: overlap (IoU) of two methods; None if there is one method only.
        settings: bounds.
    """
    masks = [each.cpu().numpy() > SUBJECT_ALPHA for each in alpha]
    gates = [
        Gate(
            "cut-out pieces",
            {FORM: max(map(loose_share, masks))},
            None,
            settings.pieces_most,
            "",
            "share of the cut-out outside of its largest piece",
            f"parts of the background were kept, or the subject fell apart: {ADVICE}",
        ),
        Gate(
            "cut-out holes",
            {FORM: max(map(hole_share, masks))},
            None,
            settings.holes_most,
            "",
            "share of the filled cut-out that is holes",
            f"parts of the subject were removed: {ADVICE}",
        ),
        Gate(
            "cut-out border",
            {FORM: max(map(border_share, masks))},
            None,
            settings.border_most,
            "",
            "share of the picture's border that the cut-out touches",
            f"the background was kept, or the picture is cropped: {ADVICE}",
        ),
    ]
    if agreement is not None:
        gates.append(
            Gate(
                "cut-out agreement",
                {FORM: agreement},
                settings.agreement_least,
                None,
                "",
                "overlap of the cut-outs of two methods, or of a network's answers to the picture and its mirror image",
                f"the outline is uncertain: {ADVICE}",
            )
        )
    return gates


def loose_share(mask: Bool[ndarray, "h w"]) -> float:
    """Return the share of a mask outside of its largest piece; 0 for an empty mask."""
    labels, count = ndimage.label(mask, CONNECTIVITY)
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    return 1 - float(areas.max() / areas.sum()) if count else 0.0


def hole_share(mask: Bool[ndarray, "h w"]) -> float:
    """Return the share of a filled mask that is holes; 0 for an empty mask."""
    filled = ndimage.binary_fill_holes(mask)
    if not filled.any():
        return 0.0
    labels, count = ndimage.label(filled & ~mask)
    areas = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    return float(areas[areas >= SMALLEST_HOLE * filled.sum()].sum() / filled.sum())


def border_share(mask: Bool[ndarray, "h w"]) -> float:
    """Return the share of the frame's border that a mask covers."""
    width = max(1, round(BORDER * max(mask.shape)))
    ring = np.ones(mask.shape, bool)
    ring[width:-width, width:-width] = False
    return float(mask[ring].mean())
