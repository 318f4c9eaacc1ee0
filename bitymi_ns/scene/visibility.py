"""Visibility of every surfel in the training views: blended fragments, and the transmittance in front of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.ops import Prefilter, TexelAlpha, fitting_lists, project
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera

PART = 1 << 20  # fragments that are looked at together: what is computed of them then takes no memory from the system


@dataclass(frozen=True)
class Visibility:
    """Visibility of N surfels in the views.

    Attributes:
        transmittance: [N] float32 in [0, 1], the largest one in front of a blended fragment of the surfel, over all
            views: a fragment's weight is sigma T; the kernel gives sigma, this gives T. 0 for one that no view blends.
        pixels: [N] float32, how many pixels of the view that shows most of the surfel it makes up: the sum of its
            blending weights, of those that get a residual. A pixel is shared among its layers by weight.
        seen: [V, N] bool, whether the view blends a fragment of the surfel.
    """

    transmittance: Tensor
    pixels: Tensor
    seen: Tensor

    @property
    def in_front(self) -> Tensor:
        """[N] the transmittance to count with: 1 for surfels that no view blends, of which nothing is known."""
        return torch.where(self.transmittance > 0, self.transmittance, 1.0)

    def of(self, rows: Tensor) -> Visibility:
        """The same of some of the surfels."""
        return Visibility(self.transmittance[rows], self.pixels[rows], self.seen[:, rows])


@torch.no_grad()
def visibility(
    surfels: Mapping[str, Tensor],
    cameras: Sequence[Camera],
    near: float,
    weight_bound: float = 0.0,
    prefilter: Prefilter = "low_pass",
    progress: Progress = no_progress,
    alpha: TexelAlpha | None = None,
) -> Visibility:
    """Find the views that see every surfel, and the transmittance in front of it.

    Args:
        surfels: the per-surfel parameters of docs/overview.md, N rows, all of them finite and drawable.
        near: nearest drawn depth.
        weight_bound: fragments of smaller weight get no residual.
        prefilter: as in `ops.project`.
        alpha: opacities of the surfels' texels; None = opaque texels.
    """
    means = surfels["means"]
    geometry = [surfels[name] for name in ("quats", "log_scales", "opacity_logits", "beta_raw")]
    largest = means.new_zeros(len(means))
    pixels = torch.zeros_like(largest)
    seen = torch.zeros(len(cameras), len(means), dtype=torch.bool, device=means.device)
    for done, camera in enumerate(cameras, start=1):
        here = torch.zeros_like(pixels)
        projection = project(means, *geometry, camera.to(means.device), near, prefilter, alpha=alpha)
        for fragments in fitting_lists(projection):
            lists = (fragments.surfel, fragments.weight, fragments.sigma)
            for surfel, weight, sigma in zip(*(values.split(PART) for values in lists), strict=True):
                rows = surfel.long()
                largest.scatter_reduce_(0, rows, weight / sigma.abs(), "amax")  # its sign tells the low-pass branch
                here.index_add_(0, rows, torch.where(weight >= weight_bound, weight, 0.0).to(here.dtype))
                seen[done - 1, rows] = True
            del fragments, lists, surfel, weight, sigma  # before the next list is made
        pixels = torch.maximum(pixels, here)
        progress("looking through the training views", done, len(cameras))
    return Visibility(largest, pixels, seen)
