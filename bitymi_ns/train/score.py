"""Multi-view scores of surfels: the errors they cover (FastGS), and the error that removing them adds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .config import TrainConfig
from .losses import photometric
from .processes import ALONE, Processes
from .views import View, eval_background, step_background

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


MOST_ERROR = 1e-3
"""Upper bound (30 dB) on the error whose share limits a prune: those of exposure or moving objects must not hide a
missing surfel."""


@dataclass(frozen=True)
class Scores:
    """One row per surfel."""

    importance: Tensor  # [N] int64, mean number of bad pixels per view that the surfel is blended into, rounded down
    prune: Tensor  # [N] float32 in [0, 1]; high: covers many bad pixels in views of high loss


def normalise(values: Tensor) -> Tensor:
    """Shift and scale values to [0, 1]; zeros if they are equal or not finite."""
    spread = values.max() - values.min() if values.numel() else values.new_zeros(())
    if not bool(torch.isfinite(spread) & (spread > 1e-12)):
        return torch.zeros_like(values)
    return (values - values.min()) / spread


def bad_pixels(rgb: Tensor, target: Tensor, threshold: float, mask: Tensor | None = None) -> Tensor:
    """Find the pixels, [H, W] bool, whose L1 error, normalised over the image, is above `threshold`. `rgb`, `target`:
    [H, W, 3]. `mask`: [H, W] or [H, W, 1] bool; pixels where it is False are never bad."""
    error = (rgb - target).abs().mean(-1)
    if mask is None:
        return normalise(error) > threshold
    mask = mask.reshape(error.shape)
    bad = torch.zeros_like(mask)
    bad[mask] = normalise(error[mask]) > threshold
    return bad


def _random_signs(like: Tensor, seed: int) -> Tensor:
    """Draw +1 or -1 for every element of a tensor, the same on every device, eight from a random byte: one number per
    sign would take longer than a GPU takes to render the view."""
    count = like.numel()
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(0, 256, (-(-count // 8),), dtype=torch.int32, generator=generator).to(like.device)
    bits = (torch.arange(256)[:, None] >> torch.arange(8)) & 1
    return (2 * bits - 1).to(like).index_select(0, drawn).flatten()[:count].reshape(like.shape)


@torch.no_grad()
def multi_view_scores(scene: Scene, views: Sequence[View], config: TrainConfig, processes: Processes = ALONE) -> Scores:
    """Score every surfel: s_d of the paper and FastGS's prune score; 0 without views.

    Every fragment that is blended at a bad pixel counts one for its surfel, whatever its weight. `views`: at the
    resolution to compare at, dealt out to the processes."""
    n = len(scene)
    device = scene.surfels["means"].device
    total = torch.zeros(n, dtype=torch.int64, device=device)
    weighted = torch.zeros(n, dtype=torch.float64, device=device)
    background = eval_background(config, device)
    for number in range(processes.rank, len(views), processes.count):
        view = views[number].to(device)
        output, rgb, target = view.drawn(scene, background)
        bad = bad_pixels(rgb, target, config.densify.error_threshold, view.mask)
        counts = output.fragments.masked_counts(bad.flatten())  # [N]
        loss = photometric(rgb, target, config.loss.ssim_weight, view.mask)
        total += counts
        weighted += loss.double() * counts
        del output  # frees its fragments before the next view is rendered
    processes.sum(total, weighted)
    importance = torch.div(total, max(1, len(views)), rounding_mode="floor")
    return Scores(importance, normalise(weighted).float())


def removal_errors(
    scene: Scene, views: Sequence[View], config: TrainConfig, seed: int, processes: Processes = ALONE
) -> tuple[Tensor, Tensor]:
    """Estimate the squared change of the views when each surfel is removed, and measure their squared error.

    An image C is linear in the opacity o of a surfel: removing it changes the image by v = -o dC/do. Over independent
    signs r, E[(r . v)^2] = |v|^2 (Hutchinson 1989), and one backward pass gives r . v for all surfels.

    Returns:
        Squared change [N] float64, summed over unmasked pixels, channels and views; and the squared error of the views,
        likewise, a float64 scalar, its mean clamped to `MOST_ERROR`.
    """
    logits = scene.surfels["opacity_logits"]
    device = logits.device
    by_logit = 1.0 + logits.detach().double().clamp(max=30.0).exp()  # o d/do = (1 + e^logit) d/dlogit
    added = torch.zeros_like(by_logit)
    error, value_count = torch.zeros(2, dtype=torch.float64, device=device)  # sum of squares, count of values
    for number in range(processes.rank, len(views), processes.count):
        view = views[number].to(device)
        background = step_background(config, view, seed + number, device)
        with torch.enable_grad():
            output, rgb, target = view.drawn(scene, background)
            signs = _random_signs(target, seed + number)
            if view.mask is not None:
                signs = signs * view.mask.reshape(*target.shape[:2], 1)
            (gradient,) = torch.autograd.grad((rgb * signs).sum(), logits)
        error += (signs * (rgb.detach() - target)).square().sum(dtype=torch.float64)
        value_count += signs.square().sum(dtype=torch.float64)
        added += (by_logit * gradient).square()
        del output, rgb  # frees their fragments before the next view is rendered
    processes.sum(added, error, value_count)
    return added, torch.minimum(error, MOST_ERROR * value_count)
