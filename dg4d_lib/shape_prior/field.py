"""Predicted matter and colors on the rays of the input camera, for one picture or for the frames of a video."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from dg4d_lib.errors import BadInput
from dg4d_lib.images import luminance, resize_planes
from dg4d_lib.inflation.heights import heights
from dg4d_lib.inflation.hints import NO_HINT, DepthHint
from dg4d_lib.inflation.mask import subject_mask
from dg4d_lib.shape_prior.absorption import optical_density, transmittance
from dg4d_lib.shape_prior.decided import GENEROSITY
from dg4d_lib.shape_prior.evidence import hint_evidence
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV
from dg4d_lib.shape_prior.mirror import MirrorPlane, mirror_plane, mirrored_colors
from dg4d_lib.shape_prior.network import VISIBLE, Features, ShapePriorNetwork

INFLATED_SOFTNESS = 0.05  # world units: depth over which the occupancy of an inflated shape falls
SURE, UNSURE = 0.8, 0.95  # expected 1 - p of matter: below it the network alone, above it the inflation alone
SMOOTHNESS, KNOWN_SMOOTHNESS = 2.0, 1.0  # cells: of surfaces that the network guesses, and of those that are known
LARGEST_LOGIT = 5.3  # probabilities are kept from 0.005 to 0.995
HIDDEN_BRIGHTNESS = 0.87  # of hidden matter, relative to the picture: what the network says of it is too dark
LARGEST_GAIN, DARKEST = 2.0, 0.02  # of hidden colors, either way; luminance below which nothing is brighter


@dataclass(frozen=True)
class ShapeField:
    """Expected shape of a subject.

    Attributes:
        logits: of every cell lying inside the subject; row, column, depth.
        front: color of every pixel, straight, in [0, 1].
        hidden: color of surfaces that the picture does not show, in [0, 1].
        mask: pixels of the subject.
        inflated_share: share of the inflation in the probabilities, in [0, 1].
        smoothness: cells over which neighboring rays decide alike where the surface lies.
        generosity: cells of matter to add per unit of variance on a ray; 0 for shapes that are known.
    """

    logits: Float[Tensor, "128 128 64"]
    front: Float[Tensor, "128 128 3"]
    hidden: Float[Tensor, "128 128 64 3"]
    mask: Bool[Tensor, "128 128"]
    inflated_share: float
    smoothness: float = SMOOTHNESS
    generosity: float = GENEROSITY


@runtime_checkable
class Fields(Protocol):
    """Field of a subject per frame."""

    def __len__(self) -> int:
        """Return the number of frames."""
        ...

    def predict(self, frame: int) -> ShapeField:
        """Return the field of a frame.

        Raises:
            BadInput: the frame shows no subject.
        """
        ...


class ShapeFields:
    """Fields of the frames of a subject, each predicted when first asked for.

    All frames share one code of the subject, the mean of their own. A single picture is encoded when first asked for.
    """

    def __init__(
        self, network: ShapePriorNetwork, cutouts: Sequence[Float[Tensor, "h w 4"]], hint: DepthHint = NO_HINT
    ) -> None:
        """Encode the pictures if there are several.

        Args:
            network: in evaluation mode.
            cutouts: one per frame: square, straight alpha, color and alpha in [0, 1].
            hint: at the depth of the subject.

        Raises:
            BadInput: a picture is not square.
        """
        if crooked := [cutout.shape for cutout in cutouts if cutout.shape[0] != cutout.shape[1]]:
            raise BadInput(
                f"pictures of the shape prior must be square; given {crooked[0][1]} x {crooked[0][0]} pixels"
            )
        self._network, self._hint = network, hint
        self._pictures = [premultiplied(cutout) for cutout in cutouts]
        self._kept: Features | None = None  # of a single picture; those of a long video would fill the memory
        self._code: Float[Tensor, "2 c"] | None = None  # None: the picture's own
        if len(self) > 1:
            self._code = torch.stack([self._features(frame).code for frame in range(len(self))]).mean(0)

    def __len__(self) -> int:
        return len(self._pictures)

    def predict(self, frame: int) -> ShapeField:
        """Return the field of a frame: the mean over the picture and its mirror image.

        Raises:
            BadInput: the picture shows no subject.
        """
        picture = self._pictures[frame]
        mask = picture_mask(picture)
        features = self._features(frame)
        logits, colors, share = self._matter(features, mask)
        knots = colors.permute(3, 2, 0, 1)[None]
        hidden = interpolate(knots, (BINS, SIZE, SIZE), mode="trilinear", align_corners=True)[0].permute(2, 3, 1, 0)
        front, plane, probability = straight_color(picture), self._mirror_plane(features), logits.sigmoid()
        hidden = as_bright_as(hidden, probability, picture)
        if plane.trust > 0:
            left = transmittance(optical_density(probability, mask))
            hidden = mirrored_colors(hidden, front, probability, left, mask, plane)
        smoothness = KNOWN_SMOOTHNESS if self._hint.sigma else SMOOTHNESS
        return ShapeField(logits, front, hidden, mask, share, smoothness)

    def logits(self, frame: int) -> Float[Tensor, "128 128 64"]:
        """Return the log-odds of matter of a frame, as in its field; much faster than `predict`.

        Raises:
            BadInput: the picture shows no subject.
        """
        return self._matter(self._features(frame), picture_mask(self._pictures[frame]))[0]

    def mirror_plane(self, frame: int) -> MirrorPlane:
        """Return the mirror plane of a frame."""
        return self._mirror_plane(self._features(frame))

    def _features(self, frame: int) -> Features:
        """Return the features of the picture and its mirror image."""
        if self._kept is not None:
            return self._kept
        picture = self._pictures[frame]
        with torch.no_grad():
            features = self._network.encode(torch.stack([picture, picture.flip(2)]))
        if len(self) == 1:
            self._kept = features
        return features

    def _matter(
        self, features: Features, mask: Bool[Tensor, "128 128"]
    ) -> tuple[Float[Tensor, "128 128 64"], Float[Tensor, "128 128 8 3"], float]:
        """Return log-odds, colors at the knots of every ray, and the share of the inflation in the probabilities."""
        with torch.no_grad():
            both = self._rays(features)
        logits, colors = ((part[0] + part[1].flip(1)) / 2 for part in both)
        logits = bounded_logits(logits + hint_evidence(self._hint, logits, mask), mask)
        share = inflated_share(logits.sigmoid(), mask)
        if share > 0:
            inflated = inflated_probability(mask).clamp(torch.tensor(-LARGEST_LOGIT).sigmoid())
            logits = torch.logit((1 - share) * logits.sigmoid() + share * inflated, 1e-3)
        return logits, colors, share

    def _mirror_plane(self, features: Features) -> MirrorPlane:
        """Return the mirror plane of a frame, the mean over the picture and its mirror image."""
        with torch.no_grad():
            moment, point, logit = self._network.mirror(features.code)
        flip = torch.tensor([-1.0, 1.0, 1.0])  # x of the mirror image
        moment = (moment[0] + moment[1] * flip * flip[:, None]) / 2
        return mirror_plane(moment, (point[0] + point[1] * flip) / 2, float(logit.sigmoid().mean()))

    def _rays(self, features: Features) -> tuple[Float[Tensor, "2 128 128 64"], Float[Tensor, "2 128 128 8 3"]]:
        decoded = self._network.decode(features, self._code)
        pixels = torch.arange(2 * SIZE**2)
        logits, colors, _ = self._network.rays(decoded, features.picture, pixels)
        return logits.unflatten(0, (2, SIZE, SIZE)), colors.unflatten(0, (2, SIZE, SIZE))


class InflatedFields:
    """Field of the inflated silhouette per frame: hidden surfaces have the colors before them."""

    def __init__(self, cutouts: Sequence[Float[Tensor, "h w 4"]]) -> None:
        """Store the pictures, one per frame: square, straight alpha, color and alpha in [0, 1]."""
        self._pictures = [premultiplied(cutout) for cutout in cutouts]

    def __len__(self) -> int:
        return len(self._pictures)

    def predict(self, frame: int) -> ShapeField:
        """Return the field of a frame.

        Raises:
            BadInput: the picture shows no subject.
        """
        picture = self._pictures[frame]
        mask, front = picture_mask(picture), straight_color(picture)
        logits = bounded_logits(torch.logit(inflated_probability(mask)), mask)
        return ShapeField(logits, front, front[:, :, None].expand(-1, -1, BINS, -1), mask, 1.0)


def premultiplied(cutout: Float[Tensor, "h w 4"]) -> Float[Tensor, "4 128 128"]:
    """Return premultiplied color and alpha at the network's size."""
    alpha = cutout[..., 3:]
    planes = torch.cat([cutout[..., :3] * alpha, alpha], -1).permute(2, 0, 1)[None].float().cpu()
    return resize_planes(planes, (SIZE, SIZE))[0].clamp(0, 1)


