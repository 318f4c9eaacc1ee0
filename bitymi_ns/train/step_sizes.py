"""Steps of surfels in pixels of the photographs, whatever the scale of the capture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import spread

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene
    from bitymi_ns.train.schedules import Schedule

MEASURED = 64  # most training views that footprints are measured in, evenly spread
CHUNK = 1 << 18  # pairs of a view and a surfel that are measured together


@torch.no_grad()
def pixel_footprints(means: Tensor, cameras: Sequence[Camera], near: float, extent: float) -> Tensor:
    """Measure the side of a pixel at every surfel: depth over focal length in the nearest view that holds its centre.

    Args:
        means: [N, 3] world positions.
        cameras: the training cameras at full size.
        near: nearest drawn depth, camera z.
        extent: scene extent in world units, the depth that counts where no view holds any surfel.

    Returns:
        [N] in the dtype of `means`, world units; a surfel that no view holds gets the median of the others.
    """
    nearest = torch.full_like(means[:, 0], torch.inf)
    viewmats = torch.stack([camera.viewmat for camera in cameras]).to(means)  # [V, 4, 4]
    K = torch.stack([camera.K for camera in cameras]).to(means)  # [V, 3, 3]
    sizes = means.new_tensor([(camera.width, camera.height) for camera in cameras])  # [V, 2]
    for some in torch.arange(len(cameras), device=means.device).split(max(1, CHUNK // max(1, len(means)))):
        # no product of matrices: on a card cuBLAS would refuse where torch is asked for deterministic algorithms
        local = [
            (viewmats[some, axis, :3, None] * means.T).sum(1) + viewmats[some, axis, 3:] for axis in range(3)
        ]  # x, y, z, each [v, N]
        depth = local[2]
        inside = depth > near
        for axis in range(2):
            at = K[some, axis, axis, None] * local[axis] / depth + K[some, axis, 2, None]
            inside &= (at >= 0) & (at < sizes[some, axis, None])
        pixel = 2.0 * depth / (K[some, 0, 0] + K[some, 1, 1])[:, None]
        nearest = torch.minimum(nearest, torch.where(inside, pixel, torch.inf).amin(0))
    held = nearest[nearest.isfinite()]
    typical = held.median() if len(held) else 2.0 * extent / (K[0, 0, 0] + K[0, 1, 1])
    return torch.where(nearest.isfinite(), nearest, typical)


class StepSizes:
    """Learning rates of single surfels.

    Attributes:
        footprints: [N] side of a pixel at each surfel, world units; empty until they are measured.
    """

    def __init__(self, schedule: Schedule, cameras: Sequence[Camera]) -> None:
        """
        Args:
            schedule: of the run.
            cameras: the training cameras at full size.
        """
        self.schedule = schedule
        self.cameras = [cameras[i] for i in spread(len(cameras), MEASURED)]
        self._set(torch.zeros(0))

    def measure(self, scene: Scene, always: bool = True) -> None:
        """Measure the footprints of the surfels that there are now.

        Args:
            always: also where as many surfels have been measured already.
        """
        if self.schedule.in_pixels and (always or len(self.footprints) != len(scene)):
            means = scene.surfels["means"].detach()
            self._set(pixel_footprints(means, self.cameras, scene.near, self.schedule.extent))

    def _set(self, footprints: Tensor) -> None:
        self.footprints = footprints
        self._typical = float(footprints.median()) if len(footprints) else 1.0
        self._relative = footprints / self._typical

    def rate(self, name: str, step: int) -> float:
        """Return the learning rate of a parameter's optimiser: of the typical surfel, where surfels differ."""
        rate = self.schedule.lr(name, step)
        return rate * self._typical if name == "means" and self.schedule.in_pixels else rate

    def factors(self) -> dict[str, Tensor]:
        """Return the surfels' rates as multiples [N] of `rate`, by parameter; all others have one rate."""
        return {"means": self._relative} if self.schedule.in_pixels else {}

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run."""
        return {"footprints": self.footprints}

    def load_state_dict(self, state: Mapping[str, Any], device: torch.device) -> None:
        """Restore what `state_dict` returned."""
        self._set(state["footprints"].to(device))
