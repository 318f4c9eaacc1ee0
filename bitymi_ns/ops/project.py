"""Projection of surfels into a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import torch
from torch import Tensor

from .backend import check_shapes, cuda_backend, dense, kernel, on_same_device
from .constants import FRAME, GEOM
from .parameters import GEOMETRY, GEOMETRY_PARAMETERS, Tensors
from .texel import TexelAlpha


class Pinhole(Protocol):
    """A pinhole camera of an image of width x height pixels."""

    @property
    def viewmat(self) -> Tensor: ...  # [4, 4] world to camera, OpenCV axes
    @property
    def K(self) -> Tensor: ...  # [3, 3] intrinsics in pixels
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...


class CameraLike(Pinhole, Protocol):
    """`scene.camera.Camera`, as far as it is used here."""

    @cached_property
    def skewed(self) -> bool: ...  # whether K[0, 1] is not 0
    @cached_property
    def exact_center(self) -> Tensor: ...  # [3] float64 camera centre, world
    def part(self, left: int, top: int, right: int, bottom: int) -> CameraLike: ...
    def local(self, points: Tensor) -> Tensor: ...


@dataclass
class Projection:
    """Surfels projected into a camera; rows of invisible surfels are zero.

    With (dx, dy) the offset in pixels from the projected centre (cx, cy), a pixel's ray meets the surfel at
    u = (u1 dx + u2 dy) / W, v = (v1 dx + v2 dy) / W, W = w0 + w1 dx + w2 dy, at depth z w0 / W (csrc/core/surfel.h).
    """

    geom: Tensor  # [N, 16] (`constants.GEOM`), differentiable
    frames: Tensor  # [N, 9] mean, s_u t_u, s_v t_v in the world frame, differentiable
    radii: Tensor  # [N, 2] half extents in pixels of the box in which a surfel can reach alpha 1/255; 0: not visible
    camera: CameraLike
    near: float  # nearest depth that is drawn, camera z
    broken: Tensor  # [1] int32, number of surfels dropped because a parameter is NaN or infinite
    photo_pixel: float = 1.0  # side of a photograph's pixel in pixels of the view; other than 1: for baked scenes
    # [N, 2] after backward: gradient with respect to the projected centre, in pixels; and with absolute values per
    # fragment before the sum
    mean2d_grad: Tensor | None = None
    mean2d_absgrad: Tensor | None = None
    whole: Projection | None = None  # the view of which this is a band (ops/bands.py)
    alpha: TexelAlpha | None = None  # None: opaque

    def detached(self) -> Projection:
        """Return the projection without its graph."""
        return replace(self, geom=self.geom.detach(), frames=self.frames.detach())

    def take_mean2d(self, grad: Tensor, absgrad: Tensor) -> None:
        """Store the gradients of the projected centres; those of bands are added up in the whole view."""
        if self.whole is None:
            self.mean2d_grad, self.mean2d_absgrad = grad, absgrad
        elif self.whole.mean2d_grad is None or self.whole.mean2d_absgrad is None:
            self.whole.mean2d_grad, self.whole.mean2d_absgrad = grad.clone(), absgrad
        else:
            self.whole.mean2d_grad += grad
            self.whole.mean2d_absgrad += absgrad

    def view(self, geom: Tensor) -> dict[str, Any]:
        """The kernels' arguments for a view (`View` of csrc/ops/visibility.h). `geom`: `self.geom`, detached."""
        size = {"width": self.camera.width, "height": self.camera.height, "near": self.near}
        return {"geom": geom, "radii": self.radii, **size, "photo_pixel": self.photo_pixel}

    @property
    def alpha_arrays(self) -> dict[str, Any]:
        """The kernels' arguments for alpha texels (`AlphaTiles` of csrc/ops/visibility.h); empty if opaque."""
        return {} if self.alpha is None else self.alpha.arrays

    @property
    def not_finite(self) -> int:
        """Number of broken surfels; waits for the device."""
        return int(self.broken)

    @cached_property
    def visible(self) -> Tensor:
        """[N] bool, True if the surfel can reach a pixel."""
        return self.radii[:, 0] > 0


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, near, photo_pixel, viewmat, *geometry):
        means = geometry[0]
        inputs = {name: dense(t, means) for name, t in zip(GEOMETRY, geometry, strict=True)}
        inputs |= {"viewmat": dense(viewmat, means), "K": dense(camera.K, means)}
        geom, frames, radii = (means.new_empty(len(means), k) for k in (GEOM, FRAME, 2))
        broken = torch.zeros(1, dtype=torch.int32, device=means.device)
        view = {"width": camera.width, "height": camera.height, "near": near, "photo_pixel": photo_pixel}
        kernel("project_forward", means)(**inputs, **view, geom=geom, frames=frames, radii=radii, broken=broken)
        ctx.names = tuple(inputs)
        ctx.save_for_backward(*inputs.values(), geom)
        ctx.mark_non_differentiable(radii, broken)
        ctx.set_materialize_grads(False)
        return geom, frames, radii, broken

    @staticmethod
    def backward(ctx, dgeom, dframes, _radii, _broken):
        *inputs, geom = ctx.saved_tensors
        dgeom = torch.zeros_like(geom) if dgeom is None else dense(dgeom, geom)
        dframes = None if dframes is None else dense(dframes, geom)

        def gradients(dframes: Tensor | None) -> list[Tensor]:
            out = [torch.empty_like(t) for t in inputs[: len(GEOMETRY)]]
            kernel("project_backward", geom)(
                **dict(zip(ctx.names, inputs, strict=True)),
                geom=geom,
                dgeom=dgeom,
                dframes=dframes,
                **{f"d{name}": gradient for name, gradient in zip(GEOMETRY, out, strict=True)},
            )
            return out

        out, dviewmat = gradients(dframes), None
        if ctx.needs_input_grad[3]:
            named = dict(zip(ctx.names, inputs, strict=True))
            dmeans, dquats = (out if dframes is None else gradients(None))[:2]  # frames are those of the world
            dviewmat = rigid_gradient(named["means"], named["quats"], dmeans, dquats, named["viewmat"])
        return None, None, None, dviewmat, *out


