"""Parts of a fragment list shared by the CPU and CUDA."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def empty_list(geom: Tensor, count: int) -> dict[str, Tensor]:
    """Allocate weight, depth and sigma [count] and uv [2, count] of fragments, by name."""
    return {name: geom.new_empty(count) for name in ("weight", "depth", "sigma")} | {"uv": geom.new_empty(2, count)}


def empty_ids(like: Tensor, count: int) -> dict[str, Tensor]:
    """Allocate surfel and pixel of `count` fragments by name, [count] int32."""
    return {name: like.new_empty(count, dtype=torch.int32) for name in ("surfel", "pixel")}


class Layout:
    """Index of a fragment list: its runs by tile, and surfel and pixel of each fragment.

    On the CPU the runs imply surfels and pixels, which suffices for most operations; these arrays are made at first
    use.

    Attributes:
        handle: the kernels' object: `TileBlocks` (csrc/cpu/blocks.h) or `Pairs` (csrc/cuda/fragment_list.h).
        arrays: arrays it refers to, by name.
    """

    def __init__(self, handle: Any, arrays: dict[str, Tensor], find_ids: Callable[[], dict[str, Tensor]]) -> None:
        """
        Args:
            handle, arrays: see above.
            find_ids: computes surfel, pixel [F] int32 by name.
        """
        self.handle, self.arrays = handle, arrays
        self._find_ids = find_ids
        self._ids: dict[str, Tensor] | None = None

    def ids(self) -> dict[str, Tensor]:
        """Return surfel and pixel, [F] int32, by name."""
        if self._ids is None:
            with torch.inference_mode(False):  # cached, and may be used in a graph later
                self._ids = self._find_ids()
        return self._ids

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(array.nbytes for array in (*self.arrays.values(), *(self._ids or {}).values()))
