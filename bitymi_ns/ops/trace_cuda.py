"""Fragment lists by the CUDA kernels; described in csrc/cuda/fragment_list.h.

Memory depends on two counts, so the host waits for the device twice per view: for the pairs of surfel and tile, and for
the fragments. Images without lists need the first only (rasterize_cuda.py).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from .backend import function, kernel, module, on_device, require, workspace
from .constants import TILE
from .fragment_list import Layout, TooManyFragments, empty_ids, empty_list
from .project import Camera, Projection

NUMBERS = 24
"""Numbers per fragment in a training step: 7 in the list, 3 of its residual, 8 of gradients; the rest is slack."""
FEW = 1 << 23  # up to this many fragments free memory is not queried
LISTS_PER_CHECK = 100
"""Lists between queries of free memory. A query takes a tenth of a training step, and between steps only other programs
change the answer, as torch keeps a list's memory for the next one."""


@dataclass
class _Room:
    """Fragments that fit into a device's free memory, as last measured."""

    capacity: int  # fragments
    largest: int  # longest list checked against it
    lists: int = 0  # since then


_rooms: dict[torch.device, _Room] = {}


@dataclass(frozen=True)
class Bins:
    """P potentially touching pairs of surfel and tile."""

    order: Tensor  # [N] int32 surfels front to back
    slot_start: Tensor  # [N + 1] int64 first slot of the surfel at each rank of that order
    slot: Tensor  # [P] int32, by tile, then front to back: the pair's slot
    surfel: Tensor  # [P] int32, likewise: the pair's surfel
    tile_pairs: Tensor  # [tiles + 1] int64, first pair of each tile
    differing: Tensor  # [1] int32, difference between listed and counted pairs; not 0: the kernels are miscompiled

    @property
    def layout(self) -> dict[str, Tensor]:
        """Index of a fragment list, by name."""
        return {name: value for name, value in vars(self).items() if name != "differing"}


def _ints(like: Tensor, *shape: int) -> Tensor:
    return torch.empty(shape, dtype=torch.int32, device=like.device)


def _longs(like: Tensor, count: int) -> Tensor:
    return torch.empty(count, dtype=torch.int64, device=like.device)


def check_pair_count(pairs: int, camera: Camera) -> None:
    """Raise a RuntimeError if a view has 2^31 pairs of surfel and tile or more."""
    if pairs >= 2**31:
        raise RuntimeError(
            f"the view has {pairs:,} pairs of surfel and tile, not below 2^31: the surfels are far too large for an "
            f"image of {camera.width} x {camera.height} pixels"
        )


def tile_lists(geom: Tensor, projection: Projection) -> Bins:
    """List the pairs of surfel and tile of a view; waits once for their number.

    Raises:
        RuntimeError: 2^31 pairs or more.
    """
    require("trace_cuda.tile_lists", "cuda", geom.device, "call `trace`")
    camera, n, view = projection.camera, geom.shape[0], projection.view(geom)
    tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
    ranks = {"order": _ints(geom, n), "slot_start": _longs(geom, n + 1)}
    kernel("bin_count", geom)(**view, **ranks, workspace=workspace("bin_count", geom, n=n))
    pairs = int(ranks["slot_start"][-1])
    check_pair_count(pairs, camera)
    lists = {"slot": _ints(geom, pairs), "surfel": _ints(geom, pairs), "tile_pairs": _longs(geom, tiles + 1)}
    lists["differing"] = _ints(geom, 1)
    space = workspace("bin_fill", geom, pairs=pairs, width=camera.width, height=camera.height)
    kernel("bin_fill", geom)(**view, **ranks, **lists, workspace=space)
    return Bins(**ranks, **lists)


def blended(geom: Tensor, projection: Projection, bins: Bins) -> Layout:
    """Mark the pixels where each pair blends: returns the layout of the fragment list, surfels and pixels unwritten.
    Waits once for the number of fragments."""
    require("trace_cuda.blended", "cuda", geom.device, "call `trace`")
    camera, pairs = projection.camera, bins.surfel.shape[0]
    marks = {"masks": _ints(geom, module(geom.device).TILE_WARPS, pairs), "offsets": _longs(geom, pairs + 1)}
    kernel("trace_mark", geom)(
        **projection.view(geom),
        **projection.alpha_arrays,
        **marks,
        surfel=bins.surfel,
        tile_pairs=bins.tile_pairs,
        workspace=workspace("trace_mark", geom, pairs=pairs),
    )
    return layout_of(marks | bins.layout, camera.width, camera.height)


