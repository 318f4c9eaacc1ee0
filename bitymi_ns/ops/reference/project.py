"""Projection of surfels in float64, without optimisations."""

from dataclasses import dataclass

import torch
from torch import Tensor

BETA_MAX = 4.0
LOG_SCALE_MAX = 30.0
NORM_FLOOR = 1e-12


def unit(x: Tensor) -> Tensor:
    """Normalise [..., C]; lengths below 1e-12 are divided by 1e-12."""
    return torch.nn.functional.normalize(x, dim=-1, eps=NORM_FLOOR)


def rotation(quats: Tensor) -> Tensor:
    """Convert quaternions wxyz [N, 4] of any length to rotation matrices [N, 3, 3]."""
    largest = quats.detach().abs().amax(-1, keepdim=True)  # so that no length underflows
    w, x, y, z = unit(quats / torch.where(largest > 0, largest, torch.ones_like(largest))).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


@dataclass
class Projection:
    """N surfels projected into a camera."""

    M: Tensor  # [N, 3, 3], takes (u, v, 1) to (x z, y z, z): x, y in pixels, z the camera's depth
    mean2d: Tensor  # [N, 2] projected centre, pixels; 0 if not valid
    depth: Tensor  # [N] camera z of the centre
    opacity: Tensor  # [N] in (0, 1)
    beta: Tensor  # [N] in (0, 4)
    normal: Tensor  # [N, 3] unit normal on the side of the camera, camera frame (OpenCV)
    frame: Tensor  # [N, 3, 3] world frame, rows: mean, s_u t_u, s_v t_v
    valid: Tensor  # [N] bool: the centre is deeper than `near`, and the quaternion is not 0


def project(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    opacity_logits: Tensor,
    beta_raw: Tensor,
    viewmat: Tensor,
    K: Tensor,
    near: float = 0.2,
) -> Projection:
    """Compute homography, centre and kernel parameters of each surfel (2DGS: Huang et al. 2024, eq. 5 to 9).

    Arguments are those of `ops.project`; `viewmat` [4, 4] and `K` [3, 3] are a camera's. A surfel's point is
    mean + u s_u t_u + v s_v t_v, with t_u, t_v the first two columns of its rotation. M's columns are K times the
    camera-frame s_u t_u, s_v t_v and mean.
    """
    R = rotation(quats)  # [N, 3, 3]
    tangents = R[:, :, :2] * log_scales.clamp(-LOG_SCALE_MAX, LOG_SCALE_MAX).exp()[:, None, :]  # [N, 3, 2] world
    view_R, view_t = viewmat[:3, :3], viewmat[:3, 3]
    center = means @ view_R.T + view_t  # [N, 3] camera
    H = torch.cat([view_R @ tangents, center[:, :, None]], dim=-1)  # [N, 3, 3]
    M = K @ H

    depth = center[:, 2]
    valid = (depth > near) & (quats != 0).any(-1)
    z = torch.where(valid, depth, torch.ones_like(depth))
    mean2d = torch.where(valid[:, None], M[:, :2, 2] / z[:, None], torch.zeros_like(M[:, :2, 2]))

    normal = R[:, :, 2] @ view_R.T  # [N, 3] camera
    away = (normal * center).sum(-1, keepdim=True) >= 0
    return Projection(
        M=M,
        mean2d=mean2d,
        depth=depth,
        opacity=torch.sigmoid(opacity_logits),
        beta=BETA_MAX * torch.sigmoid(beta_raw),
        normal=torch.where(away, -normal, normal),
        frame=torch.stack([means, tangents[..., 0], tangents[..., 1]], dim=1),
        valid=valid,
    )
