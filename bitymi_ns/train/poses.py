"""Poses of the training photographs, refined beside the scene, and of other cameras that are carried along.

A photograph's pose moves by a Gauss-Newton step whenever it is shown. Its gradient is that of the loss along rigid
motions (`ops.project`). Its curvature comes from the surfels: an L1 loss over a pixel's error rises with the absolute
gradient a_i of each projected centre, and levels off within about a pixel. So with J_i [2, 6], how far the centre moves
in pixels,

    step = -pixels (sum J_i^T a_i J_i)^-1 gradient

moves the picture by `pixels` where all fragments agree on the direction, and less the less they agree.

What moves all cameras together (a rotation, a shift, a scale of the world) changes no picture once the scene follows:
it is taken out of every step, so that the scene stays where the capture has it.

Errors of poses from structure from motion are smooth: neighbours share them. A camera that no photograph belongs to
is therefore carried along by the corrections of the photographs nearest to it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.losses import photometric, psnr

if TYPE_CHECKING:
    from bitymi_ns.ops import Projection
    from bitymi_ns.scene.scene import Scene
    from bitymi_ns.train.processes import Processes
    from bitymi_ns.train.schedules import Schedule
    from bitymi_ns.train.views import View

DAMPING = 0.01  # share of the curvature's diagonal that is added to it
NEIGHBOURS = 4  # photographs whose corrections carry a camera along
TRIES = 10  # most renders to align a view
FIRST, SHORTEST = 0.7, 0.02  # pixels of the first step of an alignment, and of the step that ends it


def cross_matrix(vector: Tensor) -> Tensor:
    """Build the matrix [3, 3] of the cross product with a vector [3]."""
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)


def moved(viewmat: Tensor, motion: Tensor) -> Tensor:
    """Move a camera.

    Args:
        viewmat: [4, 4] float64, world to camera.
        motion: [6] float64: rotation vector about its centre and shift of its centre, both in world axes.

    Returns:
        [4, 4] float64, differentiable in the motion.
    """
    rotation = viewmat[:3, :3] @ torch.linalg.matrix_exp(-cross_matrix(motion[:3]))
    center = -viewmat[:3, :3].T @ viewmat[:3, 3] + motion[3:]
    top = torch.cat([rotation, -(rotation @ center)[:, None]], 1)
    return torch.cat([top, top.new_tensor([[0.0, 0.0, 0.0, 1.0]])])


def pose_step(gradient: Tensor, projection: Projection, pixels: float) -> Tensor:
    """Find the step of a camera after the backward pass of a loss.

    Args:
        gradient: [6] float64 of the loss with respect to a motion as in `moved`.
        projection: of the view.
        pixels: how far the picture moves where all fragments agree.

    Returns:
        [6] float64 motion on the CPU; 0 where nothing was seen.
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
    # a turn w and a shift s in the camera's axes move a point p by p x w - s
    across = fx * torch.stack([x * y, -(1.0 + x * x), y, -1.0 / z, zero, x / z], -1)
    down = fy * torch.stack([1.0 + y * y, -x * y, -x, zero, -1.0 / z, y / z], -1)
    curvature = torch.zeros(6, 6, dtype=torch.float64, device=z.device)
    for rows_of, a in zip((across.double(), down.double()), weight[rows].double().unbind(1), strict=True):
        # no product of matrices: on a card cuBLAS would refuse where torch is asked for deterministic algorithms
        curvature += (a[:, None, None] * rows_of[:, :, None] * rows_of[:, None, :]).sum(0)
    curvature = curvature.cpu()
    scale = curvature.diagonal().sqrt()
    if not bool((scale > 0).all()) or not bool(scale.isfinite().all()):
        return torch.zeros(6, dtype=torch.float64)
    curvature = curvature / scale[:, None] / scale + DAMPING * torch.eye(6, dtype=torch.float64)
    local = torch.cat([rotation @ gradient[:3], rotation @ gradient[3:]])
    step = -torch.linalg.solve(curvature, local / scale)
    square = float(step @ (curvature @ step) / weight[rows].double().sum())  # mean of the picture's motion, pixels
    step = step / scale * (pixels / max(1.0, math.sqrt(square)))
    return torch.cat([rotation.T @ step[:3], rotation.T @ step[3:]])