def rigid_gradient(means: Tensor, quats: Tensor, dmeans: Tensor, dquats: Tensor, viewmat: Tensor) -> Tensor:
    """Compute the gradient of a camera's pose `viewmat` [4, 4], restricted to rigid motions, from the gradients
    `dmeans` [N, 3] and `dquats` [N, 4] of the surfels, without the view colours' part.

    Moving the camera moves the surfels rigidly the other way in its frame: the force on the surfels is the sum of their
    gradients, the torque that of means x dmeans and of the quaternions' rotational part. Sums are in float64.
    """
    # surfels that are not finite are not drawn and have gradients of 0
    m, q = (t.double().nan_to_num(0.0, 0.0, 0.0) for t in (means, quats))
    dm, dq = dmeans.double(), dquats.double()
    turn = q[:, :1] * dq[:, 1:] - dq[:, :1] * q[:, 1:] + torch.linalg.cross(q[:, 1:], dq[:, 1:])
    torque = (torch.linalg.cross(m, dm) + 0.5 * turn).sum(0)
    rotation = viewmat[:3, :3].double()
    # elementwise: cuBLAS products raise under torch.use_deterministic_algorithms
    force, torque = (rotation * dm.sum(0)).sum(-1), (rotation * torque).sum(-1)
    gradient = torch.zeros(4, 4, dtype=torch.float64, device=viewmat.device)
    gradient[:3, :3] = 0.5 * torch.linalg.cross(torque[:, None], rotation, dim=0)
    gradient[:3, 3] = force
    return gradient.to(viewmat)


def refuse_skew(camera: CameraLike) -> None:
    """Raise ValueError for a camera whose K[0, 1] is not 0."""
    if camera.skewed:
        raise ValueError("cameras with skew (K[0, 1] != 0) are not supported: undistort the images first")


def geometry_of(surfels: Tensors) -> list[Tensor]:
    """List the surfels' parameters of `GEOMETRY`, missing ones with `Parameter.absent`. Raises KeyError: it has
    none."""
    means, geometry = surfels["means"], []
    for name, parameter in GEOMETRY_PARAMETERS.items():
        if name in surfels or parameter.absent is None:
            geometry.append(surfels[name])
        else:
            geometry.append(means.new_full((len(means), *parameter.shape), parameter.absent))
    return geometry


def checked_geometry(geometry: Sequence[Tensor], camera: CameraLike) -> Sequence[Tensor]:
    """Check and return `GEOMETRY`. Raises ValueError: shapes or devices do not match, or the camera has skew."""
    named, n = dict(zip(GEOMETRY, geometry, strict=True)), len(geometry[0])
    check_shapes(**{name: (value, (n, *GEOMETRY_PARAMETERS[name].shape)) for name, value in named.items()})
    on_same_device(geometry[0], **named)
    refuse_skew(camera)
    return geometry


def project(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    beta_raw: Tensor,
    camera: CameraLike,
    near: float = 0.2,
    photo_pixel: float = 1.0,
    alpha: TexelAlpha | None = None,
) -> Projection:
    """Project surfels into a camera (2DGS ray-splat formulation, centred on the projected mean).

    Args:
        means: [N, 3] world positions.
        quats: [N, 4] wxyz of any length.
        log_scales: [N, 2] natural logarithm of the tangent scales, world units; clamped to +-30.
        opacity_logits: [N], opacity = sigmoid.
        beta_raw: [N], beta = 4 sigmoid (eq. beta-kernel).
        camera: its `viewmat` may require a gradient (along rigid motions).
        near: surfels with a centre nearer than this (camera z) are dropped.
        photo_pixel: side of a photograph's pixel in pixels of the view (csrc/core/resize.h); if not 1, for the baked
            renderer on the CPU only and without gradients. The last column of geom is then the height of the low pass
            over that of the kernel.
        alpha: alpha texels; None: opaque.

    Raises:
        ValueError: as `checked_geometry`, or photo_pixel is not 1 with gradients or on a CUDA device.
    """
    if photo_pixel != 1.0 and (cuda_backend(means.device) or (torch.is_grad_enabled() and means.requires_grad)):
        raise ValueError("surfels are resized on the CPU and without gradients alone")
    geometry = checked_geometry((means, quats, log_scales, opacity_logits, beta_raw), camera)
    geom, frames, radii, broken = _Project.apply(camera, near, photo_pixel, camera.viewmat, *geometry)
    return Projection(geom, frames, radii, camera, near, broken, photo_pixel, alpha=alpha)
