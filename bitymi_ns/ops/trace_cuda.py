"""Fragment lists by the CUDA kernels; described in csrc/cuda/fragment_list.h.

Memory depends on two counts, so the host waits for the device twice per view: for the pairs of surfel and tile, and for
the fragments. Images without lists need the first only (rasterize_cuda.py).
"""

import torch
from torch import Tensor

from .backend import function, kernel, module, on_device, workspace
from .bin_cuda import Bins, int32s, int64s, tile_lists
from .capacity import TooManyFragments, check_capacity, fragment_capacity
from .fragment_list import Layout, empty_ids, empty_list
from .project import Projection


def blended(geom: Tensor, projection: Projection, bins: Bins) -> Layout:
    """Mark the pixels where each pair blends: returns the layout of the fragment list, surfels and pixels unwritten.
    Waits once for the number of fragments."""
    camera, pairs = projection.camera, bins.surfel.shape[0]
    marks = {"masks": int32s(geom, module(geom.device).TILE_WARPS, pairs), "offsets": int64s(geom, pairs + 1)}
    kernel("trace_mark", geom)(
        **projection.view(geom),
        **projection.alpha_arrays,
        **marks,
        surfel=bins.surfel,
        tile_pairs=bins.tile_pairs,
        workspace=workspace("trace_mark", geom, pairs=pairs),
    )
    return layout_of(marks | vars(bins), camera.width, camera.height)


def layout_of(arrays: dict[str, Tensor], width: int, height: int, ids: dict[str, Tensor] | None = None) -> Layout:
    """Build the layout of P pairs of surfel and tile. Waits for the number of fragments if there are offsets.

    Args:
        arrays: of `Bins` by name, masks [TILE_WARPS, P] int32 and offsets [P + 1] int64 (none without a list).
        width, height: of the image, pixels.
        ids: surfel and pixel [F] int32 of the fragments; None: not written yet.
    """
    masks = arrays["masks"]
    count = int(arrays["offsets"][-1]) if "offsets" in arrays else -1
    with on_device(masks.device):
        handle = module(masks.device).Pairs(**arrays, width=width, height=height, fragments=count)
    return Layout(handle, arrays, lambda: empty_ids(masks, count) if ids is None else ids)


def fill(geom: Tensor, projection: Projection, layout: Layout) -> dict[str, Tensor]:
    """Compute the numbers of `Fragments` by name; raises TooManyFragments if memory is insufficient."""
    count = layout.handle.fragments
    try:
        listed, ids = empty_list(geom, count), layout.ids()
    except torch.cuda.OutOfMemoryError as error:
        raise TooManyFragments(geom, projection, count, fragment_capacity(geom), ids=True) from error
    view = projection.view(geom) | projection.alpha_arrays
    kernel("trace_fill", geom)(**view, **listed, **ids, layout=layout.handle)
    return listed


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
    masks = torch.empty_like(layout.arrays["masks"])
    counts = torch.empty_like(layout.arrays["offsets"][1:])
    flags = keep.contiguous().view(torch.uint8)
    function("select_fragments", keep.device)(layout=layout.handle, keep=flags, masks=masks, counts=counts)
    offsets = torch.nn.functional.pad(counts.cumsum(0), (1, 0))
    rows = keep.nonzero().squeeze(1)
    ids = {name: value[rows] for name, value in layout.ids().items()}
    listed = {name: value[..., rows].contiguous() for name, value in numbers.items()}
    return layout_of(layout.arrays | {"masks": masks, "offsets": offsets}, width, height, ids), listed


def backward_memory(geom: Tensor, layout: Layout, texel_alpha: Tensor | None) -> dict[str, Tensor]:
    """Allocate working memory of the backward kernel, by name. `geom`: [N, 16], detached. `texel_alpha`: [T] texels
    with a gradient, summed in int64 with deterministic algorithms; None: none."""
    kernels = module(geom.device)
    work = {"dsigma": geom.new_empty(layout.handle.fragments)}
    work["partial"] = geom.new_empty(layout.handle.pairs, kernels.TRACE_SUMS)
    if texel_alpha is not None and torch.are_deterministic_algorithms_enabled():
        numbers = kernels.exact_size(len(texel_alpha))
        work["exact_work"] = torch.empty(numbers, dtype=torch.int64, device=geom.device)
    return work
