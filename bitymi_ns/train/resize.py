"""Change the number of surfels without losing what the optimisers know about the ones that stay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

ResizeHook = Callable[[str, Parameter], None]
"""Called with the name and the new Parameter after each replacement."""


@torch.no_grad()
def replace_rows(
    surfels: MutableMapping[str, Parameter],
    optimizers: Mapping[str, Optimizer],
    keep: Tensor,
    new: Mapping[str, Tensor] | None = None,
    on_resize: ResizeHook | None = None,
) -> None:
    """Keep the rows `keep` of every surfel parameter, in that order, and append the rows `new`.

    Every entry of `surfels` becomes a new Parameter, which replaces the old one in its optimiser. Rows that stay keep
    their optimiser state. New rows start with zeros, as torch's Adam does for a new parameter.

    Args:
        surfels: parameters by name, each [N, ...].
        optimizers: by the same names; each holds one group with that one parameter. A parameter without optimiser is
            resized all the same.
        keep: [n] int64 row numbers.
        new: rows to append, by name, each [m, ...]; all names of `surfels`, or None for no new rows.
        on_resize: told of every new Parameter.
    """
    if new is not None and set(new) != set(surfels):
        raise ValueError(f"new surfels need exactly {sorted(surfels)}, not {sorted(new)}")
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
            _swap(optimizer, name, old, parameter, keep, added)
        surfels[name] = parameter
        if on_resize is not None:
            on_resize(name, parameter)


def _swap(optimizer: Optimizer, name: str, old: Parameter, new: Parameter, keep: Tensor, added: int) -> None:
    groups = optimizer.param_groups
    if len(groups) != 1 or len(groups[0]["params"]) != 1 or groups[0]["params"][0] is not old:
        raise ValueError(f"the optimiser of {name} must hold one group with exactly the scene's parameter")
    state = optimizer.state.pop(old, None)
    groups[0]["params"] = [new]
    if not state:
        return
    for key, value in state.items():
        if isinstance(value, Tensor) and value.shape == old.shape:
            zeros = value.new_zeros(added, *value.shape[1:])
            state[key] = torch.cat([value[keep], zeros])
    optimizer.state[new] = state


@torch.no_grad()
def cap_opacity(
    surfels: Mapping[str, Parameter], optimizers: Mapping[str, Optimizer], highest: float, forget_all: bool = False
) -> int:
    """Lower every opacity above `highest` to it, in place.

    The optimiser forgets the momentum of the rows it changed (which would lift them again at once), or of all rows.

    Returns:
        How many opacities were lowered.
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
