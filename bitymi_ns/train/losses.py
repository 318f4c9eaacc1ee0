"""Training objective: photometric, falloff, overdraw, depth and normal losses.

A `mask` is [H, W] or [H, W, 1] bool, True where the pixel counts; None: everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops.backend import cuda_backend
from bitymi_ns.ops.training_view import ComparedView
from .config import LossConfig

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import RenderOutput

DEPTH_EDGE = 0.1
"""Relative depth difference between neighbouring pixels that counts as an edge: photographs blend both sides, depth
maps do not, and depth sensors are least reliable there."""
SAME_COLOR = 0.01  # ridge of colour fits: keeps the contrast of colours with a smaller standard deviation
FITTED = 0.01  # minimum fraction of a half's pixels for a colour fit
SSIM_WINDOW = 11  # side of the SSIM window, pixels


def objective(
    output: RenderOutput | ComparedView,
    target: Tensor,
    config: LossConfig,
    mask: Tensor | None = None,
    depth: Tensor | None = None,
    normal: Tensor | None = None,
) -> dict[str, Tensor]:
    """Compute the weighted terms of the objective, which is their sum.

    Args:
        output: rendered view of H x W pixels.
        target: [H, W, 3] photograph over the same background.
        depth, normal: as in `View`.

    Returns:
        `photometric`; `falloff`, `depth` and `normal` unless their weight is 0, the latter if the view was rendered
        with maps; `overdraw` if it was rendered with `soft_overdraw`.
    """
    if isinstance(output, ComparedView):
        terms = {"photometric": output.photometric, "falloff": output.falloff}
        return terms if config.falloff_weight > 0.0 else {"photometric": output.photometric}
    terms = {"photometric": photometric(output.rgb, target, config.ssim_weight, mask)}
    if config.falloff_weight > 0.0:
        omega = error_weight(output.rgb, target, config.falloff_gamma, mask)
        terms["falloff"] = config.falloff_weight * mean_where_right(omega, output.beta, mask)
    if output.soft_overdraw is not None:
        omega = error_weight(output.rgb, target, config.falloff_gamma, mask)
        terms["overdraw"] = config.overdraw_weight * mean_where_right(omega, output.soft_overdraw, mask)
    if output.depth is not None and depth is not None and config.depth_weight > 0.0:
        weight = config.depth_weight * config.geometry_interval
        terms["depth"] = weight * depth_error(output.depth, output.alpha, depth, mask)
    if output.normal is not None and normal is not None and config.normal_weight > 0.0:
        weight = config.normal_weight * config.geometry_interval
        terms["normal"] = weight * normal_error(output.normal, output.alpha, normal, mask)
    return terms


def fused_losses(config: LossConfig, image: Tensor) -> bool:
    """Return True if CUDA kernels can compute the losses of an image [H, W, C] (`Scene.compare`)."""
    return config.ssim_weight > 0.0 and min(image.shape[:2]) >= SSIM_WINDOW and cuda_backend(image.device)


def count_values(image: Tensor, mask: Tensor | None, counted: int | None = None) -> int:
    """Count the unmasked colour values of an image [H, W, C]; `counted`: number of unmasked pixels, if known."""
    if mask is None:
        return 3 * image.shape[0] * image.shape[1]
    return 3 * (int(mask.sum()) if counted is None else counted)


def photometric(rgb: Tensor, target: Tensor, ssim_weight: float, mask: Tensor | None = None) -> Tensor:
    """Compute (1 - w) L1 + w (1 - SSIM).

    Args:
        rgb: [H, W, 3] rendered image.
        target: [H, W, 3] photograph in [0, 1].
        ssim_weight: w; 0 for images smaller than `SSIM_WINDOW`.
        mask: excluded pixels are left out of L1 and equal in both images for SSIM: they have no gradient.

    Returns:
        Scalar; 0 if no pixel counts.
    """
    if mask is not None:
        mask = mask.reshape(*rgb.shape[:2], 1)
        # where() also keeps a NaN in an excluded pixel of the photograph out of the gradient
        target = torch.where(mask, target, 0.0)
        rgb = torch.where(mask, rgb, target)
        l1 = (rgb - target).abs().sum() / (3 * mask.sum()).clamp(min=1)
    else:
        l1 = (rgb - target).abs().mean()
    if ssim_weight == 0.0 or min(rgb.shape[:2]) < SSIM_WINDOW:
        return l1
    return (1.0 - ssim_weight) * l1 + ssim_weight * (1.0 - ops.ssim(rgb, target))


def error_weight(rgb: Tensor, target: Tensor, gamma: float, mask: Tensor | None = None) -> Tensor:
    """Compute omega = exp(-gamma e) of the falloff loss, [H, W, 1], with e = L1 summed over rgb [H, W, 3]; 0 where the
    mask is False. Without gradient: else a larger error would lower the loss."""
    omega = torch.exp(-gamma * (rgb.detach() - target.detach()).abs().sum(-1, keepdim=True))
    # where() also keeps a NaN in an excluded pixel of the photograph out
    return omega if mask is None else torch.where(mask.reshape(omega.shape), omega, 0.0)


def mean_where_right(omega: Tensor, values: Tensor, mask: Tensor | None = None) -> Tensor:
    """Average omega * values over the pixels that count; 0 without any: the falloff loss of `RenderOutput.beta`, sum_i
    w_i beta_i, or the overdraw loss of `RenderOutput.soft_overdraw`.

    Args:
        omega: [H, W, 1] of `error_weight`, with the same mask.
        values: [H, W, 1].
    """
    return (omega * values).sum() / (omega.numel() if mask is None else mask.sum().clamp(min=1))


def depth_error(rendered: Tensor, alpha: Tensor, depth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Compute the mean relative depth error |sum_i w_i (z_i - d)| / d over pixels of known depth d, except at edges.

    Args:
        rendered: [H, W, 1] sum of w z, camera z.
        alpha: [H, W, 1] sum of w.
        depth: [H, W] or [H, W, 1] d of any float dtype; unknown where not finite or not above 0.

    Returns:
        Scalar; 0 if no depth is known.
    """
    depth = depth.reshape(rendered.shape).to(rendered)
    known = depth.isfinite() & (depth > 0.0)
    depth = torch.where(known, depth, 1.0)
    error = (rendered - alpha * depth).abs() / depth
    return _mean_of(error, known & ~_edges(depth, known), mask)


