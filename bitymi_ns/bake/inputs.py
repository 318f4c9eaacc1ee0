"""Inputs of the bake: surfels, training cameras, and what these see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.ops import TexelAlpha
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.visibility import Visibility

POINTS = 256  # of `photo_resolution`; each takes 22 bytes of bundle.json, and time in every frame


@dataclass(frozen=True)
class BakeInput:
    surfels: Mapping[str, Tensor]  # per-surfel parameters by name, N rows, float32
    cameras: Sequence[Camera]  # training views; there may be none
    # near, weight_bound: as the scene is drawn
    near: float
    weight_bound: float
    views: Visibility | None = None  # visibility in the cameras; None = not computed
    alpha: TexelAlpha | None = None  # opacities of the texels; None = opaque texels

    @property
    def transmittance(self) -> Tensor | None:
        """[N] largest transmittance in front of each surfel; None = 1."""
        return None if self.views is None else self.views.in_front

    def of(self, rows: Tensor) -> BakeInput:
        surfels = {name: value[rows] for name, value in self.surfels.items()}
        alpha, views = (None if part is None else part.of(rows) for part in (self.alpha, self.views))
        return replace(self, surfels=surfels, alpha=alpha, views=views)


def photo_resolution(inputs: BakeInput) -> Tensor | None:
    """Sample the resolution of the photographs (`scene/sampling.py`): [P, 4] float32 on the CPU, positions of surfels
    that views show, and the geometric mean over these views of focal length / depth, pixels per unit; None without
    views. Without visibility, a view shows the surfels whose centres project into its image."""
    if not inputs.cameras:
        return None
    means = inputs.surfels["means"]
    if inputs.views is None:
        seen = torch.stack([camera.to(means.device).project(means, inputs.near)[3] for camera in inputs.cameras])
    else:
        seen = inputs.views.seen
    rows = seen.any(0).nonzero().flatten()
    if not len(rows):
        return None
    count = min(POINTS, len(rows))
    rows = rows[(torch.arange(count, device=rows.device) * len(rows)) // count]
    means, seen = means[rows].double().cpu(), seen[:, rows].cpu()
    logs = torch.zeros(count, dtype=torch.float64)
    for camera, shown in zip(inputs.cameras, seen, strict=True):
        z = camera.to("cpu").project(means, inputs.near)[2]
        K = camera.K.double().cpu()
        logs += torch.where(shown, (torch.sqrt(K[0, 0] * K[1, 1]) / z.clamp(min=inputs.near)).log(), 0.0)
    return torch.cat([means, (logs / seen.sum(0)).exp()[:, None]], 1).float()
