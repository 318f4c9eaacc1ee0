"""Pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV axes (x right, y down, z forward).

    Attributes:
        viewmat: [4, 4] float32, world to camera.
        K: [3, 3] float32, intrinsics in pixels; pixel (i, j) is sampled at (i + 0.5, j + 0.5).
        width, height: image size in pixels.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        if tuple(self.viewmat.shape) != (4, 4) or tuple(self.K.shape) != (3, 3):
            shapes = f"{tuple(self.viewmat.shape)} and {tuple(self.K.shape)}"
            raise ValueError(f"a camera needs viewmat [4, 4] and K [3, 3], not {shapes}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a camera needs a positive image size, not {self.width} x {self.height}")

    @cached_property
    def exact_center(self) -> Tensor:
        """Camera centre in the world frame, [3] float64: float32 is too coarse far from the origin."""
        with torch.inference_mode(False):  # an inference tensor could not enter an autograd graph later
            viewmat = self.viewmat.double()
            # no matrix product: cuBLAS fails if torch is set to deterministic algorithms
            return -(viewmat[:3, :3] * viewmat[:3, 3:]).sum(0)

    @property
    def center(self) -> Tensor:
        """`exact_center` in the dtype of `viewmat`."""
        return self.exact_center.to(self.viewmat)

    @cached_property
    def skewed(self) -> bool:
        """True if K has skew. Read before the camera moves to a device, to avoid a synchronisation later."""
        return float(self.K[0, 1]) != 0.0

    def _with(self, **changes: Any) -> Camera:
        skewed, camera = self.skewed, replace(self, **changes)
        camera.__dict__["skewed"] = skewed
        return camera

    def to(self, device: torch.device | str) -> Camera:
        """Move the camera to a device; copies from the CPU are asynchronous."""
        wait = self.K.device.type != "cpu"
        viewmat, K = (t.to(device, non_blocking=not wait) for t in (self.viewmat, self.K))
        if viewmat is self.viewmat and K is self.K:
            return self  # keeps cached properties
        return self._with(viewmat=viewmat, K=K)

    def posed(self, viewmat: Tensor) -> Camera:
        """Replace the pose by another world-to-camera matrix [4, 4] of any dtype and device."""
        return self._with(viewmat=viewmat.to(self.viewmat))

    def local(self, points: Tensor) -> Tensor:
        """Transform world points [M, 3], on the camera's device, to the camera frame."""
        # no matrix product: cuBLAS fails if torch is set to deterministic algorithms
        viewmat = self.viewmat.to(points.dtype)
        return (points[:, None] * viewmat[:3, :3]).sum(-1) + viewmat[:3, 3]

    def project(self, points: Tensor, near: float = 0.0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Project world points [M, 3] to pixel coordinates x, y and camera z, [M], and test if they are inside the
        image and beyond z = `near`, [M] bool; x and y are those of z clamped to it."""
        x, y, z = self.local(points).unbind(-1)
        depth, K = z.clamp(min=near), self.K.to(points.dtype)
        x, y = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
        return x, y, z, (z > near) & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)

    def unproject(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Unproject pixel coordinates [M] with camera z [M] to world points [M, 3], in the dtype of z."""
        viewmat, K = self.viewmat.to(z.dtype), self.K.to(z.dtype)
        local = torch.stack([(x - K[0, 2]) / K[0, 0] * z, (y - K[1, 2]) / K[1, 1] * z, z], -1)
        return (local - viewmat[:3, 3]) @ viewmat[:3, :3]

    def part(self, left: int, top: int, right: int, bottom: int) -> Camera:
        """Crop the image to columns `left` to `right` and rows `top` to `bottom` (both ends exclusive)."""
        shift = torch.zeros_like(self.K)
        shift[0, 2], shift[1, 2] = left, top
        return self._with(K=self.K - shift, width=right - left, height=bottom - top)

    def within(self, side: int) -> Camera:
        """Scale the image down to at most `side` pixels along its longer side."""
        return self.scaled(min(1.0, side / max(self.width, self.height)))

    def scaled(self, factor: float) -> Camera:
        """Scale the image by `factor` (size rounded to whole pixels)."""
        width = max(1, round(self.width * factor))
        height = max(1, round(self.height * factor))
        K = self.K.clone()
        K[0] *= width / self.width
        K[1] *= height / self.height
        return self._with(K=K, width=width, height=height)
