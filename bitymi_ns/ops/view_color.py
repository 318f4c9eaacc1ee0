"""View-dependent surfel colour f_view(d), of the kinds in `view_kinds`."""

from collections.abc import Sequence

import torch
from torch import Tensor

from .backend import check_shapes, dense, kernel, on_same_device
from .constants import COLOR_BIAS, MAX_TERMS
from .parameters import Tensors
from .view_kinds import entry_of

REDUCED = ("view_base", "view_span", "view_terms")
"""Parameters of reduced view colours, with a varying number of terms per surfel."""


def view_base(f_view: Tensor) -> Tensor:
    """Compute ReLU(f_view + 0.5), a fragment's colour without residual."""
    return torch.relu(f_view + COLOR_BIAS)


def _directions(means: Tensor, center: Tensor, active: Tensor) -> dict[str, Tensor]:
    origin = dense(center, center.double()).to(means.device)
    return {"means": dense(means, means), "center": origin, "active": active}


def _flags(active: Tensor) -> Tensor:
    """Convert to uint8, without a copy of dense bools."""
    return active.view(torch.uint8).contiguous() if active.dtype == torch.bool else active.to(torch.uint8)


def lettered(parameters: Sequence[Tensor], prefix: str = "") -> dict[str, Tensor]:
    """Name parameters as the kernels do: a, b and c."""
    return {prefix + letter: p for letter, p in zip("abc", parameters, strict=False)}


class _ViewColor(torch.autograd.Function):
    @staticmethod
    def forward(ctx, kind, terms, active, center, means, *params):
        inputs = [dense(p, means) for p in params]
        to = _directions(means, center, active)
        out = means.new_empty(means.shape[0], 3)
        kernel("view_color_forward", means)(kind=kind, terms=terms, **lettered(inputs), **to, out=out)
        ctx.save_for_backward(*to.values(), *inputs)
        ctx.kind, ctx.terms = kind, terms
        return out

    @staticmethod
    def backward(ctx, dout):
        means, center, active, *inputs = ctx.saved_tensors
        to = {"means": means, "center": center, "active": active}
        dmeans, grads = torch.empty_like(means), [torch.empty_like(p) for p in inputs]
        parameters = {**lettered(inputs), **lettered(grads, "d")}
        kernel("view_color_backward", means)(
            kind=ctx.kind, terms=ctx.terms, **parameters, **to, dout=dense(dout, means), dmeans=dmeans
        )
        dcenter = -dmeans.sum(0, dtype=center.dtype) if ctx.needs_input_grad[3] else None
        return None, None, None, dcenter, dmeans, *grads


def check_view_color(kind: str, params: Tensors, n: int) -> int:
    """Check the view colours of n surfels; returns the number of terms. Raises ValueError: unknown kind, or a parameter
    has the wrong shape."""
    entry = entry_of(kind)
    terms = entry.terms(params)
    rows = [(n, *shape) for shape in entry.shapes(terms)]
    check_shapes(**{name: (params[name], row) for name, row in zip(entry.names, rows, strict=True)})
    problem = entry.problem(terms)
    if problem is not None:
        raise ValueError(problem)
    return terms


def check_reduced(kind: str, params: Tensors, n: int) -> None:
    """Check the reduced view colours of n surfels; synchronises with a CUDA device. Raises ValueError: wrong shape or
    dtype, a span outside the terms, or harmonics that end within a degree."""
    entry = entry_of(kind)
    base, span, terms = (params[name] for name in REDUCED)
    if tuple(base.shape) != (n, 3) or tuple(span.shape) != (n, 2) or span.dtype != torch.int32:
        raise ValueError(f"view_base must be [{n}, 3] and view_span [{n}, 2] int32")
    if terms.dim() != 2 or terms.shape[1] != entry.reduced_width:
        raise ValueError(f"view_terms must be [terms, {entry.reduced_width}], not {list(terms.shape)}")
    first, count = span.long().unbind(1)
    allowed = torch.zeros(MAX_TERMS + 1, dtype=torch.bool)
    allowed[list(entry.reduced_counts)] = True
    bad = (first < 0) | (count < 0) | (count > MAX_TERMS) | (first + count > len(terms))
    bad |= ~allowed.to(count.device)[count.clamp(0, MAX_TERMS)]
    if bad.any():
        raise ValueError(f"view_span of surfel {int(bad.nonzero()[0])} does not fit the {len(terms)} terms")


def view_color(kind: str, params: Tensors, means: Tensor, center: Tensor, active: Tensor | None = None) -> Tensor:
    """Compute f_view(d) without the offset 0.5, d = (mean - centre) / |mean - centre| in the world frame.

    Args:
        kind: a name of `VIEW_COLORS`.
        params: the parameters of its entry; or those of reduced colours, without gradient: view_base [N, 3], view_span
            [N, 2] int32 (first term, number of terms), view_terms [terms, reduced_width].
        means: [N, 3] world positions.
        center: [3] camera centre, world; used in float64 (`Camera.exact_center`); may require a gradient.
        active: [N] bool; inactive rows give 0 and get no gradient; None: all active.

    Returns:
        [N, 3].

    Raises:
        ValueError: unknown kind, or a parameter has the wrong shape or device.
    """
    n = means.shape[0]
    flags = means.new_ones(n, dtype=torch.uint8) if active is None else _flags(active.to(means.device))
    if "view_terms" in params:
        base, span, terms = (params[name] for name in REDUCED)
        out, to = means.new_empty(n, 3), _directions(means, center, flags)
        colors = {"base": dense(base, means), "span": span.contiguous(), "reduced": dense(terms, means)}
        kernel("view_color_forward", means)(kind=kind, **colors, **to, out=out)
        return out
    terms = check_view_color(kind, params, n)
    entry = entry_of(kind)
    values = entry.of(params)
    on_same_device(means, **dict(zip(entry.names, values, strict=True)))
    return _ViewColor.apply(kind, terms, flags, center, means, *values)
