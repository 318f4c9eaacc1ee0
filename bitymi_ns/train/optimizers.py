"""Optimisers of a scene's parameters."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.nn import Parameter, ParameterDict
from torch.optim import Adam, Optimizer

from bitymi_ns.exit_messages import out_of_memory
from bitymi_ns.ops.backend import cuda_backend, dense, kernel_class, on_device, stream_of
from bitymi_ns.scene.field import HashField

if TYPE_CHECKING:
    from bitymi_ns.scene.scene import Scene

# of Adam
EPS = 1e-15
BETAS = (0.9, 0.999)
FIELD_BETAS = (0.9, 0.99)  # of the texture field, whose gradients are sparse, and large early on


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


def make_optimizers(scene: Scene) -> dict[str, Adam]:
    """Create the optimisers of the surfel parameters, and `field_table` and `field_mlp` for a hash field."""
    optimizers = {name: adam([p]) for name, p in scene.surfels.items()}
    if isinstance(scene.field, HashField):
        table, *mlp = scene.field.weights
        optimizers["field_table"] = adam([table], FIELD_BETAS)
        optimizers["field_mlp"] = adam(mlp, FIELD_BETAS)
    return optimizers


PLAIN = {"fused": True, "weight_decay": 0.0, "amsgrad": False, "maximize": False, "differentiable": False}
"""Options of the Adam groups that the kernel steps."""


@torch.no_grad()
def step(optimizers: Mapping[str, Optimizer], factors: Mapping[str, Tensor]) -> None:
    """Step all optimisers, by parameter group, and scale the updates of parameters [N, ...] by row factors [N].

    Adam.step costs 100-200 us of Python, ten times the GPU work: on a CUDA device one kernel steps all fused Adams."""
    fused: list[dict[str, Any]] = []
    for name, optimizer in optimizers.items():
        arguments = _kernel_arguments(optimizer, factors.get(name))
        if arguments is not None:
            fused += arguments
            continue
        parameters = optimizer.param_groups[0]["params"]
        before = [parameter.detach().clone() for parameter in parameters if name in factors]
        optimizer.step()
        for parameter, old in zip(parameters, before, strict=False):
            torch.lerp(old, parameter, factors[name].view(-1, *[1] * (parameter.ndim - 1)), out=parameter)
    if fused:
        like = fused[0]["parameter"]
        with on_device(like.device):
            kernel_class("adam", like)(fused, stream=stream_of(like.device))


def _kernel_arguments(optimizer: Optimizer, factors: Tensor | None) -> list[dict[str, Any]] | None:
    """Build the kernel's arguments for the parameters with a gradient; None for optimisers on the CPU, other than plain
    fused Adam, or without state."""
    if type(optimizer) is not Adam or not cuda_backend(optimizer.param_groups[0]["params"][0].device):
        return None
    arguments = []
    for group in optimizer.param_groups:
        if any(group.get(name) != value for name, value in PLAIN.items()) or not isinstance(group["lr"], float):
            return None
        for parameter in group["params"]:
            gradient = parameter.grad
            state = optimizer.state.get(parameter)
            if gradient is None:
                continue
            if not state or gradient.is_sparse or state["step"].device != parameter.device:
                return None
            arguments.append(
                {
                    "parameter": parameter,
                    "gradient": dense(gradient, parameter),
                    "mean": state["exp_avg"],
                    "square": state["exp_avg_sq"],
                    "step": state["step"],
                    "width": parameter[0].numel() if factors is not None and len(parameter) else 1,
                    "factors": factors,
                    "rate": group["lr"],
                    "beta1": group["betas"][0],
                    "beta2": group["betas"][1],
                    "eps": group["eps"],
                }
            )
    return arguments


def set_rate(optimizer: Optimizer, rate: float) -> None:
    for group in optimizer.param_groups:
        group["lr"] = rate


def forget_gradients(optimizers: Iterable[Optimizer]) -> None:
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = None


ResizeHook = Callable[[str, Parameter], None]  # called with name and new Parameter when one is replaced


@torch.no_grad()
def replace_rows(
    surfels: ParameterDict,
    optimizers: Mapping[str, Optimizer],
    keep: Tensor,
    new: Mapping[str, Tensor] | None = None,
    on_resize: ResizeHook | None = None,
) -> None:
    """Keep the rows `keep` [n] int64 of every surfel parameter [N, ...], in that order, and append rows `new` [m, ...].

    Every entry of `surfels` becomes a new Parameter, also in its optimiser, if it has one, and `on_resize` is called.
    Kept rows keep their optimiser state; that of new rows is zero."""
    for name in list(surfels.keys()):
        old = surfels[name]
        added = 0 if new is None else len(new[name])
        rows = old.detach()[keep]
        rows = rows if new is None else torch.cat([rows, new[name].detach().to(rows)])
        parameter = Parameter(rows.contiguous(), requires_grad=old.requires_grad)
        if (optimizer := optimizers.get(name)) is not None:
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
    """Clamp opacities to `highest`, in place, and reset the optimiser state of those lowered, or of all: the old
    momentum would raise them again at once. Returns the number lowered."""
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
