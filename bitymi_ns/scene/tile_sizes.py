"""Extents of surfel tiles, and their resolutions along each tangent axis."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bitymi_ns.ops.constants import ALPHA_MAX, BETA_MAX, SUPPORT
from .camera import Camera

MARGIN = 1.5
"""Factor of the transmittance in front of a surfel: held-out views may see more of it than training views."""
_ROUNDING = 1e-6  # relative tolerance: a rounded power of two must not double the tile


def next_power_of_two(x: Tensor) -> Tensor:
    """Round up to a power of two, with a relative tolerance of 1e-6; float64, 0 where x <= 0."""
    x = x.double().clamp(min=0.0, max=2.0**62) * (1.0 - _ROUNDING)
    mantissa, exponent = torch.frexp(x)  # x = mantissa 2^exponent, mantissa in [0.5, 1)
    exponent = exponent - (mantissa == 0.5).to(exponent.dtype)
    return torch.where(x > 0, torch.ldexp(torch.ones_like(x), exponent), torch.zeros_like(x))


def voxel_along_axes(voxel: Tensor, axes: Tensor, means: Tensor, center: Tensor | None = None) -> Tensor:
    """Compute the edge of the finest voxel along each tangent axis of a surfel, [N, 2], world units: the local delta of
    the Nyquist rule.

    Outside the unit ball of a contracted scene, voxels are elongated along the ray from the centre. With cos the
    component of an axis along that ray, a unit step crosses cos / radial voxels along the ray and sin / tangential
    ones across it; the edge is 1 over the root of the sum of their squares. Without a centre it is the smaller edge.

    Args:
        voxel: [N, 2] (radial, tangential) voxel edges at the surfels' centres, world units.
        axes: [N, 3, 2] unit tangent directions, world frame.
        means: [N, 3] surfel centres, world frame.
        center: [3] centre of the contraction, world frame.
    """
    if center is None:
        return voxel.amin(dim=1, keepdim=True).expand(-1, 2)
    ray = torch.nn.functional.normalize(means - center.to(means), dim=-1)  # [N, 3], zero at the centre
    cos2 = torch.einsum("nk,nka->na", ray, axes).square().clamp(max=1.0)  # [N, 2]
    radial, tangential = voxel[:, :1], voxel[:, 1:]
    return (cos2 / radial.square() + (1 - cos2) / tangential.square()).rsqrt()


def check_sides(r_min: int, r_max: int) -> None:
    """Raise ValueError if a limit of tile sides is no power of two >= 4, or `r_min` is larger than `r_max`."""
    for name, value in (("r_min", r_min), ("r_max", r_max)):
        if value < 4 or value & (value - 1):
            raise ValueError(f"{name} must be a power of two of at least 4 (a BC7 block is 4 x 4 texels), not {value}")
    if r_min > r_max:
        raise ValueError(f"r_min {r_min} is larger than r_max {r_max}")


def nyquist_resolution(
    scales: Tensor,
    delta: Tensor,
    extent: float = SUPPORT,
    r_min: int = 4,
    r_max: int = 64,
    max_pixels: Tensor | None = None,
) -> Tensor:
    """Compute tile resolutions at the Nyquist rate of the finest hash level, [N, 2] int32 (r_u, r_v), powers of two.

    Paper, eq. (nyquist): r_a = clamp(2^ceil(log2(4 e s_a / delta)), r_min, r_max); here r_a is also at most the next
    power of two of the largest projected extent in pixels.

    Args:
        scales: [N, 2] tangent scales s, world units.
        delta: [N, 2] (or [N, 1]) finest voxel edge at the surfel along each axis, world units.
        extent: e, half side of the tile in scale units; the paper uses 4.
        r_min, r_max: smallest and largest resolution, powers of two >= 4.
        max_pixels: [N, 2] largest projected extent of the tile over the training views, pixels; None: no such limit.
    """
    resolution = next_power_of_two(4.0 * extent * scales / delta)  # [N, 2]
    if max_pixels is not None:
        resolution = torch.minimum(resolution, next_power_of_two(max_pixels))
    return resolution.clamp(r_min, r_max).to(torch.int32)


def seen_sides(pixels: Tensor, r_min: int = 4, r_max: int = 64) -> Tensor:
    """Compute tile resolutions [N, 2] int32 (r_u, r_v), powers of two, from the largest projected extents `pixels`
    [N, 2] alone. Raises ValueError: as `check_sides`."""
    check_sides(r_min, r_max)
    return next_power_of_two(pixels).clamp(r_min, r_max).to(torch.int32)


def coarsened(sides: Tensor, texels: Tensor, r_min: int = 4) -> Tensor:
    """Halve the longer of the sides [N, 2] int32 of tiles until they have at most `texels` [N] texels each, or both
    sides are `r_min`."""
    sides = sides.clone()
    while True:
        wide = sides[:, 0] >= sides[:, 1]
        too_many = (sides.long().prod(1) > texels) & (sides.amax(1) > r_min)
        if not bool(too_many.any()):
            return sides
        sides[too_many & wide, 0] //= 2
        sides[too_many & ~wide, 1] //= 2


def max_projected_extent(
    means: Tensor, axes: Tensor, scales: Tensor, cameras: Sequence[Camera], extent: float = SUPPORT, near: float = 0.2
) -> Tensor:
    """Compute the largest projected size of each surfel's tile over the views, per tangent axis: [N, 2] pixels, 0 if no
    view counts.

    The segment from -e s_a to +e s_a along axis a is projected with the pinhole's Jacobian at the surfel's centre. A
    view counts if the centre lies beyond the near plane and within the image enlarged by the projected half extents.

    Args:
        means, scales: [N, 3] positions and [N, 2] tangent scales, world units.
        axes: [N, 3, 2] unit tangent directions, world frame.
        extent: e, half side of the tile in scale units.
        near: near plane, camera z.
    """
    max_pixels = torch.zeros_like(scales)  # [N, 2]
    steps = axes * (2.0 * extent * scales)[:, None, :]  # [N, 3, 2] whole side of the tile
    for camera in cameras:
        viewmat, K = camera.viewmat.to(means), camera.K.to(means)
        p = means @ viewmat[:3, :3].T + viewmat[:3, 3]  # [N, 3] camera frame
        t = torch.einsum("ck,nka->nca", viewmat[:3, :3], steps)  # [N, 3, 2] camera frame
        front = p[:, 2] > near
        z = torch.where(front, p[:, 2], torch.ones_like(p[:, 2]))[:, None]  # [N, 1]
        x, y = p[:, 0:1] / z, p[:, 1:2] / z
        du = K[0, 0] * (t[:, 0] - x * t[:, 2]) / z  # [N, 2] pixels across, per axis
        dv = K[1, 1] * (t[:, 1] - y * t[:, 2]) / z  # [N, 2] pixels down
        reach_x, reach_y = du.abs().sum(1) / 2, dv.abs().sum(1) / 2  # [N] half extents
        px, py = (K[0, 0] * x + K[0, 2])[:, 0], (K[1, 1] * y + K[1, 2])[:, 0]
        seen = front & (px > -reach_x) & (px < camera.width + reach_x)
        seen &= (py > -reach_y) & (py < camera.height + reach_y)
        pixels = torch.where(seen[:, None], torch.hypot(du, dv), torch.zeros_like(du))
        max_pixels = torch.maximum(max_pixels, pixels)
    return max_pixels


def kernel_parameters(surfels: Mapping[str, Tensor], transmittance: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Compute each surfel's largest blending weight [N] and its kernel exponent beta [N]. `transmittance`: [N] of
    `Visibility`; None: no occlusion."""
    opacity = surfels["opacity_logits"].sigmoid().clamp(max=ALPHA_MAX)
    if transmittance is not None:
        opacity = opacity * (MARGIN * transmittance).clamp(max=1.0)
    return opacity, BETA_MAX * surfels["beta_raw"].sigmoid()


def visible_extent(opacity: Tensor, beta: Tensor, weight_bound: float) -> Tensor:
    """Compute the radius [N], in scale units, at which opacity * (1 - r^2 / 9)^beta falls to the weight bound; 0 if all
    is below. The low pass spreads a surfel about a pixel beyond it, where the tile's edge is read."""
    rest = (weight_bound / opacity.clamp(min=1e-12)).clamp(max=1.0) ** (1.0 / beta.clamp(min=1e-6))
    return SUPPORT * (1.0 - rest).clamp(min=0.0).sqrt()
