"""Fragment lists by the CPU kernels."""

import functools
from typing import Any

import torch
from torch import Tensor

from bitymi_ns.exit_messages import out_of_memory
from .backend import Pool, function, kernel, kernel_class, module
from .capacity import TooManyFragments
from .fragment_list import Layout, empty_ids, empty_list
from .project import Projection

MOST = 1 << 25
"""Default limit of a list's fragments: 1.2 GB with blending and its backward pass, 36 bytes per fragment (96 with a
field). Fixed, so that results do not depend on the machine."""

_pool = functools.cache(Pool)


def tracers(like: Tensor) -> Pool[Any]:
    """Tracers for tensors like `like`, which keep their memory between views."""
    return _pool(kernel_class("Trace", like))


@functools.cache
def tile_lists() -> Pool[Any]:
    """Memory for the tile lists of views whose fragments are not listed."""
    return Pool(module(torch.device("cpu")).Bins)


def find_fragments(geom: Tensor, projection: Projection, most: int | None = None) -> tuple[Layout, dict[str, Tensor]]:
    """Find the fragments of a view: their layout, and the numbers of `Fragments` by name. Raises TooManyFragments: more
    than `most` (0: `MOST`; None: no limit), or, with a limit, than memory holds."""
    most = MOST if most == 0 else most or 0
    with tracers(geom).borrow() as tracer:
        n = tracer.run(**projection.view(geom), **projection.alpha_arrays, most=most)
        if most and n > most:
            raise TooManyFragments(geom, projection, n, most, ids=False)
        try:
            listed = empty_list(geom, n)
        except RuntimeError as error:  # of torch's allocator
            if not most or not out_of_memory(error):
                raise
            raise TooManyFragments(geom, projection, n, n // 2, ids=False) from error
        arrays = _empty_layout(tracer.tiles, tracer.blocks)
        tracer.copy(**listed, **arrays)
    return _layout(arrays, projection.camera.width, projection.camera.height), listed


def select(
    layout: Layout, numbers: dict[str, Tensor], keep: Tensor, width: int, height: int
) -> tuple[Layout, dict[str, Tensor]]:
    """Select the fragments of a list with `keep` [F]; returns their layout and numbers, as `find_fragments` does."""
    listed = empty_list(numbers["weight"], int(keep.sum()))
    arrays = _empty_layout(len(layout.arrays["tile_start"]) - 1, len(layout.arrays["blocks"]))
    kept = {f"kept_{name}": values for name, values in listed.items()}
    flags = keep.contiguous().view(torch.uint8)
    kernel("select_fragments", numbers["weight"])(layout=layout.handle, keep=flags, **numbers, **kept, **arrays)
    arrays["blocks"] = arrays["blocks"][: int(arrays["block_start"][-1])].clone()
    return _layout(arrays, width, height), listed


def _empty_layout(tiles: int, blocks: int) -> dict[str, Tensor]:
    starts = {name: torch.empty(tiles + 1, dtype=torch.int64) for name in ("tile_start", "block_start")}
    return starts | {"blocks": torch.empty(blocks, 2, dtype=torch.int32)}


def _layout(arrays: dict[str, Tensor], width: int, height: int) -> Layout:
    cpu = arrays["blocks"].device
    handle, list_ids = module(cpu).TileBlocks(**arrays), function("list_ids", cpu)

    def ids() -> dict[str, Tensor]:
        listed = empty_ids(arrays["blocks"], int(arrays["tile_start"][-1]))
        list_ids(layout=handle, width=width, height=height, **listed)
        return listed

    return Layout(handle, arrays, ids)


def count(projection: Projection) -> int:
    """Count the fragments of a view on the CPU without making their list."""
    geom = projection.geom.detach()
    with tracers(geom).borrow() as tracer:
        return tracer.run(**projection.view(geom), **projection.alpha_arrays, most=1)
