"""What is baked: the surfels that can be drawn, and from where they are seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import LeftOut
from bitymi_ns.codec.limits import within
from bitymi_ns.ops.constants import ALPHA_MIN
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.visibility import Visibility, visibility


@dataclass(frozen=True)
class BakeInput:
    """Surfels and the views of them.

    Attributes:
        surfels: per-surfel parameters by name, N rows, float32.
        cameras: training views; there may be none.
        near, weight_bound, through_pixel: as the scene is drawn.
        views: what the cameras see of the surfels; None = not looked at.
    """

    surfels: Mapping[str, Tensor]
    cameras: Sequence[Camera]
    near: float
    weight_bound: float
    through_pixel: bool
    views: Visibility | None = None

    @property
    def transmittance(self) -> Tensor | None:
        """[N] what is in front of a surfel where it is seen best; None = nothing is in front of any."""
        return None if self.views is None else self.views.in_front

    @property
    def seen(self) -> Tensor:
        """[V, N] bool, the views that see each surfel; V = 0 where they were not looked at."""
        means = self.surfels["means"]
        nothing = torch.zeros(0, len(means), dtype=torch.bool, device=means.device)
        return nothing if self.views is None else self.views.seen

    def of(self, rows: Tensor) -> BakeInput:
        """Some of the surfels."""
        surfels = {name: value[rows] for name, value in self.surfels.items()}
        return replace(self, surfels=surfels, views=None if self.views is None else self.views.of(rows))

    def looked_at(self, options: BakeOptions, progress: Progress = no_progress) -> BakeInput:
        """With what the cameras see, where there are any and the options need it."""
        if not self.cameras or not options.looks_at_views:
            return self
        return replace(
            self,
            views=visibility(self.surfels, self.cameras, self.near, self.weight_bound, self.through_pixel, progress),
        )


def device_of(cameras: Sequence[Camera]) -> torch.device:
    """The device of views, which looks through them; the CPU where there are none."""
    return cameras[0].viewmat.device if cameras else torch.device("cpu")


def drawable(surfels: Mapping[str, Tensor]) -> tuple[Tensor, LeftOut]:
    """Rows that can be drawn and that a bundle can hold, [N] int64, and how many were left out for which reason."""
    finite = torch.stack([torch.isfinite(value).flatten(1).all(1) for value in _as_rows(surfels)]).all(0)
    scales = surfels["log_scales"].exp()
    finite &= torch.isfinite(scales).all(1) & (scales > 0).all(1)
    turned = surfels["quats"].norm(dim=1)
    finite &= torch.isfinite(turned) & (turned > 1e-12)
    storable = finite & within(surfels, kind_of(surfels))
    transparent = storable & (surfels["opacity_logits"].sigmoid() < ALPHA_MIN)
    kept = torch.nonzero(storable & ~transparent).squeeze(1)
    return kept, LeftOut(
        not_finite=int((~finite).sum()),
        beyond_limits=int((finite & ~storable).sum()),
        transparent=int(transparent.sum()),
    )


def _as_rows(surfels: Mapping[str, Tensor]) -> list[Tensor]:
    """Every parameter with at least two dimensions."""
    return [value.detach() if value.dim() > 1 else value.detach()[:, None] for value in surfels.values()]
