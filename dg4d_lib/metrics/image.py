"""How alike pictures are, one number per picture of a batch."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d

BEST_PSNR = 60.0  # dB; equal pictures have this instead of infinity, so that means stay finite
WINDOW, SIGMA = 11, 1.5  # pixels, of the SSIM's Gaussian (Wang et al. 2004)
K1, K2 = 0.01, 0.03  # SSIM's stabilizers, times the range of the data, which is 1


def psnr(
    images: Float[Tensor, "b h w c"],
    truth: Float[Tensor, "b h w c"],
    region: Float[Tensor, "b h w 1"] | None = None,
) -> Float[Tensor, " b"]:
    """Peak signal-to-noise ratio of pictures in [0, 1], in dB, at most 60.

    Args:
        images: what is judged.
        truth: what it should be.
        region: weights of the pixels, for example the union of two silhouettes; None is the whole picture. A picture
            whose region is empty has nothing to be wrong about: 60.
    """
    error = (images - truth).square().mean(-1, keepdim=True)
    weight = torch.ones_like(error) if region is None else region.to(error)
    mean = (error * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp_min(torch.finfo(error.dtype).tiny)
    return -10 * mean.clamp_min(10 ** (-BEST_PSNR / 10)).log10()


def ssim(images: Float[Tensor, "b h w c"], truth: Float[Tensor, "b h w c"]) -> Float[Tensor, " b"]:
    """Structural similarity of pictures in [0, 1] (Wang et al. 2004): Gaussian window of 11 x 11, sigma 1.5.

    Population covariances; the mean is taken over the places where the window lies inside, so pictures need at least
    11 pixels on each side. 1 is equal. Computed in float64, since variances are small differences.
    """
    batch, _, _, channels = images.shape
    precision, images, truth = images.dtype, images.double(), truth.double()
    steps = torch.arange(WINDOW, dtype=images.dtype, device=images.device) - WINDOW // 2
    line = torch.exp(-steps.square() / (2 * SIGMA**2))
    line = line / line.sum()

    def local_mean(values: Float[Tensor, "b h w c"]) -> Tensor:
        planes = values.movedim(-1, 1).reshape(batch * channels, 1, *values.shape[1:3])
        return conv2d(conv2d(planes, line.view(1, 1, -1, 1)), line.view(1, 1, 1, -1))

    mean_x, mean_y = local_mean(images), local_mean(truth)
    variance_x = local_mean(images.square()) - mean_x.square()
    variance_y = local_mean(truth.square()) - mean_y.square()
    covariance = local_mean(images * truth) - mean_x * mean_y
    c1, c2 = K1**2, K2**2
    similarity = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    similarity = similarity / ((mean_x.square() + mean_y.square() + c1) * (variance_x + variance_y + c2))
    return similarity.view(batch, -1).mean(1).to(precision)


def iou(
    coverage: Float[Tensor, "b h w 1"], truth: Float[Tensor, "b h w 1"], threshold: float = 0.5
) -> Float[Tensor, " b"]:
    """Intersection over union of two silhouettes: the pixels with coverage above the threshold. Two empty ones: 1."""
    ours, theirs = coverage > threshold, truth > threshold
    both, either = (ours & theirs).sum((1, 2, 3)), (ours | theirs).sum((1, 2, 3))
    return torch.where(either > 0, both / either.clamp_min(1), 1.0).to(coverage)
