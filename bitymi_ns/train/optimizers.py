"""Optimisers of a scene's parameters."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import Parameter, ParameterDict
from torch.optim import Adam, Optimizer

from bitymi_ns.exit_messages import out_of_memory
from bitymi_ns.ops.backend import cuda_backend, dense, kernel_class, on_device, stream_of
from bitymi_ns.scene.field import HashField

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene


EPS = 1e-15  # Adam's epsilon
BETAS = (0.9, 0.999)  # Adam's betas of surfel parameters
FIELD_BETAS = (0.9, 0.99)  # those of the texture field, whose gradients are sparse, and large early on


def adam(parameters: Sequence[Tensor], betas: tuple[float, float] = BETAS, rate: float = 0.0, eps: float = EPS) -> Adam:
    """Create an Adam optimiser, fused where torch can: on the CPU since 2.4."""
    return Adam(parameters, lr=rate, betas=betas, eps=eps, fused=_fuses(parameters[0].device.type))


@functools.cache
def _fuses(device: str) -> bool:
    try:
        Adam([torch.zeros(1, device=device)], fused=True)
    except RuntimeError as error:
        if out_of_memory(error):
            raise
        return False
    return True


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


class _AdamParameter(NamedTuple):
    """A parameter of a fused Adam optimiser, with its state and options."""

    parameter: Tensor
    gradient: Tensor
    mean: Tensor
    square: Tensor
    step: Tensor
    rate: float
    betas: tuple[float, float]
    eps: float
    factors: Tensor | None  # [N], of the updates of the parameter's rows


@torch.no_grad()
def step(optimizers: Mapping[str, Optimizer], factors: Mapping[str, Tensor]) -> None:
    """Step all optimisers, as calling each one's `step` would, and scale the updates row by each.

    Each Adam.step costs 100-200 us of Python, ten times the GPU work. Fused Adam optimisers are therefore stepped
    together: on the CPU by one call per learning rate, bit-identical to each `step`, on CUDA devices by one kernel.
    `optimizers`: by parameter group. `factors`: row factors [N] of the updates of parameters [N, ...], by parameter
    group."""
    fused: list[_AdamParameter] = []
    for name, optimizer in optimizers.items():
        found = _fusable(optimizer, factors.get(name))
        if found is None:
            before = [p.detach().clone() for p in optimizer.param_groups[0]["params"] if name in factors]
            optimizer.step()
            for parameter, values in zip(optimizer.param_groups[0]["params"], before, strict=False):
                _scale_update(parameter, values, factors[name])
        else:
            fused += found
    if fused and cuda_backend(fused[0].parameter.device):
        _step_by_kernel(fused)
    elif fused:
        _step_by_torch(fused)


def _scale_update(parameter: Tensor, before: Tensor, factors: Tensor) -> None:
    torch.lerp(before, parameter, factors.view(-1, *[1] * (parameter.ndim - 1)), out=parameter)


def _step_by_kernel(fused: Sequence[_AdamParameter]) -> None:
    device = fused[0].parameter.device
    arguments = [
        {
            "parameter": each.parameter,
            "gradient": dense(each.gradient, each.parameter),
            "mean": each.mean,
            "square": each.square,
            "step": each.step,
            "width": each.parameter[0].numel() if each.factors is not None and len(each.parameter) else 1,
            "factors": each.factors,
            "rate": each.rate,
            "beta1": each.betas[0],
            "beta2": each.betas[1],
            "eps": each.eps,
        }
        for each in fused
    ]
    with on_device(device):
        kernel_class("adam", fused[0].parameter)(arguments, stream=stream_of(device))


def _step_by_torch(fused: Sequence[_AdamParameter]) -> None:
    scaled = [
        (each.parameter, each.parameter.detach().clone(), each.factors) for each in fused if each.factors is not None
    ]
    batches: dict[tuple[Any, ...], list[_AdamParameter]] = {}
    for each in fused:
        batches.setdefault((each.parameter.dtype, each.rate, *each.betas, each.eps), []).append(each)
    torch._foreach_add_([each.step for each in fused], 1.0)
    for (_, rate, first, second, eps), batch in batches.items():
        torch._fused_adam_(
            [each.parameter for each in batch],
            [each.gradient for each in batch],
            [each.mean for each in batch],
            [each.square for each in batch],
            [],
            [each.step for each in batch],
            lr=rate,
            beta1=first,
            beta2=second,
            weight_decay=0.0,
            eps=eps,
            amsgrad=False,
            maximize=False,
        )
    for parameter, before, row_factors in scaled:
        _scale_update(parameter, before, row_factors)


def _fusable(optimizer: Optimizer, factors: Tensor | None) -> list[_AdamParameter] | None:
    """List the parameters with a gradient; None if the optimiser must step itself, because it is no plain fused Adam or
    has no state yet."""
    if type(optimizer) is not Adam:
        return None
    found = []
    for group in optimizer.param_groups:
        if any(group.get(name) != value for name, value in PLAIN.items()) or not isinstance(group["lr"], float):
            return None
        for parameter in group["params"]:
            gradient = parameter.grad
            if gradient is None:
                continue
            state = optimizer.state.get(parameter)
            if not state or gradient.is_sparse or state["step"].device != parameter.device:
                return None
            moments = (state["exp_avg"], state["exp_avg_sq"], state["step"])
            found.append(
                _AdamParameter(parameter, gradient, *moments, group["lr"], group["betas"], group["eps"], factors)
            )
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
    surfels: ParameterDict,
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
    surfels: ParameterDict, optimizers: Mapping[str, Optimizer], highest: float, forget_all: bool = False
) -> int:
    """Clamp opacities to at most `highest`, in place, and reset the optimiser state of those lowered, or of all rows.

    The old momentum would raise the opacities again at once. Returns the number of opacities lowered."""
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
