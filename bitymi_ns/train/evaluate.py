"""Quality of held-out views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from .config import TrainConfig
from .exposure import Exposure
from .losses import fitted_psnr, mean_psnr, psnr
from .poses import Poses, aligned, view_psnr
from .views import View, eval_background

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


@dataclass
class Quality:
    """Means over views, of PSNR over those with unmasked pixels; NaN without any."""

    psnr: float  # dB, with interpolated exposures (`Exposure.at`)
    fragments: float  # blended fragments per view
    fitted_psnr: float  # dB after an affine fit of each view's colours (`losses.color_fitted`)
    carried_psnr: float = math.nan  # dB with poses corrected as those of the nearest photographs
    refined_psnr: float = math.nan  # dB with poses aligned to the scene
    mean_exposure_psnr: float = math.nan  # dB with the mean exposure, where the run corrects photographs


@torch.no_grad()
def evaluate(
    scene: Scene,
    views: Sequence[View],
    config: TrainConfig,
    poses: Poses | None = None,
    exposure: Exposure | None = None,
) -> Quality:
    """Compare renders of a scene with photographs over the evaluation background.

    Args:
        views: at full size; each is read once.
        poses: of a run that refined them: views are also evaluated with poses carried over and aligned.
        exposure: views get corrections interpolated from the run's, if it has any.
    """
    device = scene.surfels["means"].device
    background = eval_background(config, device)
    values, fitted, along, refined, uncorrected, fragments = ([] for _ in range(6))
    corrections = None if exposure is None or exposure.table is None else exposure
    for view in (view.to(device) for view in views):
        if corrections is not None:
            view = view._replace(correction=corrections.at(view.file))
        output, rgb, target = view.drawn(scene, background)
        if corrections is not None:
            uncorrected.append(psnr(output.rgb.clamp(0.0, 1.0), target, view.mask))
        rgb = rgb.clamp(0.0, 1.0)
        values.append(psnr(rgb, target, view.mask))
        fitted.append(fitted_psnr(rgb, target, view.mask))
        fragments.append(len(output.fragments))
        del output  # frees its fragments before the next view is rendered
        if poses is not None:
            view = view._replace(camera=poses.carried(view.camera))
            along.append(view_psnr(scene, view, background))
            view = view._replace(camera=aligned(scene, view, background, config.loss.ssim_weight))
            refined.append(view_psnr(scene, view, background))
    mean_fragments = sum(fragments) / len(fragments) if fragments else math.nan
    means = map(mean_psnr, (fitted, along, refined, uncorrected))
    return Quality(mean_psnr(values), mean_fragments, *means)
