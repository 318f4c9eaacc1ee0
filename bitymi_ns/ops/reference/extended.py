"""Image formation in extended precision (numpy long double, 64-bit mantissa on x86-64), to check the float64 references
where these may lose digits. Written independently: planes through the camera centre instead of the adjugate. Inputs
with a tiny imaginary part give a directional derivative without differences (complex step, Squire and Trapp 1998): the
imaginary part of the result over that of the input is exact to rounding.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bitymi_ns.ops.project import Pinhole
from bitymi_ns.ops.reference.project import BETA_MAX, LOG_SCALE_MAX
from bitymi_ns.ops.reference.trace import ALPHA_MAX, ALPHA_MIN, SUPPORT, TRANSMITTANCE_MIN

Array = npt.NDArray[Any]  # clongdouble


@dataclass
class Extended:
    """Sums over the blended fragments of each pixel; P = H W pixels, row-major."""

    weight: Array  # [P, N]
    alpha: Array  # [P]
    depth: Array  # [P] sum of w z
    beta: Array  # [P] sum of w beta
    normal: Array  # [P, 3] sum of w n, camera frame
    blended: npt.NDArray[np.bool_]  # [P, N]
    low_pass: npt.NDArray[np.bool_]  # [P, N]


def render(geometry: Sequence[npt.ArrayLike], camera: Pinhole, near: float = 0.2) -> Extended:
    """Render every pixel against every surfel; arguments as `reference.render`, real or complex, without colours."""
    mean, q, logs, logit, raw, view, k = (
        np.asarray(a, dtype=np.clongdouble) for a in (*geometry, camera.viewmat, camera.K)
    )
    width, height = camera.width, camera.height
    known = (q.real != 0).any(-1)
    q = np.where(known[:, None], q, np.clongdouble(1))
    q = q / np.abs(q.real).max(-1, keepdims=True)
    w, x, y, z = (q / np.sqrt((q * q).sum(-1, keepdims=True))).T
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)  # [N, 3, 3]
    axes = view[:3, :3] @ rotation  # camera frame
    a, b, normal = axes[:, :, 0], axes[:, :, 1], axes[:, :, 2]
    # a rotation rounded to float32 is not orthonormal: use dual vectors for coordinates along a and b
    n = np.cross(a, b)
    dual_a, dual_b = np.cross(b, n), np.cross(n, a)
    dual_a, dual_b = dual_a / (dual_a * a).sum(-1, keepdims=True), dual_b / (dual_b * b).sum(-1, keepdims=True)
    p = mean @ view[:3, :3].T + view[:3, 3]  # [N, 3]
    valid = known & (p[:, 2].real > near)
    scale = np.exp(np.where(np.abs(logs.real) <= LOG_SCALE_MAX, logs, LOG_SCALE_MAX * np.sign(logs.real)))

    py, px = np.divmod(np.arange(width * height), width)
    ray = np.stack(
        [
            (px.astype(np.longdouble) + 0.5 - k[0, 2]) / k[0, 0],
            (py.astype(np.longdouble) + 0.5 - k[1, 2]) / k[1, 1],
            np.ones(len(px), np.clongdouble),
        ],
        axis=-1,
    )  # [P, 3]
    height_over = (p * n).sum(-1)  # [N]
    along = ray @ n.T  # [P, N]
    crosses = along.real != 0
    depth = height_over / np.where(crosses, along, 1)
    hit = crosses & (depth.real > near)
    depth = np.where(hit, depth, 1)
    offset = ray[:, None] * depth[..., None] - p  # [P, N, 3]
    u = np.where(hit, (offset * dual_a).sum(-1) / scale[:, 0], 0)
    v = np.where(hit, (offset * dual_b).sum(-1) / scale[:, 1], 0)
    rest = 1 - (u * u + v * v) / np.clongdouble(SUPPORT) ** 2
    inside = hit & (rest.real > 0)
    beta = BETA_MAX / (1 + np.exp(-raw))
    kernel = np.where(inside, np.exp(beta * np.log(np.where(inside, rest, 1))), 0)
    front = np.where(valid, p[:, 2], 1)
    center = np.stack([k[0, 0] * p[:, 0] / front + k[0, 2], k[1, 1] * p[:, 1] / front + k[1, 2]], -1).astype(k.dtype)
    dx, dy = px[:, None] + np.longdouble(0.5) - center[:, 0], py[:, None] + np.longdouble(0.5) - center[:, 1]
    blur = np.exp(-(dx * dx + dy * dy))
    low_pass = blur.real > kernel.real
    sigma = np.where(low_pass, blur, kernel) / (1 + np.exp(-logit))
    sigma = np.where(sigma.real > ALPHA_MAX, np.clongdouble(ALPHA_MAX), sigma)
    covered = valid & (sigma.real >= ALPHA_MIN)

    order = np.argsort(p[:, 2].real, kind="stable")
    sigma = np.where(covered, sigma, 0)[:, order]
    after = np.cumprod(1 - sigma, axis=1)
    blended = covered[:, order] & (after.real >= TRANSMITTANCE_MIN)
    sigma = np.where(blended, sigma, 0)
    before = np.cumprod(np.concatenate([np.ones_like(sigma[:, :1]), 1 - sigma], axis=1), axis=1)[:, :-1]
    back = np.argsort(order)
    weight, blended = (sigma * before)[:, back], blended[:, back]
    facing = np.where(((p * normal).sum(-1).real >= 0)[:, None], -normal, normal)
    return Extended(
        weight=weight,
        alpha=weight.sum(1),
        depth=(weight * np.where(low_pass, p[:, 2], depth)).sum(1),
        beta=weight @ beta,
        normal=weight @ facing,
        blended=blended,
        low_pass=low_pass,
    )
