"""The fragment list by the CUDA kernels (csrc/cuda/pairs.h describes it).

Two numbers decide how much memory is needed, so the host waits for the device twice a view: for the number of pairs of
surfel and tile, and for the number of fragments. Nothing else in a training step has to wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .backend import kernel, module, workspace
from .project import Projection

WARPS = 8
"""Of a tile's block."""
COLUMNS = 16
"""Sums a pair in the backward pass."""


def find(geom: Tensor, projection: Projection) -> tuple[Any, ...]:
    """The fragments of a view.

    Args:
        geom: [N, 16] without graph.
        projection: the view's.

    Returns:
        layout, tile_start, surfel, pixel, weight, uv, depth, sigma as in `Fragments`.

    Raises:
        RuntimeError: more than 2^31 pairs of surfel and tile.
        torch.cuda.OutOfMemoryError: the list does not fit the device; the message has its length.
    """
    camera, near, n = projection.camera, projection.near, geom.shape[0]
    size = (camera.width, camera.height)
    tiles = -(-camera.width // 16) * -(-camera.height // 16)

    def ints(*shape: int) -> Tensor:
        return torch.empty(shape, dtype=torch.int32, device=geom.device)

    def longs(count: int) -> Tensor:
        return torch.empty(count, dtype=torch.int64, device=geom.device)

    order, slot_start = ints(n), longs(n + 1)
    space = workspace("bin_count", geom, n)
    kernel("bin_count", geom)(geom, projection.radii, *size, order, slot_start, space)
    pairs = int(slot_start[-1])  # waits
    if pairs >= 2**31:
        raise RuntimeError(
            f"the view has {pairs:,} pairs of surfel and tile, more than 2^31: surfels are far too large for an image "
            f"of {camera.width} x {camera.height} pixels"
        )
    slot, surfel_of_pair, tile_pairs = ints(pairs), ints(pairs), longs(tiles + 1)
    space = workspace("bin_fill", geom, pairs, *size)
    kernel("bin_fill", geom)(geom, *size, order, slot_start, slot, surfel_of_pair, tile_pairs, space)

    masks, offsets, tile_start = ints(WARPS, pairs), longs(pairs + 1), longs(tiles + 1)
    space = workspace("trace_mark", geom, pairs)
    kernel("trace_mark", geom)(
        geom, projection.radii, near, *size, surfel_of_pair, tile_pairs, masks, offsets, tile_start, space
    )
    count = int(offsets[-1])  # waits
    del space

    layout = module(geom.device).Pairs(
        *size, count, surfel_of_pair, slot, masks, offsets, tile_pairs, order, slot_start
    )
    try:
        surfel, pixel = ints(count), ints(count)
        weight, depth, sigma = (geom.new_empty(count) for _ in range(3))
        uv = geom.new_empty(2, count)
    except torch.cuda.OutOfMemoryError as error:
        needed = count * (8 + 5 * geom.element_size()) / 2**30
        raise torch.cuda.OutOfMemoryError(
            f"the view has {count:,} fragments ({count / (size[0] * size[1]):.0f} a pixel), whose list needs "
            f"{needed:.1f} GiB and does not fit the device: render a smaller image or use fewer surfels ({error})"
        ) from error
    kernel("trace_fill", geom)(geom, near, layout, surfel, pixel, weight, uv, depth, sigma)
    return layout, tile_start, surfel, pixel, weight, uv, depth, sigma


def backward(
    geom: Tensor,
    projection: Projection,
    rim: float,
    layout: Any,
    arrays: Sequence[Tensor],
    grads: Sequence[Tensor | None],
    dgeom: Tensor,
    absgrad: Tensor,
) -> None:
    """Writes dgeom [N, 16] and absgrad [N, 2] from the gradients of weight, uv and depth (None = zero)."""
    dsigma, partial = geom.new_empty(layout.fragments), geom.new_empty(layout.pairs, COLUMNS)
    kernel("trace_backward", geom)(geom, projection.near, rim, layout, *arrays, *grads, dsigma, partial, dgeom, absgrad)
