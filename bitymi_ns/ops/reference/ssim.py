"""Structural similarity, in float64."""

import torch
from torch import Tensor

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean SSIM of two images in [0, 1] (Wang et al. 2004).

    11 x 11 Gaussian window of standard deviation 1.5, data range 1, K1 = 0.01, K2 = 0.03, population variances, mean
    over the pixels whose window lies inside the image (H - 10 by W - 10 of them) and over the channels, as in the
    original. Libraries differ at the border only: torchmetrics pads by reflection and, depending on its version, also
    averages over the padded windows; its full image, cropped by 5 pixels, has the same values as here.

    Args:
        a, b: [H, W, C], H and W at least 11.

    Returns:
        Scalar, 1 for equal images.
    """
    if a.shape != b.shape:
        raise ValueError(f"ssim compares images of one shape, not {tuple(a.shape)} and {tuple(b.shape)}")
    if min(a.shape[:2]) < WINDOW:
        raise ValueError(f"ssim needs an image of at least {WINDOW} x {WINDOW} pixels, not {tuple(a.shape[:2])}")
    offset = torch.arange(WINDOW, dtype=a.dtype) - WINDOW // 2
    line = torch.exp(-(offset**2) / (2 * SIGMA**2))
    window = torch.outer(line, line) / line.sum() ** 2

    def blur(image: Tensor) -> Tensor:  # [H, W, C] -> [C, 1, H - 10, W - 10]
        return torch.nn.functional.conv2d(image.permute(2, 0, 1)[:, None], window[None, None])

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b, cov = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2, blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    contrast_structure = (2 * cov + C2) / (var_a + var_b + C2)
    return (luminance * contrast_structure).mean()
