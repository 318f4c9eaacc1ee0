"""Residual colour field rho(x) = f_phi(E_theta(x)): contraction, hash grid, MLP."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from .backend import check_shapes, cuda_backend, dense, kernel, kernel_class, module, on_device, on_same_device
from .constants import FEATURES, FRAME, WIDTH
from .trace import Fragments

WEIGHTS = ("table", "w1", "w2", "w3")  # the kernels' parameter names


@dataclass(frozen=True)
class FieldGeometry:
    """Placement of the hash grid in the world."""

    min_resolution: int  # cells along an edge of the coarsest level; each level doubles it
    # mip-NeRF 360 contraction: the ball around `mid` of radius `half` is kept, the space outside maps into the shell up
    # to twice that. Without it, positions are clamped to the cube of half edge `half`
    contract: bool
    mid: tuple[float, float, float]  # centre, world units
    half: float  # radius or half edge, world units


def kernel_field(geometry: FieldGeometry, table: Tensor, w1: Tensor, w2: Tensor, w3: Tensor):
    """Wrap the field's parameters for the kernels. Raises ValueError: shapes do not match."""
    levels, size, features = table.shape
    log2_size = size.bit_length() - 1
    if features != FEATURES or size != 1 << log2_size:
        raise ValueError(f"field_table must be [levels, power of two, {FEATURES}], not {list(table.shape)}")
    check_shapes(field_w1=(w1, (levels * FEATURES, WIDTH)), field_w2=(w2, (WIDTH, WIDTH)), field_w3=(w3, (WIDTH, 3)))
    weights = {name: dense(t, table) for name, t in zip(WEIGHTS, (table, w1, w2, w3), strict=True)}
    where = {"min_resolution": geometry.min_resolution, "contract": geometry.contract}
    where |= {"mid": tuple(geometry.mid), "half": geometry.half}
    with on_device(table.device):
        return kernel_class("Field", table)(**weights, **where, levels=levels, log2_size=log2_size)


class _Field(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, geometry, *params):
        points = dense(x, params[0])
        rho = torch.empty_like(points)
        kernel("field_forward", points)(field=kernel_field(geometry, *params), x=points, rho=rho)
        ctx.save_for_backward(points, *params)
        ctx.geometry = geometry
        return rho

    @staticmethod
    def backward(ctx, drho):
        points, *params = ctx.saved_tensors
        grads = {f"d{name}": torch.empty_like(p) for name, p in zip(WEIGHTS, params, strict=True)}
        dx = torch.empty_like(points) if ctx.needs_input_grad[0] else None
        work = {}
        if cuda_backend(points.device):  # sums of the MLP's gradients per block, and exact sums of the table's
            kernels = module(points.device)
            work["mlp_work"] = points.new_empty(kernels.MLP_WORK)
            if torch.are_deterministic_algorithms_enabled():
                numbers = kernels.exact_size(params[0].numel())
                work["exact_work"] = torch.empty(numbers, dtype=torch.int64, device=points.device)
        handle = kernel_field(ctx.geometry, *params)
        kernel("field_backward", points)(field=handle, x=points, drho=dense(drho, points), dx=dx, **grads, **work)
        return dx, None, *grads.values()


def field(x: Tensor, geometry: FieldGeometry, table: Tensor, w1: Tensor, w2: Tensor, w3: Tensor) -> Tensor:
    """Evaluate the residual colour [M, 3], unbounded, at world positions x [M, 3], eq. (color): levels interpolated
    trilinearly, concatenated and decoded by an MLP with two hidden layers of 16 ReLU units, no biases, linear output.

    Args:
        table: [levels, T, 4] features, T a power of two; cells are hashed by XOR of coordinate times prime.
        w1, w2, w3: [4 levels, 16], [16, 16], [16, 3] weights, input-major.
    """
    on_same_device(x, field_table=table, field_w1=w1, field_w2=w2, field_w3=w3)
    return _Field.apply(x, geometry, table, w1, w2, w3)


def fragment_residual(
    fragments: Fragments,
    frames: Tensor,
    geometry: FieldGeometry,
    weights: Sequence[Tensor],
    bound: float = 0.0,
    move_surfels: bool = False,
) -> Tensor:
    """Evaluate rho(x) [F, 3] at fragments, x = mean + u s_u t_u + v s_v t_v.

    Args:
        frames: [N, 9] of the projection.
        weights: table, w1, w2, w3, as in `field`.
        bound: fragments of smaller weight get 0.
        move_surfels: propagate the gradient of rho with respect to x to uv and frames.

    Raises:
        ValueError: shapes or devices do not match.
    """
    check_shapes(frames=(frames, (fragments.surfels, FRAME)))
    on_same_device(fragments.weight, frames=frames)
    if not move_surfels:
        frames = frames.detach()
    rows = (fragments.weight.detach() >= bound).nonzero().squeeze(1)
    placed = frames.index_select(0, fragments.surfel.index_select(0, rows))
    uv = fragments.uv if move_surfels else fragments.uv.detach()
    u, v = uv.index_select(1, rows).unsqueeze(2)
    x = placed[:, :3] + u * placed[:, 3:6] + v * placed[:, 6:]
    return frames.new_zeros(len(fragments), 3).index_copy(0, rows, field(x, geometry, *weights))