class Poses:
    """Corrections of the poses of a run's photographs.

    Attributes:
        motions: [V, 6] float64 on the CPU: how the camera of each photograph is moved, see `moved`; None = none is.
    """

    def __init__(self, schedule: Schedule, cameras: Sequence[Camera]) -> None:
        """
        Args:
            cameras: of the training views at full size, with the poses of the capture.
        """
        self.schedule = schedule
        self.motions: Tensor | None = None
        self._cameras = cameras
        self._learning: list[tuple[int, Tensor]] = []
        if schedule.config.refine_poses == "on":
            self.motions = torch.zeros(len(cameras), 6, dtype=torch.float64)

    @cached_property
    def _given(self) -> Tensor:
        """[V, 4, 4] float64 on the CPU: the poses of the capture."""
        return torch.stack([camera.viewmat.double().cpu() for camera in self._cameras])

    @cached_property
    def _centers(self) -> Tensor:
        return -(self._given[:, :3, :3] * self._given[:, :3, 3:]).sum(1)

    @cached_property
    def _gauge(self) -> Tensor:
        return gauge(self._centers, self.schedule.extent)

    @property
    def refined(self) -> bool:
        """True where the poses of the photographs have moved, or will."""
        return self.motions is not None

    def begin(self) -> None:
        """Forget the cameras that a step was asked for and did not use."""
        self._learning = []

    def of(self, index: int, camera: Camera) -> Camera:
        """The camera of a training view, at any size, where it is by now."""
        if self.motions is None:
            return camera
        return camera.posed(moved(self._given[index], self.motions[index]))

    def learning(self, index: int, camera: Camera, step: int) -> Camera:
        """Do the same for a training step: where the poses learn, the pose gets a gradient."""
        if self.motions is None or self.schedule.pose_pixels(step) == 0.0:
            return self.of(index, camera)
        motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        self._learning.append((index, motion))
        return camera.posed(moved(moved(self._given[index], self.motions[index]), motion))

    @torch.no_grad()
    def step(self, projections: Sequence[Projection], pixels: float, processes: Processes) -> None:
        """Move the cameras of a step's views, after the backward passes.

        Args:
            projections: of the views, in the order in which `learning` was asked for their cameras.
            pixels: see `pose_step`.
            processes: of the run.
        """
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
        # turns are small: their vectors add up
        self.motions = self.motions + free.view_as(steps) / unit

    def carried(self, camera: Camera) -> Camera:
        """Carry a camera that belongs to no training photograph along, see `carried`."""
        return camera if self.motions is None else carried(camera, self._given, self.motions)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run."""
        return {"motions": self.motions}

    def load_state_dict(self, state: Mapping[str, Any] | None) -> None:
        """Continue where `state_dict` was taken. Poses that were refined stay so where they are refined no further.

        Args:
            state: None = of a run from before poses were refined; that of other photographs is left.
        """
        motions = None if state is None else state["motions"]
        if motions is not None and len(motions) == len(self._cameras):
            self.motions = motions


def carried(camera: Camera, given: Tensor, motions: Tensor) -> Camera:
    """Carry a camera along with the photographs nearest to it, by distance and direction.

    Args:
        camera: in the frame of the capture.
        given: [V, 4, 4] float64 poses of the photographs in the capture, world to camera.
        motions: [V, 6] float64 how they were moved.
    """
    viewmat = camera.viewmat.double().cpu()
    centers = -(given[:, :3, :3] * given[:, :3, 3:]).sum(1)
    reach = (centers - centers.mean(0)).square().sum(1).amax().clamp(min=1e-30)
    apart = (centers - camera.exact_center.cpu()).square().sum(1) / reach
    turned = 0.5 * (given[:, :3, :3] - viewmat[:3, :3]).square().sum((1, 2))
    distance, rows = (apart + turned).topk(min(NEIGHBOURS, len(given)), largest=False)
    weight = 1.0 / (distance + 1e-8)
    return camera.posed(moved(viewmat, (weight[:, None] * motions[rows]).sum(0) / weight.sum()))


def gauge(centers: Tensor, extent: float) -> Tensor:
    """Find an orthonormal basis [V * 6, D] of the motions of all cameras together: rotations, shifts, scale.

    Args:
        centers: [V, 3] float64 world positions of the cameras.
        extent: length that a shift is measured in.
    """
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
    """Compare a scene, over a background, with a photograph on its device: PSNR in dB."""
    output = scene.render(view.camera, background, "frozen")
    rgb = view.shown(output.rgb, output.alpha, background).clamp(0.0, 1.0)
    return psnr(rgb, view.target(background, rgb.device), view.mask)


@torch.enable_grad()
def aligned(scene: Scene, view: View, background: Tensor | None, ssim_weight: float) -> Camera:
    """Find the pose from which a scene, as it is, resembles a photograph most, near the one that is given.

    Args:
        view: on the scene's device, at full size.
        background: [3] colour behind the scene; None = black.
        ssim_weight: of the photometric loss.
    """
    target = view.target(background, scene.surfels["means"].device)

    def judge(viewmat: Tensor) -> tuple[float, Tensor, Projection]:
        motion = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        output = scene.render(view.camera.posed(moved(viewmat, motion)), background, "frozen")
        rgb = view.shown(output.rgb, output.alpha, background)
        loss = photometric(rgb, target, ssim_weight, view.mask)
        (gradient,) = torch.autograd.grad(loss, motion)
        return float(loss.detach()), gradient, output.projection

    best = view.camera.viewmat.double().cpu()
    least, *found = judge(best)
    pixels = FIRST
    for _ in range(TRIES):
        if pixels < SHORTEST:
            break
        candidate = moved(best, pose_step(*found, pixels))
        loss, *there = judge(candidate)
        if loss < least:
            best, least, found, pixels = candidate, loss, there, 1.5 * pixels
        else:
            pixels *= 0.4
    return view.camera.posed(best)
