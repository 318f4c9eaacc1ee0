"""Refinement of the training poses together with the scene.

A photograph's pose takes a Gauss-Newton step whenever it is rendered (docs/training.md, Poses). The L1 loss rises with
the absolute gradient a_i of each projected centre and levels off within about a pixel, which gives the curvature:

    step = -pixels (sum J_i^T a_i J_i)^-1 gradient,   J_i [2, 6] Jacobian of the centre in pixels

moves the image by `pixels` if all fragments agree on the direction, else by less. A common similarity of all cameras is
projected out, so that the scene stays in the capture's frame. Neighbouring photographs share the pose errors of
structure from motion: other cameras get the corrections of the nearest ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from .losses import photometric, psnr

if TYPE_CHECKING:
    from bitymi_ns.ops import Projection
    from bitymi_ns.scene.scene import Scene
    from .processes import Processes
    from .schedules import Schedule
    from .views import View

DAMPING = 0.01  # added to the curvature's diagonal, relative to it
NEIGHBOURS = 4  # photographs whose corrections are averaged for another camera
TRIES = 10  # renders to align a view
FIRST, SHORTEST = 0.7, 0.02  # first step of an alignment, and the one that ends it, pixels


def cross_matrix(vector: Tensor) -> Tensor:
    """Build the matrix [3, 3] of the cross product with a vector [3]."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)


