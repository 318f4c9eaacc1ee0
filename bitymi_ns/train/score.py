"""Multi-view error scores of surfels, after FastGS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.losses import photometric
from bitymi_ns.train.processes import ALONE, Processes
from bitymi_ns.train.views import View, eval_background

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


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
    for view in (view.to(device) for view in views[processes.rank :: processes.count]):
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
