"""The optimisers of a scene's parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch.optim import Adam

from bitymi_ns.train.config import AdamConfig

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


def adam(parameters: list[torch.nn.Parameter], betas: tuple[float, float] = AdamConfig.betas) -> Adam:
    """Adam with the method's epsilon, fused where torch can do that on the parameters' device."""
    try:
        return Adam(parameters, lr=0.0, betas=betas, eps=AdamConfig.eps, fused=True)
    except RuntimeError:
        return Adam(parameters, lr=0.0, betas=betas, eps=AdamConfig.eps)


def make_optimizers(scene: Scene) -> dict[str, Adam]:
    """One optimiser per surfel parameter, under its name, and `field_table` and `field_mlp`."""
    optimizers = {name: adam([p]) for name, p in scene.surfels.items()}
    if scene.field is not None:
        table, *mlp = scene.field.weights
        optimizers["field_table"] = adam([table], AdamConfig.field_betas)
        optimizers["field_mlp"] = adam(mlp, AdamConfig.field_betas)
    return optimizers