def bounded_logits(logits: Float[Tensor, "128 128 64"], mask: Bool[Tensor, "128 128"]) -> Float[Tensor, "128 128 64"]:
    """Return log-odds within the bounds of a field, lowest outside of the subject."""
    return torch.where(mask[..., None], logits.clamp(-LARGEST_LOGIT, LARGEST_LOGIT), -LARGEST_LOGIT)


def picture_mask(picture: Float[Tensor, "4 128 128"]) -> Bool[Tensor, "128 128"]:
    """Return the pixels of the subject in a premultiplied picture.

    Raises:
        BadInput: the picture shows no subject.
    """
    return torch.from_numpy(subject_mask(picture[3].double().numpy())[0])


def as_bright_as(
    hidden: Float[Tensor, "128 128 64 3"], probability: Float[Tensor, "128 128 64"], picture: Float[Tensor, "4 128 128"]
) -> Float[Tensor, "128 128 64 3"]:
    """Return hidden colors times one factor, with which they have 0.8 of the picture's brightness in the mean.

    Args:
        hidden: colors in [0, 1].
        probability: of matter, the weights of the mean.
        picture: premultiplied color and alpha.
    """
    seen = luminance(picture[:3].movedim(0, -1)).sum() / picture[3].sum()
    guessed = (luminance(hidden) * probability).sum() / probability.sum()
    gain = HIDDEN_BRIGHTNESS * seen / guessed.clamp(min=DARKEST)
    return (hidden * gain.clamp(1 / LARGEST_GAIN, LARGEST_GAIN)).clamp(max=1)