def moved(viewmat: Tensor, motion: Tensor) -> Tensor:
    """Apply a rigid motion to a pose [4, 4] float64, world to camera, differentiably. `motion`: [6] float64, rotation
    vector about the camera centre and translation, in world axes."""
    rotation = viewmat[:3, :3] @ torch.linalg.matrix_exp(-cross_matrix(motion[:3]))
    center = -viewmat[:3, :3].T @ viewmat[:3, 3] + motion[3:]
    top = torch.cat([rotation, -(rotation @ center)[:, None]], 1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def pose_step(gradient: Tensor, projection: Projection, pixels: float) -> Tensor:
    """Compute the Gauss-Newton step of a camera after the backward pass of a loss.

    Args:
        gradient: [6] float64, of the loss with respect to the motion (`moved`).
        projection: of the view.
        pixels: image motion if all fragments agree on the direction.

    Returns:
        [6] float64 motion on the CPU; 0 if no surfel was visible.
    """
    weight = projection.mean2d_absgrad
    if weight is None or not bool(gradient.isfinite().all()):
        return torch.zeros(6, dtype=torch.float64)
    camera = projection.camera
    rotation = camera.viewmat.detach().double().cpu()[:3, :3]
    rows = (projection.visible & weight.isfinite().all(1)).nonzero().flatten()
    x, y, z = camera.local(projection.frames.detach()[rows, :3]).detach().unbind(-1)
    x, y, zero = x / z, y / z, torch.zeros_like(z)
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    # a rotation w and a translation s in camera axes move a point p by p x w - s
    across = fx * torch.stack([x * y, -(1.0 + x * x), y, -1.0 / z, zero, x / z], -1)
    down = fy * torch.stack([1.0 + y * y, -x * y, -x, zero, -1.0 / z, y / z], -1)
    curvature = torch.zeros(6, 6, dtype=torch.float64, device=z.device)
    for jacobian, a in zip((across.double(), down.double()), weight[rows].double().unbind(1), strict=True):
        # no matrix product: cuBLAS fails if torch is set to deterministic algorithms
        curvature += (a[:, None, None] * jacobian[:, :, None] * jacobian[:, None, :]).sum(0)
    curvature = curvature.cpu()
    scale = curvature.diagonal().sqrt()
    if not bool((scale > 0).all()) or not bool(scale.isfinite().all()):
        return torch.zeros(6, dtype=torch.float64)
    curvature = curvature / scale[:, None] / scale + DAMPING * torch.eye(6, dtype=torch.float64)
    local = torch.cat([rotation @ gradient[:3], rotation @ gradient[3:]])
    step = -torch.linalg.solve(curvature, local / scale)
    square = float(step @ (curvature @ step) / weight[rows].double().sum())  # mean squared image motion, pixels^2
    step = step / scale * (pixels / max(1.0, math.sqrt(square)))
    return torch.cat([rotation.T @ step[:3], rotation.T @ step[3:]])


class Poses:
    """Pose corrections of the training photographs.

    Attributes:
        motions: [V, 6] float64 on the CPU, of each camera (`moved`); None: poses are not refined.
    """

    def __init__(self, schedule: Schedule, cameras: Sequence[Camera]) -> None:
        """`cameras`: training cameras, with the poses of the capture."""
        self.schedule = schedule
        self.motions: Tensor | None = None
        self._cameras = cameras
        self._learning: list[tuple[int, Tensor]] = []
        if schedule.config.refine_poses == "on":
            self.motions = torch.zeros(len(cameras), 6, dtype=torch.float64)

    @cached_property
    def _given(self) -> Tensor:
        """Poses of the capture, [V, 4, 4] float64 on the CPU, world to camera."""
        return torch.stack([camera.viewmat.double().cpu() for camera in self._cameras])

    @cached_property
    def _gauge(self) -> Tensor:
        return gauge(-(self._given[:, :3, :3] * self._given[:, :3, 3:]).sum(1), self.schedule.extent)

    @property
    def refined(self) -> bool:
        """True if poses are refined, or were before the run was resumed."""
        return self.motions is not None

    def begin(self) -> None:
        """Discard what `learning` returned in an unfinished step."""
        self._learning = []

    def of(self, index: int, camera: Camera) -> Camera:
        """Return the camera of a training view, at any image size, with its corrected pose."""
        if self.motions is None:
            return camera
        return camera.posed(moved(self._given[index], self.motions[index]))

    def learning(self, index: int, camera: Camera, step: int) -> Camera:
        """Return the camera of a training view for a step; its pose gets a gradient if the step refines poses."""
        if self.motions is None or self.schedule.pose_pixels(step) == 0.0:
            return self.of(index, camera)
        motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        self._learning.append((index, motion))
        return camera.posed(moved(moved(self._given[index], self.motions[index]), motion))

    @torch.no_grad()
    def step(self, projections: Sequence[Projection], pixels: float, processes: Processes) -> None:
        """Update the poses of a step's views, after the backward passes. `projections`: in the order of `learning`.
        `pixels`: see `pose_step`."""
        learning, self._learning = self._learning, []
        if self.motions is None or pixels == 0.0:
            return
        steps = torch.zeros_like(self.motions)
        for (index, motion), projection in zip(learning, projections, strict=True):
            if motion.grad is not None:
                steps[index] += pose_step(motion.grad, projection, pixels)
        processes.sum(steps)
        unit = steps.new_tensor([1.0] * 3 + [1.0 / self.schedule.extent] * 3)
        flat = (steps * unit).flatten()
        free = flat - self._gauge @ (self._gauge.T @ flat)
        # small rotations: their vectors add up
        self.motions = self.motions + free.view_as(steps) / unit

    def carried(self, camera: Camera) -> Camera:
        """Correct a camera that is not a training photograph's, see `carried`."""
        return camera if self.motions is None else carried(camera, self._given, self.motions)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run."""
        return {"motions": self.motions}

    def load_state_dict(self, state: Mapping[str, Any] | None) -> None:
        """Restore what `state_dict` returned, also in a run that does not refine poses; not for another number of
        photographs. `state`: None: a checkpoint from before poses were refined."""
        motions = None if state is None else state["motions"]
        if motions is not None and len(motions) == len(self._cameras):
            self.motions = motions


def carried(camera: Camera, given: Tensor, motions: Tensor) -> Camera:
    """Correct a camera of the capture by the mean motion of the nearest photographs, weighted by distance and
    direction. `given`, `motions`: [V, 4, 4] float64 poses in the capture, and [V, 6] their corrections (`moved`)."""
    viewmat = camera.viewmat.double().cpu()
    centers = -(given[:, :3, :3] * given[:, :3, 3:]).sum(1)
    reach = (centers - centers.mean(0)).square().sum(1).amax().clamp(min=1e-30)
    translation = (centers - camera.exact_center.cpu()).square().sum(1) / reach
    rotation = 0.5 * (given[:, :3, :3] - viewmat[:3, :3]).square().sum((1, 2))
    distance, rows = (translation + rotation).topk(min(NEIGHBOURS, len(given)), largest=False)
    weight = 1.0 / (distance + 1e-8)
    return camera.posed(moved(viewmat, (weight[:, None] * motions[rows]).sum(0) / weight.sum()))


def gauge(centers: Tensor, extent: float) -> Tensor:
    """Compute an orthonormal basis [V * 6, D] of the similarities of all cameras. `centers`: [V, 3] float64, world.
    `extent`: unit of length of translations."""
    arms = (centers - centers.mean(0)) / extent
    rows = torch.zeros(7, len(centers), 6, dtype=torch.float64)
    for axis in range(3):
        unit = torch.zeros(3, dtype=torch.float64)
        unit[axis] = 1.0
        rows[axis, :, :3] = unit
        rows[axis, :, 3:] = torch.linalg.cross(unit.expand_as(arms), arms)
        rows[3 + axis, :, 3:] = unit
    rows[6, :, 3:] = arms
    left, sizes, _ = torch.linalg.svd(rows.flatten(1).T, full_matrices=False)
    return left[:, sizes > 1e-6 * sizes[0]]


@torch.no_grad()
def view_psnr(scene: Scene, view: View, background: Tensor | None) -> float:
    """Compute the PSNR, dB, of a scene over a background against a photograph on its device."""
    _, rgb, target = view.drawn(scene, background)
    return psnr(rgb.clamp(0.0, 1.0), target, view.mask)


@torch.enable_grad()
def aligned(scene: Scene, view: View, background: Tensor | None, ssim_weight: float) -> Camera:
    """Align a camera to a fixed scene by the photometric loss. `view`: on the scene's device, at full size.
    `background`: [3]; None: black."""

    def judge(viewmat: Tensor) -> tuple[float, Tensor, Projection]:
        motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        posed = view._replace(camera=view.camera.posed(moved(viewmat, motion)))
        output, rgb, target = posed.drawn(scene, background)
        loss = photometric(rgb, target, ssim_weight, view.mask)
        (gradient,) = torch.autograd.grad(loss, motion)
        return float(loss.detach()), gradient, output.projection

    best = view.camera.viewmat.double().cpu()
    least, *slope = judge(best)
    pixels = FIRST
    for _ in range(TRIES):
        if pixels < SHORTEST:
            break
        candidate = moved(best, pose_step(*slope, pixels))
        loss, *candidate_slope = judge(candidate)
        if loss < least:
            best = candidate
            least = loss
            slope = candidate_slope
            pixels = 1.5 * pixels
        else:
            pixels *= 0.4
    return view.camera.posed(best)
