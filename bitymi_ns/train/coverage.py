"""Which views see any of the surfels that training starts from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.scene import Scene

SAMPLE = 4096
"""Surfels that are looked for first: nearly all views see one of them."""
CHUNK = 1 << 20


@torch.no_grad()
def views_without_surfels(scene: Scene, cameras: Sequence[Camera]) -> list[int]:
    """Numbers of the views that no surfel can be seen in.

    A surfel counts as seen where the ball around it, as large as its disc, reaches beyond the near plane and into the
    picture.

    Args:
        scene: as training starts.
        cameras: of the views.
    """
    means = scene.surfels["means"].detach()
    radii = SUPPORT * scene.surfels["log_scales"].detach().exp().amax(-1)
    first = torch.randperm(len(means), generator=torch.Generator().manual_seed(0))[:SAMPLE].to(means.device)
    return [
        i
        for i, camera in enumerate(cameras)
        if not _sees(camera, means[first], radii[first], scene.near)
        and not any(
            _sees(camera, *chunk, scene.near) for chunk in zip(means.split(CHUNK), radii.split(CHUNK), strict=True)
        )
    ]


def _sees(camera: Camera, means: Tensor, radii: Tensor, near: float) -> bool:
    camera = camera.to(means.device)
    # no product of matrices: on a card cuBLAS would refuse where torch is asked for deterministic algorithms
    x, y, z = ((means[:, None] * camera.viewmat[:3, :3]).sum(-1) + camera.viewmat[:3, 3]).unbind(-1)
    K = camera.K
    depth = z.clamp(min=near)
    seen = z > near - radii
    for along, focal, middle, size in (
        (x, K[0, 0], K[0, 2], camera.width),
        (y, K[1, 1], K[1, 2], camera.height),
    ):
        at, reach = focal * along / depth + middle, focal * radii / depth
        seen &= (at > -reach) & (at < size + reach)
    return bool(seen.any())
