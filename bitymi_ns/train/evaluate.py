"""Quality of held-out views."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.losses import cc_psnr, mean_psnr, psnr
from bitymi_ns.train.views import View, eval_background

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import RenderOutput, Scene


class Quality(NamedTuple):
    """Means over views; NaN without views that count."""

    psnr: float  # dB, over the views of which any pixel counts
    fragments: float  # blended fragments per view
    cc_psnr: float  # dB after the affine fit of each view's colours (`losses.color_corrected`), over the same views


def evenly_spaced(count: int, most: int) -> list[int]:
    """At most `most` (0 = all) of the numbers below `count`, evenly spaced, the first and the last among them."""
    used = count if most <= 0 else min(count, most)
    return sorted({round(i * (count - 1) / max(1, used - 1)) for i in range(used)})


@torch.no_grad()
def held_out_quality(
    render: Callable[[Camera], RenderOutput], views: Sequence[View], background: Tensor | None, device: torch.device
) -> Quality:
    """Compare renders with photographs, one view after the other: only one fragment list is there at a time.

    Args:
        render: draws a camera over the background.
        views: at full size; each is asked for once.
        background: [3] colour behind the scene; None = black.
        device: of the renders.
    """
    values, corrected, fragments = [], [], []
    for view in (view.to(device) for view in views):
        output = render(view.camera)
        rgb, target = output.rgb.clamp(0.0, 1.0), view.target(background, device)
        values.append(psnr(rgb, target, view.mask))
        corrected.append(cc_psnr(rgb, target, view.mask))
        fragments.append(len(output.fragments))
        del output  # with its fragments, before the next view makes its own
    mean_fragments = sum(fragments) / len(fragments) if fragments else math.nan
    return Quality(mean_psnr(values), mean_fragments, mean_psnr(corrected))


def evaluate(scene: Scene, views: Sequence[View], config: TrainConfig) -> Quality:
    """`held_out_quality` of a trained scene, over the background on which views are judged."""
    device = scene.surfels["means"].device
    background = eval_background(config, device)
    return held_out_quality(
        lambda camera: scene.render(camera, background=background, field_mode="frozen"), views, background, device
    )
