"""The fragment list by the CUDA kernels (csrc/cuda/pairs.h describes it).

Two numbers decide how much memory is needed, so the host waits for the device twice per view: for the number of pairs
of surfel and tile, and for the number of fragments. Nothing else in a training step has to wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .backend import kernel, module, workspace
from .constants import TILE
from .fragment_list import empty_list, too_many
from .project import Projection

NUMBERS = 24
"""That a fragment takes in a training step: 7 in the list, 3 of its colour, 8 of their gradients; the rest is slack."""
FEW = 1 << 23
"""Fragments for which there is always room, so that nobody asks the device for its free memory."""


@dataclass(frozen=True)
class Bins:
    """Which surfels may touch which tiles; P pairs.

    Attributes:
        order: [N] int32 surfels front to back.
        slot_start: [N + 1] int64 by rank in that order: the surfel's first slot.
        slot: [P] int32, by tile, then front to back: the pair's slot.
        surfel: [P] int32, likewise: the pair's surfel.
        tile_pairs: [tiles + 1] int64, where each tile's pairs begin.
    """

    order: Tensor
    slot_start: Tensor
    slot: Tensor
    surfel: Tensor
    tile_pairs: Tensor


def _ints(like: Tensor, *shape: int) -> Tensor:
    return torch.empty(shape, dtype=torch.int32, device=like.device)


def _longs(like: Tensor, count: int) -> Tensor:
    return torch.empty(count, dtype=torch.int64, device=like.device)


def tile_lists(geom: Tensor, projection: Projection) -> Bins:
    """Pairs of surfel and tile of a view; waits once for their number.

    Raises:
        RuntimeError: 2^31 pairs or more.
    """
    camera, n = projection.camera, geom.shape[0]
    size = (camera.width, camera.height)
    tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
    order, slot_start = _ints(geom, n), _longs(geom, n + 1)
    space = workspace("bin_count", geom, n)
    kernel("bin_count", geom)(geom, projection.radii, *size, projection.through_pixel, order, slot_start, space)
    pairs = int(slot_start[-1])
    if pairs >= 2**31:
        raise RuntimeError(
            f"the view has {pairs:,} pairs of surfel and tile, not below 2^31: the surfels are far too large for an "
            f"image of {camera.width} x {camera.height} pixels"
        )
    slot, surfel, tile_pairs = _ints(geom, pairs), _ints(geom, pairs), _longs(geom, tiles + 1)
    space = workspace("bin_fill", geom, pairs, *size)
    kernel("bin_fill", geom)(geom, *size, projection.through_pixel, order, slot_start, slot, surfel, tile_pairs, space)
    return Bins(order, slot_start, slot, surfel, tile_pairs)


def blended(geom: Tensor, projection: Projection, bins: Bins) -> tuple[Any, Tensor]:
    """Which pixels blend which pairs: the layout of the fragment list and tile_start [tiles + 1] int64; waits once for
    the number of fragments."""
    camera, pairs = projection.camera, bins.surfel.shape[0]
    size = (camera.width, camera.height)
    masks, offsets = _ints(geom, module(geom.device).TILE_WARPS, pairs), _longs(geom, pairs + 1)
    tile_start = torch.empty_like(bins.tile_pairs)
    space = workspace("trace_mark", geom, pairs)
    kernel("trace_mark", geom)(
        geom,
        projection.radii,
        projection.near,
        projection.through_pixel,
        *size,
        bins.surfel,
        bins.tile_pairs,
        masks,
        offsets,
        tile_start,
        space,
    )
    count = int(offsets[-1])
    layout = module(geom.device).Pairs(
        *size, count, bins.surfel, bins.slot, masks, offsets, bins.tile_pairs, bins.order, bins.slot_start
    )
    return layout, tile_start


def room(geom: Tensor) -> int:
    """Fragments that the free memory of a CUDA device holds with all that a training step makes of them."""
    free = torch.cuda.mem_get_info(geom.device)[0]
    kept = torch.cuda.memory_reserved(geom.device) - torch.cuda.memory_allocated(geom.device)  # by torch, unused
    return (free + kept) // (NUMBERS * geom.element_size())


def check_room(geom: Tensor, projection: Projection, count: int, most: int | None) -> None:
    """Raises TooManyFragments for a list that is longer than allowed or, with most = 0, than there is memory for."""
    if most == 0 and geom.device.type == "cuda" and count > FEW:
        most = room(geom)
    if most and count > most:
        raise too_many(geom, projection, count, most)


def fill(geom: Tensor, projection: Projection, layout: Any) -> tuple[Tensor, ...]:
    """surfel, pixel, weight, uv, depth, sigma as in `Fragments`; raises TooManyFragments where they find no room."""
    count = layout.fragments
    try:
        arrays = empty_list(geom, count)
    except torch.cuda.OutOfMemoryError as error:
        raise too_many(geom, projection, count, room(geom)) from error
    kernel("trace_fill", geom)(geom, projection.near, projection.through_pixel, layout, *arrays)
    return arrays


def find(geom: Tensor, projection: Projection, most: int | None = None) -> tuple[Any, ...]:
    """The fragments of a view.

    Args:
        geom: [N, 16] without graph.
        projection: the view's.
        most: fragments that there may be; 0 = as many as a training step has memory for; None = any number.

    Returns:
        layout, tile_start, surfel, pixel, weight, uv, depth, sigma as in `Fragments`.

    Raises:
        RuntimeError: 2^31 pairs of surfel and tile or more.
        TooManyFragments: there are more than that, or the device has no memory for their list.
    """
    layout, tile_start = blended(geom, projection, tile_lists(geom, projection))
    check_room(geom, projection, layout.fragments, most)
    return layout, tile_start, *fill(geom, projection, layout)


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
    dsigma = geom.new_empty(layout.fragments)
    partial = geom.new_empty(layout.pairs, module(geom.device).TRACE_SUMS)
    near, through = projection.near, projection.through_pixel
    kernel("trace_backward", geom)(geom, near, through, rim, layout, *arrays, *grads, dsigma, partial, dgeom, absgrad)