def straight_color(picture: Float[Tensor, "4 128 128"]) -> Float[Tensor, "128 128 3"]:
    """Return the color of a premultiplied picture."""
    return (picture[:3] / picture[3:].clamp(min=VISIBLE)).clamp(0, 1).permute(1, 2, 0)


def inflated_share(probability: Float[Tensor, "128 128 64"], mask: Bool[Tensor, "128 128"]) -> float:
    """Return how far to fall back on the inflation, from the expected variance of the matter that is predicted."""
    inside = probability[mask]
    variance = float((inside * (1 - inside)).sum() / inside.sum().clamp(min=1e-6))
    return min(1.0, max(0.0, (variance - SURE) / (UNSURE - SURE)))


def inflated_probability(mask: Bool[Tensor, "128 128"]) -> Float[Tensor, "128 128 64"]:
    """Return the occupancy of the inflated silhouette, soft at its surface."""
    bulge = torch.from_numpy(heights(mask.numpy(), 4 * TAN_HALF_FOV / SIZE)).float()
    middles = (NEAR + FAR) / 2 - (NEAR + (torch.arange(BINS) + 0.5) * (FAR - NEAR) / BINS)
    return ((bulge[..., None] - middles.abs()) / INFLATED_SOFTNESS).sigmoid() * mask[..., None]
