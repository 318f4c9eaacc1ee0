"""Brute-force visibility in float64: blending weights of every surfel at every pixel."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from .project import Projection

SUPPORT = 3.0  # R: the kernel ends at 3 scale units
ALPHA_MAX = 0.99
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4


@dataclass
class Trace:
    """Dense blending weights: P pixels (y * width + x) against N surfels in input order."""

    weight: Tensor  # [P, N] w = sigma T, 0 where not blended
    uv: Tensor  # [P, N, 2] scale units; clamped to the support in the low-pass branch, 0 without a hit
    depth: Tensor  # [P, N] camera z of the hit; of the surfel's centre in the low-pass branch
    low_pass: Tensor  # [P, N] bool: the low pass exceeds the Beta kernel
    blended: Tensor  # [P, N] bool
    order: Tensor  # [N] surfels front to back
    transmittance: Tensor  # [P] remaining for the background


def pixel_centers(width: int, height: int) -> Tensor:
    """Return the sample positions (i + 0.5, j + 0.5) [H W, 2] float64, pixels, row-major."""
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    return torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5


def _power(base: Tensor, exponent: Tensor, floor: float) -> Tensor:
    """Compute base ** exponent; the derivative with respect to the base is divided by max(base, floor)."""
    if floor <= 0:
        return base**exponent
    fixed = base.detach()
    return torch.exp(exponent * (fixed.log() + (base - fixed) / fixed.clamp(min=floor)))


def _jacobian(projection: Projection) -> tuple[Tensor, Tensor]:
    """Compute J = d pixel / d (u, v) at the centre [N, 2, 2], and its depth [N], 1 if the surfel is not valid."""
    M, z = projection.M, torch.where(projection.valid, projection.depth, 1.0)
    return (M[:, :2, :2] - projection.mean2d[:, :, None] * M[:, 2:, :2]) / z[:, None, None], z


def _resized(projection: Projection, photo_pixel: float) -> tuple[Tensor, Tensor, float, float]:
    """Resize surfels for a view in which a photograph's pixel has the side `photo_pixel` (docs/numerics.md). Returns
    the factor of (u, v) [N, 2, 2], (1 + c' J^-1 J^-T)^(-1/2), and of the kernel's height [N]; the low pass's squared
    radius, and the factor of its height."""
    variance = max(0.0, (1 - photo_pixel**2) / 12)
    radius2 = photo_pixel**2 + 2 * variance
    J, _ = _jacobian(projection)
    unit = torch.eye(2, dtype=J.dtype).expand_as(J)
    seen = projection.valid & (torch.linalg.det(J) != 0)  # not exactly edge-on
    inverse = torch.linalg.inv(torch.where(seen[:, None, None], J, unit))
    blur = 2 * variance * (projection.beta + 2) / SUPPORT**2
    wide = unit + blur[:, None, None] * inverse @ inverse.transpose(-1, -2)
    values, vectors = torch.linalg.eigh(torch.where(seen[:, None, None], wide, unit))
    shrink = vectors @ torch.diag_embed(values**-0.5) @ vectors.transpose(-1, -2)
    return shrink, values.prod(-1) ** -0.5, radius2, photo_pixel**2 / radius2


def trace(
    projection: Projection,
    width: int,
    height: int,
    near: float = 0.2,
    rim: float = 0.0,
    photo_pixel: float = 1.0,
    factor: Callable[[Tensor, Tensor], Tensor] | None = None,
) -> Trace:
    """Compute intersections, effective opacities and front-to-back weights of all surfels at all pixels.

    With k = x M2 - M0, l = y M2 - M1 and c = k x l, the ray of pixel (x, y) meets the surfel at (u, v) = (c.x, c.y) /
    c.z, at camera depth M2 . (u, v, 1). Then sigma = min(0.99, o G) with the kernel
    G = max((1 - (u^2 + v^2) / 9)+^beta, exp(-d^2)), d the distance in pixels to the projected centre. A ray parallel to
    the surfel, or meeting it at a depth <= near, has no hit: the first term is 0 there and u = v = 0.
    A fragment is skipped if sigma < 1/255 or its surfel is not valid. Surfels are blended by the depths of their
    centres (equal depths: by index); the one that would reduce the transmittance below 1e-4 is not blended and ends the
    pixel. `rim` bounds 1 - x from below in the kernel's derivative only. `photo_pixel` is the side of a photograph's
    pixel in pixels of the view. Sigma is multiplied by `factor`, up to 0.99: [P, N] from uv [P, N, 2] and a mask of
    needed entries [P, N].
    """
    pixels = pixel_centers(width, height)  # [P, 2]
    M = projection.M
    k = pixels[:, None, 0:1] * M[None, :, 2] - M[None, :, 0]  # [P, N, 3]
    l = pixels[:, None, 1:2] * M[None, :, 2] - M[None, :, 1]
    c = torch.linalg.cross(k, l)
    crosses = c[..., 2] != 0
    uv = c[..., :2] / torch.where(crosses, c[..., 2], 1.0)[..., None]  # [P, N, 2]
    depth = (uv * M[None, :, 2, :2]).sum(-1) + M[None, :, 2, 2]  # [P, N]
    hit = crosses & (depth > near)
    uv = torch.where(hit[..., None], uv, 0.0)
    if photo_pixel != 1:
        shrink, peak, radius2, blur_peak = _resized(projection, photo_pixel)
        uv = (shrink @ uv[..., None])[..., 0]

    rest = 1 - (uv**2).sum(-1) / SUPPORT**2
    inside = hit & (rest > 0)
    kernel = torch.where(inside, _power(torch.where(inside, rest, 1.0), projection.beta, rim), 0.0)
    blur = torch.exp(-((pixels[:, None] - projection.mean2d[None]) ** 2).sum(-1))
    if photo_pixel != 1:
        kernel, blur = peak * kernel, blur_peak * blur ** (1 / radius2)
    low_pass = blur > kernel
    sigma = (projection.opacity * torch.where(low_pass, blur, kernel)).clamp(max=ALPHA_MAX)

    covered = projection.valid & (sigma >= ALPHA_MIN)
    uv = torch.where(low_pass[..., None], uv.clamp(-SUPPORT, SUPPORT), uv)
    if factor is not None:
        sigma = (sigma * factor(uv, covered)).clamp(max=ALPHA_MAX)
        covered = covered & (sigma >= ALPHA_MIN)
    order = torch.argsort(projection.depth, stable=True)
    sigma_sorted = torch.where(covered, sigma, 0.0)[:, order]
    after = torch.cumprod(1 - sigma_sorted, dim=1)  # [P, N] transmittance behind each surfel, were all blended
    blended_sorted = covered[:, order] & (after >= TRANSMITTANCE_MIN)
    sigma_sorted = torch.where(blended_sorted, sigma_sorted, 0.0)
    first = torch.ones(len(pixels), 1, dtype=pixels.dtype)
    transmittance = torch.cumprod(torch.cat([first, 1 - sigma_sorted], dim=1), dim=1)  # [P, N + 1]
    weight_sorted = sigma_sorted * transmittance[:, :-1]

    back = torch.argsort(order)
    return Trace(
        weight=weight_sorted[:, back],
        uv=uv,
        depth=torch.where(low_pass, projection.depth, depth),
        low_pass=low_pass,
        blended=blended_sorted[:, back],
        order=order,
        transmittance=transmittance[:, -1],
    )
