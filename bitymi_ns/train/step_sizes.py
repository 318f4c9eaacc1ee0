"""Step sizes of surfel positions in pixels of the photographs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bitymi_ns.ranges import spread
from bitymi_ns.scene.camera import Camera

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene
    from .schedules import Schedule

MEASURED = 64  # maximum number of training views to measure footprints in


@torch.no_grad()
def pixel_footprints(means: Tensor, cameras: Sequence[Camera], near: float, extent: float) -> Tensor:
    """Measure the side of a pixel at each surfel, [N] world units: depth over focal length in the nearest view that
    contains its centre; a surfel outside all views gets the median of the others.

    Args:
        means: [N, 3] world positions.
        near: near plane, camera z.
        extent: scene extent, world units; the depth if no view contains any surfel.
    """
    nearest = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        camera = camera.to(means.device)
        _, _, depth, inside = camera.project(means, near)
        nearest = torch.where(inside, torch.minimum(nearest, depth / _focal(camera)), nearest)
    seen = nearest[nearest.isfinite()]
    typical = seen.median() if len(seen) else extent / _focal(cameras[0].to(means.device))
    return torch.where(nearest.isfinite(), nearest, typical)


def _focal(camera: Camera) -> Tensor:
    """Average the focal lengths along both axes, pixels."""
    return 0.5 * (camera.K[0, 0] + camera.K[1, 1])


class StepSizes:
    """Learning rates per surfel.

    Attributes:
        footprints: [N] side of a pixel at each surfel, world units; empty until measured.
    """

    def __init__(self, schedule: Schedule, cameras: Sequence[Camera]) -> None:
        """`cameras`: the training cameras at full size."""
        self.schedule = schedule
        self.cameras = [cameras[i] for i in spread(len(cameras), MEASURED)]
        self._set(torch.zeros(0))

    def measure(self, scene: Scene, always: bool = True) -> None:
        """Measure the footprints; unless `always`, only if the number of surfels has changed."""
        if self.schedule.in_pixels and (always or len(self.footprints) != len(scene)):
            means = scene.surfels["means"].detach()
            self._set(pixel_footprints(means, self.cameras, scene.near, self.schedule.extent))

    def _set(self, footprints: Tensor) -> None:
        self.footprints = footprints
        self._typical = float(footprints.median()) if len(footprints) else 1.0
        self._relative = footprints / self._typical

    def rate(self, name: str, step: int) -> float:
        """Return the learning rate of a parameter, of the median surfel if they differ."""
        rate = self.schedule.lr(name, step)
        return rate * self._typical if name == "means" and self.schedule.in_pixels else rate

    def factors(self) -> dict[str, Tensor]:
        """Return rate factors [N] relative to `rate`, by name, of parameters with rates per surfel."""
        return {"means": self._relative} if self.schedule.in_pixels else {}

    def state_dict(self) -> dict[str, Any]:
        return {"footprints": self.footprints}

    def load_state_dict(self, state: Mapping[str, Any], device: torch.device) -> None:
        if self.schedule.in_pixels:
            self._set(state["footprints"].to(device))
