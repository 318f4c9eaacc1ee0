"""View-dependent surfel colour f_view(d): sv, sh, sb, sg."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from .backend import dense, kernel, on_same_device
from .constants import MAX_TERMS

VIEW_COLORS: dict[str, tuple[str, ...]] = {
    "sv": ("sv_sites", "sv_log_tau", "sv_rgb"),
    "sh": ("sh_dc", "sh_rest"),
    "sb": ("sb_base", "sb_lobes"),
    "sg": ("sg_base", "sg_lobes"),
}
"""Names of the per-surfel parameters of each kind (docs/architecture.md gives their shapes)."""
LEAN = ("view_base", "view_span", "view_terms")
"""Names of the parameters of lean view colours, of which every surfel has as many terms as it needs."""
LEAN_WIDTH = {"sv": 6, "sh": 3, "sb": 6, "sg": 7}
"""Numbers per term. sv: b, rgb relative to the first site (csrc/core/view_color.h); sh: the coefficients of one
function, from degree 1 on; sb, sg: a lobe."""


class _ViewColor(torch.autograd.Function):
    @staticmethod
    def forward(ctx, kind, terms, active, center, means, *params):
        inputs = [dense(p, means) for p in params]
        a, b, c = (*inputs, None) if len(inputs) == 2 else inputs
        x, o = dense(means, means), dense(center, center.double()).to(means.device)
        out = means.new_empty(means.shape[0], 3)
        kernel("view_color_forward", means)(kind, terms, a, b, c, x, o, active, out)
        ctx.save_for_backward(x, o, active, *inputs)
        ctx.kind, ctx.terms = kind, terms
        return out

    @staticmethod
    def backward(ctx, dout):
        x, o, active, *inputs = ctx.saved_tensors
        a, b, c = (*inputs, None) if len(inputs) == 2 else inputs
        da, db = torch.empty_like(a), torch.empty_like(b)
        dc = None if c is None else torch.empty_like(c)
        dx = torch.empty_like(x)
        kernel("view_color_backward", x)(ctx.kind, ctx.terms, a, b, c, x, o, active, dense(dout, x), da, db, dc, dx)
        return None, None, None, None, dx, *((da, db) if dc is None else (da, db, dc))


def kind_of(params: Mapping[str, Tensor]) -> str:
    """Which view colour complete parameters belong to: sv, sh, sb or sg.

    Raises:
        ValueError: the parameters of none are there.
    """
    for kind, names in VIEW_COLORS.items():
        if all(name in params for name in names):
            return kind
    raise ValueError(f"no view colour among the surfels' parameters {sorted(params)}")


def check_view_color(kind: str, params: Mapping[str, Tensor], n: int) -> int:
    """The number of terms (sites, coefficients with dc, or lobes) of n surfels' view colours.

    Raises:
        ValueError: unknown kind, or a parameter has the wrong shape.
    """
    if kind not in VIEW_COLORS:
        raise ValueError(f"unknown view colour '{kind}': choose one of {', '.join(VIEW_COLORS)}")
    given = [params[name] for name in VIEW_COLORS[kind]]
    terms = given[1].shape[1] + (1 if kind == "sh" else 0)
    shapes = {
        "sv": [(n, terms, 3), (n, terms), (n, terms, 3)],
        "sh": [(n, 3), (n, terms - 1, 3)],
        "sb": [(n, 3), (n, terms, 6)],
        "sg": [(n, 3), (n, terms, 7)],
    }[kind]
    for name, tensor, shape in zip(VIEW_COLORS[kind], given, shapes, strict=True):
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {list(shape)}, not {list(tensor.shape)}")
    if kind == "sh" and terms not in (1, 4, 9, 16):
        raise ValueError(f"sh_rest must hold 0, 3, 8 or 15 coefficients, not {terms - 1}")
    if kind == "sv" and terms < 1:
        raise ValueError("Spherical Voronoi colours need at least one site per surfel")
    if terms > MAX_TERMS:
        raise ValueError(f"at most {MAX_TERMS} sites or lobes per surfel, not {terms}")
    return terms


def check_lean(kind: str, params: Mapping[str, Tensor], n: int) -> None:
    """Checks the lean view colours of n surfels; waits for a device.

    Raises:
        ValueError: a shape or dtype is wrong, a span lies outside the terms, or harmonics end within a degree.
    """
    if kind not in VIEW_COLORS:
        raise ValueError(f"unknown view colour '{kind}': choose one of {', '.join(VIEW_COLORS)}")
    base, span, terms = (params[name] for name in LEAN)
    if tuple(base.shape) != (n, 3) or tuple(span.shape) != (n, 2) or span.dtype != torch.int32:
        raise ValueError(f"view_base must be [{n}, 3] and view_span [{n}, 2] int32")
    if terms.dim() != 2 or terms.shape[1] != LEAN_WIDTH[kind]:
        raise ValueError(f"view_terms must be [terms, {LEAN_WIDTH[kind]}], not {list(terms.shape)}")
    first, count = span.long().unbind(1)
    bad = (first < 0) | (count < 0) | (count > MAX_TERMS) | (first + count > len(terms))
    if kind == "sh":
        bad |= ~torch.isin(count, count.new_tensor([0, 3, 8, 15]))
    if bad.any():
        raise ValueError(f"view_span of surfel {int(bad.nonzero()[0])} does not fit the {len(terms)} terms")


def view_color(
    kind: str, params: Mapping[str, Tensor], means: Tensor, center: Tensor, active: Tensor | None = None
) -> Tensor:
    """f_view(d) without the offset 0.5, d = (mean - centre) / |mean - centre| in the world frame.

    Args:
        kind: sv (Spherical Voronoi, the paper's), sh, sb or sg.
        params: the parameters named in VIEW_COLORS[kind]; or those of lean colours (`LEAN`), which have no gradient:
            view_base [N, 3], view_span [N, 2] int32 (first term, how many), view_terms [terms, LEAN_WIDTH[kind]]. More
            are ignored.
        means: [N, 3] world positions.
        center: [3] camera centre, world; used in float64 (`Camera.exact_center`).
        active: [N] bool; rows that are not active give 0 and get no gradient. None = all.

    Returns:
        [N, 3].

    Raises:
        ValueError: unknown kind, or a parameter has the wrong shape or lies on another device.
    """
    n = means.shape[0]
    flags = means.new_ones(n, dtype=torch.uint8) if active is None else active.to(means.device, torch.uint8)
    if "view_terms" in params:
        base, span, terms = (params[name] for name in LEAN)
        x, out = dense(means, means), means.new_empty(n, 3)
        origin = dense(center, center.double()).to(means.device)
        kernel("lean_color", means)(
            kind, dense(base, means), span.contiguous(), dense(terms, means), x, origin, flags, out
        )
        return out
    terms = check_view_color(kind, params, n)
    given = [params[name] for name in VIEW_COLORS[kind]]
    on_same_device(means, **dict(zip(VIEW_COLORS[kind], given, strict=True)))
    return _ViewColor.apply(kind, terms, flags, center, means, *given)
