"""What the training views see of every surfel: whether any fragment of it is blended, and through what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bitymi_ns.bake.progress import Progress, no_progress
from bitymi_ns.ops import project, trace
from bitymi_ns.scene.camera import Camera


@torch.no_grad()
def largest_transmittance(
    surfels: Mapping[str, Tensor],
    cameras: Sequence[Camera],
    near: float,
    prefilter: str = "low_pass",
    progress: Progress = no_progress,
) -> Tensor:
    """The largest transmittance in front of a blended fragment of every surfel, over all views.

    A fragment's weight is sigma T; the kernel gives sigma, this gives T. It is 0 for a surfel that no view blends.

    Args:
        surfels: the per-surfel parameters of docs/architecture.md, N rows, all of them finite and drawable.
        cameras: the views.
        near: nearest drawn depth.
        prefilter: as the scene is drawn, low_pass or pixel.
        progress: called after every view.

    Returns:
        [N] float32 in [0, 1].
    """
    means = surfels["means"]
    geometry = [surfels[name] for name in ("quats", "log_scales", "opacity_logits", "beta_raw")]
    largest = means.new_zeros(len(means))
    for done, camera in enumerate(cameras, start=1):
        fragments = trace(project(means, *geometry, camera.to(means.device), near, prefilter == "pixel"))
        in_front = fragments.weight / fragments.sigma.abs()  # its sign tells the low-pass branch
        largest.scatter_reduce_(0, fragments.surfel.long(), in_front, "amax")
        progress("looking through the training views", done, len(cameras))
    return largest
