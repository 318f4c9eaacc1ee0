"""Optimisers of a scene's parameters."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, MutableMapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from bitymi_ns.scene.field import HashField

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


EPS = 1e-15  # Adam's epsilon
BETAS = (0.9, 0.999)  # Adam's betas of surfel parameters
FIELD_BETAS = (0.9, 0.99)  # of the texture field, whose gradients are sparse, and large early on


def adam(parameters: list[torch.nn.Parameter], betas: tuple[float, float] = BETAS) -> Adam:
    """Create a fused Adam optimiser with the method's epsilon."""
    return Adam(parameters, lr=0.0, betas=betas, eps=EPS, fused=True)


def surfel_optimizers(scene: Scene) -> dict[str, Adam]:
    """Create one optimiser per surfel parameter, by its name."""
    return {name: adam([p]) for name, p in scene.surfels.items()}


def make_optimizers(scene: Scene) -> dict[str, Adam]:
    """Create the optimisers of the surfel parameters, and `field_table` and `field_mlp` for a hash field."""
    optimizers = surfel_optimizers(scene)
    if isinstance(scene.field, HashField):
        table, *mlp = scene.field.weights
        optimizers["field_table"] = adam([table], FIELD_BETAS)
        optimizers["field_mlp"] = adam(mlp, FIELD_BETAS)
    return optimizers


PLAIN = {"fused": True, "weight_decay": 0.0, "amsgrad": False, "maximize": False, "differentiable": False}
"""Options of the Adam groups that `step` fuses."""


def step(optimizers: Mapping[str, Optimizer], factors: Mapping[str, Tensor]) -> None:
    """Step all optimisers, bit-identical to calling each `step`, and scale the updates of single rows.

    Each Adam.step costs 100-200 us of Python, ten times the GPU work. Fused Adam optimisers are therefore stepped here
    together: one addition for all step counters, and one call per learning rate.

    Args:
        optimizers: by parameter group.
        factors: row factors [N] of the updates of parameters [N, ...], by parameter group.
    """
    scaled = [
        (parameter, parameter.detach().clone(), factors[name].view(-1, *[1] * (parameter.ndim - 1)))
        for name, optimizer in optimizers.items()
        if name in factors
        for parameter in optimizer.param_groups[0]["params"]
    ]
    _step_together(optimizers.values())
    with torch.no_grad():
        for parameter, before, factor in scaled:
            torch.lerp(before, parameter, factor, out=parameter)


def _step_together(optimizers: Iterable[Optimizer]) -> None:
    batches: dict[tuple[Any, ...], list[list[torch.Tensor]]] = {}
    counters: list[torch.Tensor] = []
    for optimizer in optimizers:
        found = [_fusable(optimizer, group) for group in optimizer.param_groups]
        if any(rows is None for rows in found):
            optimizer.step()
            continue
        for group, rows in zip(optimizer.param_groups, found, strict=True):
            for row in rows or ():
                key = (row[0].device, row[0].dtype, group["lr"], *group["betas"], group["eps"])
                batches.setdefault(key, []).append(row)
                counters.append(row[-1])
    if not counters:
        return
    with torch.no_grad():
        torch._foreach_add_(counters, 1.0)
        for (_, _, rate, first, second, eps), rows in batches.items():
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


def _fusable(optimizer: Optimizer, group: dict[str, Any]) -> list[list[torch.Tensor]] | None:
    """List parameter, gradient, both moments and step counter of each parameter with a gradient; None if the optimiser
    must step itself, because it is no plain fused Adam or has no state yet."""
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
    """Set the learning rate of an optimiser."""
    for group in optimizer.param_groups:
        group["lr"] = rate


def forget_gradients(optimizers: Iterable[Optimizer]) -> None:
    """Set the gradients of all parameters to None."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = None


ResizeHook = Callable[[str, Parameter], None]  # called with the name and the new Parameter when one is replaced


@torch.no_grad()
def replace_rows(
    surfels: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    keep: Tensor,
    new: Mapping[str, Tensor] | None = None,
    on_resize: ResizeHook | None = None,
) -> None:
    """Keep the rows `keep` of every surfel parameter, in that order, and append the rows `new`.

    Every entry of `surfels` becomes a new Parameter, also in its optimiser. Kept rows keep their optimiser state; that
    of new rows is zero.

    Args:
        surfels: parameters by name, each [N, ...].
        optimizers: by the same names, each with one group of that one parameter; some may be missing.
        keep: [n] int64 row indices.
        new: rows to append, by name, each [m, ...]; all names of `surfels`, or None for no new rows.
        on_resize: called for every new Parameter.
    """
    for name in list(surfels.keys()):
        old = surfels[name]
        rows = old.detach()[keep]
        added = 0
        if new is not None:
            added = len(new[name])
            rows = torch.cat([rows, new[name].detach().to(rows)])
        parameter = Parameter(rows.contiguous(), requires_grad=old.requires_grad)
        optimizer = optimizers.get(name)
        if optimizer is not None:
            state = optimizer.state.pop(old, {})
            optimizer.param_groups[0]["params"] = [parameter]
            for key, value in state.items():
                if isinstance(value, Tensor) and value.shape == old.shape:
                    state[key] = torch.cat([value[keep], value.new_zeros(added, *value.shape[1:])])
            if state:
                optimizer.state[parameter] = state
        surfels[name] = parameter
        if on_resize is not None:
            on_resize(name, parameter)


@torch.no_grad()
def cap_opacity(
    surfels: Mapping[str, Parameter], optimizers: Mapping[str, Optimizer], highest: float, forget_all: bool = False
) -> int:
    """Clamp opacities to at most `highest`, in place, and reset their optimiser state, or that of all rows.

    The old momentum would raise the opacities again at once.

    Returns:
        The number of opacities lowered.
    """
    logits = surfels["opacity_logits"]
    limit = torch.logit(torch.tensor(highest, dtype=torch.float64)).item()
    above = logits > limit
    logits.masked_fill_(above, limit)
    optimizer = optimizers.get("opacity_logits")
    state = optimizer.state.get(logits, {}) if optimizer is not None else {}
    for value in state.values():
        if isinstance(value, Tensor) and value.shape == logits.shape:
            value[slice(None) if forget_all else above] = 0.0
    return int(above.sum())