def layout_of(arrays: dict[str, Tensor], width: int, height: int, ids: dict[str, Tensor] | None = None) -> Layout:
    """Build the layout of P pairs of surfel and tile. Waits for the number of fragments if there are offsets.

    Args:
        arrays: from `Bins.layout`, masks [TILE_WARPS, P] int32 and offsets [P + 1] int64 (none without a list).
        width, height: of the image, pixels.
        ids: surfel and pixel [F] int32 of the fragments; None: not written yet.
    """
    masks = arrays["masks"]
    count = int(arrays["offsets"][-1]) if "offsets" in arrays else -1
    with on_device(masks.device):
        handle = module(masks.device).Pairs(**arrays, width=width, height=height, fragments=count)
    return Layout(handle, arrays, lambda: empty_ids(masks, count) if ids is None else ids)


def free_memory(device: torch.device) -> int:
    """Return the free bytes of a CUDA device, including what torch holds unused."""
    kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + kept


def fragment_capacity(geom: Tensor) -> int:
    """Compute the number of fragments whose training step fits into the free memory of a CUDA device."""
    return free_memory(geom.device) // (NUMBERS * geom.element_size())


def check_capacity(geom: Tensor, projection: Projection, count: int, most: int | None) -> None:
    """Raise TooManyFragments if a list is longer than allowed or, with most = 0, than memory permits.

    Free memory is queried for a list longer than all before, and every `LISTS_PER_CHECK` lists."""
    if most == 0 and geom.device.type == "cuda" and count > FEW:
        room = _rooms.get(geom.device)
        if room is None or count > room.largest or room.lists >= LISTS_PER_CHECK:
            room = _rooms[geom.device] = _Room(fragment_capacity(geom), count)
        room.lists += 1
        most = room.capacity
    if most and count > most:
        raise TooManyFragments(geom, projection, count, most, ids=True)


def fill(geom: Tensor, projection: Projection, layout: Layout) -> dict[str, Tensor]:
    """Compute the numbers of `Fragments` by name; raises TooManyFragments if memory is insufficient."""
    count = layout.handle.fragments
    try:
        found, ids = empty_list(geom, count), layout.ids()
    except torch.cuda.OutOfMemoryError as error:
        raise TooManyFragments(geom, projection, count, fragment_capacity(geom), ids=True) from error
    view = projection.view(geom) | projection.alpha_arrays
    kernel("trace_fill", geom)(**view, **found, **ids, layout=layout.handle)
    return found


def find_fragments(geom: Tensor, projection: Projection, most: int | None = None) -> tuple[Layout, dict[str, Tensor]]:
    """Find the fragments of a view.

    Args:
        geom: [N, 16], detached.
        most: largest number of fragments; 0: as many as a training step has memory for; None: no limit.

    Returns:
        layout, and the numbers of `Fragments` by name.

    Raises:
        RuntimeError: 2^31 pairs of surfel and tile or more.
        TooManyFragments: there are more, or their list does not fit into the device's memory.
    """
    layout = blended(geom, projection, tile_lists(geom, projection))
    check_capacity(geom, projection, layout.handle.fragments, most)
    return layout, fill(geom, projection, layout)


def select(
    layout: Layout, numbers: dict[str, Tensor], keep: Tensor, width: int, height: int
) -> tuple[Layout, dict[str, Tensor]]:
    """Select fragments: their layout, and their numbers.

    Args:
        layout, numbers: of a list of F fragments.
        keep: [F] bool.
        width, height: of the image, pixels.
    """
    masks, counts = torch.empty_like(layout.arrays["masks"]), torch.empty_like(layout.arrays["offsets"][1:])
    flags = keep.contiguous().view(torch.uint8)
    function("select_fragments", keep.device)(layout=layout.handle, keep=flags, masks=masks, counts=counts)
    offsets, rows = torch.nn.functional.pad(counts.cumsum(0), (1, 0)), keep.nonzero().squeeze(1)
    ids = {name: value[rows] for name, value in layout.ids().items()}
    found = {name: value[..., rows].contiguous() for name, value in numbers.items()}
    return layout_of(layout.arrays | {"masks": masks, "offsets": offsets}, width, height, ids), found


def backward_memory(geom: Tensor, layout: Layout, texel_alpha: Tensor | None) -> dict[str, Tensor]:
    """Allocate working memory of the backward kernel, by name.

    Args:
        geom: [N, 16], detached.
        texel_alpha: [T] texels with a gradient, summed in int64 with deterministic algorithms; None: none.
    """
    kernels = module(geom.device)
    work = {"dsigma": geom.new_empty(layout.handle.fragments)}
    work["partial"] = geom.new_empty(layout.handle.pairs, kernels.TRACE_SUMS)
    if texel_alpha is not None and torch.are_deterministic_algorithms_enabled():
        numbers = kernels.exact_size(len(texel_alpha))
        work["exact_work"] = torch.empty(numbers, dtype=torch.int64, device=geom.device)
    return work