def _edges(depth: Tensor, known: Tensor) -> Tensor:
    """Find depth edges, [H, W, 1] bool: True where depths differ within the surrounding 3 x 3 pixels."""

    def largest(values: Tensor) -> Tensor:
        return torch.nn.functional.max_pool2d(torch.where(known, values, 0.0)[None, ..., 0], 3, 1, 1)[0, ..., None]

    return largest(depth) * largest(1.0 / depth) > 1.0 + DEPTH_EDGE


def normal_error(rendered: Tensor, alpha: Tensor, normal: Tensor, mask: Tensor | None = None) -> Tensor:
    """Compute the mean of sum_i w_i (1 - n_i . n) over the pixels of known normal n.

    Args:
        rendered: [H, W, 3] sum of w n, camera frame.
        alpha: [H, W, 1] sum of w.
        normal: [H, W, 3] n in the same frame, of any float dtype; unknown where not finite or 0.

    Returns:
        Scalar; 0 if no normal is known.
    """
    normal = normal.to(rendered)
    length = normal.norm(dim=-1, keepdim=True)
    known = length.isfinite() & (length > 0.0)
    unit = torch.where(known, normal / length, 0.0)
    return _mean_of(alpha - (rendered * unit).sum(-1, keepdim=True), known, mask)


def _mean_of(values: Tensor, known: Tensor, mask: Tensor | None) -> Tensor:
    """Average over the known pixels that count; 0 without any."""
    if mask is not None:
        known = known & mask.reshape(known.shape)
    return torch.where(known, values, 0.0).sum() / known.sum().clamp(min=1)


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Compute the PSNR in dB, at most 100 (equal images); NaN if no pixel counts. `image` and `target`: [H, W, 3] in
    [0, 1]."""
    error = (image - target).square()
    if mask is not None:
        error = error[mask.reshape(error.shape[:2])]
    if error.numel() == 0:
        return math.nan
    return min(100.0, -10.0 * math.log10(max(float(error.sum()) / error.numel(), 1e-10)))


def color_fitted(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Map the colours of each half of an image by the affine least squares fit of the other half to `target`, clamped
    to [0, 1]: [H, W, 3]. Compensates exposure and white balance of held-out photographs.

    A half is not mapped if the other one is not finite, or has fewer pixels that count than `FITTED`. `image`,
    `target`: [H, W, 3] in [0, 1]."""
    colors = torch.cat([image, torch.ones_like(image[..., :1])], -1).double()  # [H, W, 4]
    both = torch.cat([colors, target - image], -1)  # [H, W, 7] double
    if mask is not None:
        both = torch.where(mask.reshape(*image.shape[:2], 1).bool(), both, 0.0)
    left, right = slice(image.shape[1] // 2), slice(image.shape[1] // 2, None)
    # normal equations without matrix product: cuBLAS fails if torch is set to deterministic algorithms
    sums = [[(both[:, by, i : i + 1] * both[:, by]).sum((0, 1)) for i in range(4)] for by in (right, left)]
    sums = torch.stack([torch.stack(rows) for rows in sums]).cpu()  # [2, 4, 7]
    fitted = []
    for half, by in zip((left, right), sums, strict=True):
        pixels = by[3, 3]
        if not bool(by.isfinite().all()) or pixels < max(1.0, 0.5 * FITTED * image.shape[0] * image.shape[1]):
            fitted.append(image[:, half])
            continue
        ridge = SAME_COLOR**2 * pixels * torch.eye(4, dtype=by.dtype)
        affine = torch.linalg.solve(by[:, :4] + ridge, by[:, 4:]).to(colors)  # [4, 3]
        fitted.append(image[:, half] + sum(colors[:, half, i : i + 1] * affine[i] for i in range(4)))
    return torch.cat(fitted, 1).clamp(0.0, 1.0).to(image)


def fitted_psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Compute the PSNR, dB, of the `color_fitted` image."""
    return psnr(color_fitted(image, target, mask), target, mask)


def mean_psnr(values: Sequence[float]) -> float:
    """Average PSNR values, dB, without NaN; NaN if empty."""
    counted = [value for value in values if not math.isnan(value)]
    return sum(counted) / len(counted) if counted else math.nan
