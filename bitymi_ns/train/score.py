"""Scores of surfels over many views: errors that they cover, after FastGS, and errors that their removal adds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.losses import photometric
from bitymi_ns.train.processes import ALONE, Processes
from bitymi_ns.train.views import View, eval_background, step_background

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


MOST_ERROR = 1e-3
"""Mean square error (30 dB) above which a share of the error says nothing of what may be lost: errors of exposure or of
what moved do not hide those of a missing surfel."""


@dataclass(frozen=True)
class Scores:
    """One row per surfel."""

    importance: Tensor  # [N] int64, mean number of bad pixels, per view, that the surfel is blended into, rounded down
    prune: Tensor  # [N] float32 in [0, 1]; high = covers many bad pixels of bad views


def normalise(values: Tensor) -> Tensor:
    """`values` moved and scaled to [0, 1]; all zeros when they do not differ or are not finite."""
    if values.numel() == 0:
        return values
    low, high = values.min(), values.max()
    spread = high - low
    if not bool(torch.isfinite(spread) & (spread > 1e-12)):
        return torch.zeros_like(values)
    return (values - low) / spread


def bad_pixels(rgb: Tensor, target: Tensor, threshold: float, mask: Tensor | None = None) -> Tensor:
    """[H, W] bool: the pixels whose error, normalised over the image, is above `threshold`.

    Args:
        rgb, target: [H, W, 3]; the error is the mean of |rgb - target| over the channels.
        threshold: in [0, 1].
        mask: [H, W] or [H, W, 1] bool, True where the pixel counts; other pixels are never bad.
    """
    error = (rgb - target).abs().mean(-1)
    if mask is None:
        return normalise(error) > threshold
    mask = mask.reshape(error.shape)
    bad = torch.zeros_like(mask)
    bad[mask] = normalise(error[mask]) > threshold
    return bad


def _random_signs(like: Tensor, seed: int) -> Tensor:
    """Draw +1 or -1 for every element of a tensor: the same on every device. A byte gives eight of them, since the CPU
    draws numbers at 200 M a second: those of a photograph would take longer than its picture takes a card."""
    count = like.numel()
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randint(0, 256, (-(-count // 8),), dtype=torch.int32, generator=generator).to(like.device)
    bits = (torch.arange(256)[:, None] >> torch.arange(8)) & 1
    return (2 * bits - 1).to(like).index_select(0, drawn).flatten()[:count].reshape(like.shape)


@torch.no_grad()
def multi_view_scores(scene: Scene, views: Sequence[View], config: TrainConfig, processes: Processes = ALONE) -> Scores:
    """Render the views and score every surfel (the score s_d of the paper and FastGS's prune score).

    Every fragment that is blended at a bad pixel counts one for its surfel, whatever its weight.

    Args:
        views: K views, at the size in which they are to be judged; none gives zero scores.
        processes: each renders its share of the views.
    """
    n = len(scene)
    device = scene.surfels["means"].device
    total = torch.zeros(n, dtype=torch.int64, device=device)
    weighted = torch.zeros(n, dtype=torch.float64, device=device)
    background = eval_background(config, device)
    for number in range(processes.rank, len(views), processes.count):
        view = views[number].to(device)
        target = view.target(background, device)
        output = scene.render(view.camera, background=background, field_mode="frozen")
        rgb = view.shown(output.rgb, output.alpha, background)
        bad = bad_pixels(rgb, target, config.densify.error_threshold, view.mask)
        counts = output.fragments.masked_counts(bad.flatten(), n)  # [N]
        loss = photometric(rgb, target, config.loss.ssim_weight, view.mask)
        total += counts
        weighted += loss.double() * counts
        del output  # with its fragments, before the next view makes its own
    processes.sum(total, weighted)
    importance = torch.div(total, max(1, len(views)), rounding_mode="floor")
    return Scores(importance, normalise(weighted).float())


def removal_errors(
    scene: Scene, views: Sequence[View], config: TrainConfig, seed: int, processes: Processes = ALONE
) -> tuple[Tensor, Tensor]:
    """Estimate the squared change of the views when a surfel is removed, and measure the squared error that they have.

    A picture C is linear in the opacity o of each surfel, so removing it changes the picture by v = -o dC/do. Over
    independent signs r, E[(r . v)^2] = |v|^2 (Hutchinson 1989), and one backward pass gives r . v of all surfels.

    Args:
        views: at the size in which they are to be judged.
        seed: of the signs, and of random backgrounds.
        processes: each renders its share of the views.

    Returns:
        [N] float64, summed over pixels that count, channels and views, 0 where no view shows the surfel; and the
        squared error of the views against the photographs, summed alike, a float64 scalar, at most `MOST_ERROR` in the
        mean.
    """
    logits = scene.surfels["opacity_logits"]
    device = logits.device
    by_logit = 1.0 + logits.detach().double().clamp(max=30.0).exp()  # o d/do = (1 + e^logit) d/dlogit
    added = torch.zeros_like(by_logit)
    error, numbers = torch.zeros(2, dtype=torch.float64, device=device)  # squares, how many
    for number in range(processes.rank, len(views), processes.count):
        view = views[number].to(device)
        background = step_background(config, view, seed + number, device)
        target = view.target(background, device)
        signs = _random_signs(target, seed + number)
        if view.mask is not None:
            signs = signs * view.mask.reshape(*target.shape[:2], 1)
        with torch.enable_grad():
            output = scene.render(view.camera, background=background, field_mode="frozen")
            rgb = view.shown(output.rgb, output.alpha, background)
            (gradient,) = torch.autograd.grad((rgb * signs).sum(), logits)
        error += (signs * (rgb.detach() - target)).square().sum(dtype=torch.float64)
        numbers += signs.square().sum(dtype=torch.float64)
        added += (by_logit * gradient).square()
        del output, rgb  # with their fragments, before the next view makes its own
    processes.sum(added, error, numbers)
    return added, torch.minimum(error, MOST_ERROR * numbers)
