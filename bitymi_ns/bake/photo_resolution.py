"""How large the photographs show the scene: points of it with the pixels per unit of length, by which the renderers
tell how large a view shows it (scene/sampling.py)."""

from __future__ import annotations

import torch
from torch import Tensor

from bitymi_ns.bake.inputs import BakeInput

POINTS = 256
"""A view's size is the median over the points in its picture; each takes 22 bytes of bundle.json, and time."""


def photographed(inputs: BakeInput) -> Tensor | None:
    """Places of surfels, evenly drawn from those that some view shows, and the geometric mean over these views of
    focal length / depth: [P, 4] float32 on the CPU; None without views.

    Args:
        inputs: the surfels that are kept. Where it was not looked which views blend them, those count in whose picture
            their centres lie.
    """
    if not inputs.cameras:
        return None
    means = inputs.surfels["means"].double().cpu()
    logs, views = torch.zeros(len(means), dtype=torch.float64), torch.zeros(len(means), dtype=torch.float64)
    for i, camera in enumerate(inputs.cameras):
        viewmat, K = camera.viewmat.double().cpu(), camera.K.double().cpu()
        x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(1)
        shown = z > inputs.near
        if inputs.views is not None:
            shown &= inputs.views.seen[i].cpu()
        else:
            depth = z.clamp(min=inputs.near)
            column, row = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
            shown &= (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        rate = torch.sqrt(K[0, 0] * K[1, 1]) / z.clamp(min=inputs.near)
        logs += torch.where(shown, rate.log(), 0.0)
        views += shown
    rows = views.nonzero().flatten()
    if not len(rows):
        return None
    count = min(POINTS, len(rows))
    rows = rows[(torch.arange(count) * len(rows)) // count]
    return torch.cat([means[rows], (logs[rows] / views[rows]).exp()[:, None]], 1).float()
