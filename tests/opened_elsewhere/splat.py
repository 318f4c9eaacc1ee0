"""3D Gaussians drawn as in 3DGS (elliptical weighted average, Zwicker et al. 2001), the reference for other programs'
pictures; torch on the CPU, one tile of the image at a time."""

import math

import torch
from torch import Tensor

from bitymi_ns.interchange import harmonics
from bitymi_ns.interchange.gaussians import Gaussians
from bitymi_ns.ops.constants import ALPHA_MAX, ALPHA_MIN, COLOR_BIAS, TILE, TRANSMITTANCE_MIN
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.init import tangents

DILATION = 0.3  # added to the variances of a footprint, pixels squared
REACH = 3.0  # radius of a footprint, in standard deviations along its longer axis
BEYOND = 1.3  # limit on |x / z| and |y / z| in the Jacobian, in half images
_AT_ONCE = 512


def gaussians(count: int) -> Gaussians:
    g = torch.Generator().manual_seed(3)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1)
    scales = torch.cat([-2.0 + 0.7 * torch.randn(count, 2, generator=g), torch.full((count, 1), -16.0)], 1)
    opacity = 2 * torch.randn(count, generator=g)
    return Gaussians(
        1.2 * torch.randn(count, 3, generator=g),
        quats,
        scales,
        opacity,
        0.3 * torch.randn(count, 16, 3, generator=g),
        torch.arange(count) % 2 == 0,
    )


@torch.no_grad()
def draw_gaussians(
    gaussians: Gaussians, camera: Camera, background: Tensor | None = None, near: float = 0.2, discs: bool = False
) -> Tensor:
    """Render a view.

    A Gaussian of covariance S has the footprint J W S W^T J^T + 0.3 I on the image, where W is the camera's rotation
    and J the Jacobian of the projection at its mean. A pixel blends alpha = min(0.99, o exp(-1/2 q)), front to back by
    the depths of the means, skips alpha < 1/255, and ends before the transmittance would fall below 1e-4.

    Args:
        gaussians: on the CPU, in the camera's world frame.
        camera: of an H x W view.
        background: [3]; None: black.
        near: near plane.
        discs: render `gaussians.hard` as discs of constant opacity: 1 instead of exp(-1/2 q) up to q = 4, 0 beyond.

    Returns:
        [H, W, 3] float32.
    """
    center, conic, reach, depth, rows = _footprints(gaussians, camera, near)
    directions = gaussians.means[rows] - camera.center
    directions = directions / directions.norm(dim=1, keepdim=True)
    colors = (harmonics.basis(directions)[..., None] * gaussians.harmonics[rows]).sum(1)
    colors = (colors + COLOR_BIAS).clamp(min=0)
    opacity = torch.sigmoid(gaussians.opacity_logits[rows])
    hard = gaussians.hard[rows] & discs
    behind = torch.zeros(3) if background is None else background
    image = torch.empty(camera.height, camera.width, 3)
    low, high = center - reach[:, None], center + reach[:, None]
    for top in range(0, camera.height, TILE):
        bottom = min(top + TILE, camera.height)
        band = torch.nonzero((low[:, 1] < bottom) & (high[:, 1] > top)).squeeze(1)
        for left in range(0, camera.width, TILE):
            right = min(left + TILE, camera.width)
            here = band[(low[band, 0] < right) & (high[band, 0] > left)]
            y, x = torch.meshgrid(torch.arange(top, bottom) + 0.5, torch.arange(left, right) + 0.5, indexing="ij")
            pixels = torch.stack([x, y], -1).reshape(-1, 2)
            if not len(here):
                image[top:bottom, left:right] = behind
                continue
            rgb, transmittance = _blend(pixels, center[here], conic[here], opacity[here], colors[here], hard[here])
            image[top:bottom, left:right] = (rgb + transmittance[:, None] * behind).view(bottom - top, right - left, 3)
    return image


def _footprints(gaussians: Gaussians, camera: Camera, near: float) -> tuple[Tensor, ...]:
    """Project the Gaussians, sorted front to back: centres [M, 2] in pixels, inverse covariances [M, 3] (xx, xy, yy),
    radii [M], depths [M], rows [M]; without those outside the image."""
    rotation, K = camera.viewmat[:3, :3], camera.K
    seen = gaussians.means @ rotation.T + camera.viewmat[:3, 3]
    rows = torch.nonzero(seen[:, 2] > near).squeeze(1)
    rows = rows[torch.argsort(seen[rows, 2], stable=True)]
    x, y, z = seen[rows].unbind(1)
    fx, fy = float(K[0, 0]), float(K[1, 1])
    limit_x, limit_y = (BEYOND * size / (2 * f) for size, f in ((camera.width, fx), (camera.height, fy)))
    a, b = (x / z).clamp(-limit_x, limit_x), (y / z).clamp(-limit_y, limit_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * a / z, zero, fy / z, -fy * b / z], dim=1).view(-1, 2, 3)
    tangent = tangents(gaussians.quats[rows])
    axes = torch.cat([tangent, torch.linalg.cross(tangent[..., :1], tangent[..., 1:], dim=1)], dim=2)
    half = jacobian @ rotation @ (axes * gaussians.log_scales[rows].exp()[:, None, :])  # [M, 2, 3]
    covariance = half @ half.transpose(1, 2)
    xx, xy, yy = covariance[:, 0, 0] + DILATION, covariance[:, 0, 1], covariance[:, 1, 1] + DILATION
    determinant = xx * yy - xy * xy
    middle = 0.5 * (xx + yy)
    largest = middle + (middle * middle - determinant).clamp(min=0.1).sqrt()
    reach = (REACH * largest.sqrt()).ceil()
    center = torch.stack([fx * x / z + K[0, 2], fy * y / z + K[1, 2]], dim=1)
    conic = torch.stack([yy, -xy, xx], dim=1) / determinant[:, None]
    inside = (determinant > 0) & ((center + reach[:, None]) > 0).all(1)
    inside &= (center[:, 0] - reach < camera.width) & (center[:, 1] - reach < camera.height)
    return center[inside], conic[inside], reach[inside], z[inside], rows[inside]


def _blend(
    pixels: Tensor, center: Tensor, conic: Tensor, opacity: Tensor, colors: Tensor, hard: Tensor
) -> tuple[Tensor, Tensor]:
    """Blend at pixels [P, 2]: colours [P, 3], final transmittance [P]."""
    rgb, transmittance = pixels.new_zeros(len(pixels), 3), pixels.new_ones(len(pixels))
    ended = torch.zeros(len(pixels), dtype=torch.bool)
    for part in torch.arange(len(center)).split(_AT_ONCE):
        dx, dy = (pixels[:, None] - center[part]).unbind(2)  # [P, M]
        xx, xy, yy = conic[part].unbind(1)
        exponent = -0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
        alpha = opacity[part] * torch.where(hard[part], (exponent >= -2.0).float(), exponent.exp())
        alpha = alpha.clamp(max=ALPHA_MAX)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0.0)
        after = transmittance[:, None] * torch.cumprod(1 - alpha, dim=1)
        blended = (after >= TRANSMITTANCE_MIN) & ~ended[:, None]
        before = torch.cat([transmittance[:, None], after[:, :-1]], dim=1)
        rgb += torch.where(blended, alpha * before, 0.0) @ colors[part]
        transmittance = torch.where(blended, after, math.inf).amin(1).minimum(transmittance)
        ended |= ~blended[:, -1]
        if bool(ended.all()):
            break
    return rgb, transmittance
