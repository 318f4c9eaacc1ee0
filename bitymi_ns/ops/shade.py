"""Shading: the colour of every fragment, eq. (color)."""

import torch
from torch import Tensor

from .backend import check_shapes, dense, kernel, on_same_device
from .constants import COLOR_BIAS, FRAME
from .field import FieldGeometry, backward_memory, gradients, kernel_field
from .trace import Fragments


class _Shade(torch.autograd.Function):
    @staticmethod
    def forward(ctx, base, frames, uv, fragments, geometry, bound, move, *params):
        b, f, arrays = dense(base, base), dense(frames, base), fragments.arrays
        colors = base.new_empty(len(fragments), 3)
        handle = kernel_field(geometry, *params) if params else None
        inputs = {"bound": bound, "base": b, "frames": f, "field": handle}
        kernel("shade_forward", base)(**arrays, **inputs, colors=colors)
        ctx.save_for_backward(b, f, colors, *arrays.values(), *params)
        ctx.field, ctx.bound, ctx.move, ctx.names = handle, bound, move, tuple(arrays)
        return colors

    @staticmethod
    def backward(ctx, dcolors):
        base, frames, colors, *rest = ctx.saved_tensors
        arrays, params = dict(zip(ctx.names, rest, strict=False)), rest[len(ctx.names) :]
        learn = bool(params) and any(ctx.needs_input_grad[7:])
        dbase, grads = torch.empty_like(base), gradients(params) if learn else {}
        duv = dframes = None
        if learn and ctx.move:
            duv, dframes = torch.empty_like(arrays["uv"]), torch.empty_like(frames)
        kernel("shade_backward", base)(
            **arrays,
            **grads,
            **backward_memory(base, params[0] if learn else None, len(base), dframes is not None),
            bound=ctx.bound,
            base=base,
            frames=frames,
            field=ctx.field if learn else None,
            colors=colors,
            dcolors=dense(dcolors, base),
            dbase=dbase,
            duv=duv,
            dframes=dframes,
        )
        dparams = tuple(grads.values()) if learn else (None,) * len(params)
        return dbase, dframes, duv, None, None, None, None, *dparams


def view_base(f_view: Tensor) -> Tensor:
    """ReLU(f_view + 0.5): a fragment's colour without residual."""
    return torch.relu(f_view + COLOR_BIAS)


def shade(
    fragments: Fragments,
    base: Tensor,
    frames: Tensor,
    geometry: FieldGeometry | None = None,
    params: tuple[Tensor, ...] = (),
    bound: float = 0.0,
    move_surfels: bool = False,
) -> Tensor:
    """colour = ReLU(ReLU(f_view(d) + 0.5) + rho(x)), x = mean + u s_u t_u + v s_v t_v.

    Args:
        fragments: F fragments.
        base: [N, 3] f_view of every surfel.
        frames: [N, 9] of the projection.
        geometry, params: the residual field (table, w1, w2, w3); none = no residual. Parameters that do not require a
            gradient get none, and the field is then not evaluated in the backward pass.
        bound: fragments of weight below this keep ReLU(f_view + 0.5).
        move_surfels: the gradient of rho with respect to x reaches uv and frames.

    Returns:
        [F, 3].
    """
    n = fragments.surfels
    check_shapes(base=(base, (n, 3)), frames=(frames, (n, FRAME)))
    named = dict(zip(("field_table", "field_w1", "field_w2", "field_w3"), params, strict=False))
    on_same_device(fragments.weight, base=base, frames=frames, **named)
    return _Shade.apply(base, frames, fragments.uv, fragments, geometry, bound, move_surfels, *params)
