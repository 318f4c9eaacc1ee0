"""The optimisers of a scene's parameters."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import torch
from torch.optim import Adam, Optimizer

from bitymi_ns.scene.field import HashField
from bitymi_ns.train.config import AdamConfig

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


def adam(parameters: list[torch.nn.Parameter], betas: tuple[float, float] = AdamConfig.betas) -> Adam:
    """Adam with the method's epsilon, fused where torch can do that on the parameters' device."""
    try:
        return Adam(parameters, lr=0.0, betas=betas, eps=AdamConfig.eps, fused=True)
    except RuntimeError:
        return Adam(parameters, lr=0.0, betas=betas, eps=AdamConfig.eps)


def surfel_optimizers(scene: Scene) -> dict[str, Adam]:
    """One optimiser per surfel parameter, under its name."""
    return {name: adam([p]) for name, p in scene.surfels.items()}


def make_optimizers(scene: Scene) -> dict[str, Adam]:
    """Those of the surfels, and `field_table` and `field_mlp`."""
    optimizers = surfel_optimizers(scene)
    if isinstance(scene.field, HashField):
        table, *mlp = scene.field.weights
        optimizers["field_table"] = adam([table], AdamConfig.field_betas)
        optimizers["field_mlp"] = adam(mlp, AdamConfig.field_betas)
    return optimizers


PLAIN = {"fused": True, "weight_decay": 0.0, "amsgrad": False, "maximize": False, "differentiable": False}
"""What a group of Adam says that `step` takes together with others."""


def step(optimizers: Iterable[Optimizer]) -> None:
    """A step of every optimiser, as each would do it itself, to the last bit.

    An optimiser takes torch 100 to 200 us of Python, the tenfold of what all of it takes a card. Those of fused Adam
    are therefore done here: one addition for all their counters of steps, and one call per learning rate.
    """
    together: dict[tuple[Any, ...], list[list[torch.Tensor]]] = {}
    counters: list[torch.Tensor] = []
    for optimizer in optimizers:
        found = [_ready(optimizer, group) for group in optimizer.param_groups]
        if any(rows is None for rows in found):
            optimizer.step()
            continue
        for group, rows in zip(optimizer.param_groups, found, strict=True):
            for row in rows or ():
                key = (row[0].device, row[0].dtype, group["lr"], *group["betas"], group["eps"])
                together.setdefault(key, []).append(row)
                counters.append(row[-1])
    if not counters:
        return
    with torch.no_grad():
        torch._foreach_add_(counters, 1.0)
        for (_, _, rate, first, second, eps), rows in together.items():
            parameters, gradients, means, squares, steps = (list(column) for column in zip(*rows, strict=True))
            torch._fused_adam_(
                parameters,
                gradients,
                means,
                squares,
                [],
                steps,
                lr=rate,
                beta1=first,
                beta2=second,
                weight_decay=0.0,
                eps=eps,
                amsgrad=False,
                maximize=False,
            )


def _ready(optimizer: Optimizer, group: dict[str, Any]) -> list[list[torch.Tensor]] | None:
    """Parameter, gradient, both moments and the number of steps of each parameter with a gradient; None where the
    optimiser has to do its step itself: it is another, or has not begun."""
    if type(optimizer) is not Adam or any(group.get(name) != value for name, value in PLAIN.items()):
        return None
    if not isinstance(group["lr"], float):
        return None
    found = []
    for parameter in group["params"]:
        gradient = parameter.grad
        if gradient is None:
            continue
        state = optimizer.state.get(parameter)
        if not state or gradient.is_sparse or state["step"].device != parameter.device:
            return None
        found.append([parameter, gradient, state["exp_avg"], state["exp_avg_sq"], state["step"]])
    return found


def set_rate(optimizer: Optimizer, rate: float) -> None:
    """Gives an optimiser its learning rate."""
    for group in optimizer.param_groups:
        group["lr"] = rate


def forget_gradients(optimizers: Iterable[Optimizer]) -> None:
    """Takes the gradients from all parameters, as `zero_grad` of each optimiser would."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = None
