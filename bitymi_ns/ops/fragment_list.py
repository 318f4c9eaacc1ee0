"""What a list of fragments is made of, on a CPU and on a CUDA device alike."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from .errors import TooManyFragments
from .project import Projection


def empty_list(geom: Tensor, count: int) -> dict[str, Tensor]:
    """The numbers of `count` fragments by name, for the kernels to fill."""
    return {name: geom.new_empty(count) for name in ("weight", "depth", "sigma")} | {"uv": geom.new_empty(2, count)}


def empty_places(like: Tensor, count: int) -> dict[str, Tensor]:
    """Whose they are and where, likewise: surfel, pixel [count] int32."""
    return {name: like.new_empty(count, dtype=torch.int32) for name in ("surfel", "pixel")}


class Places:
    """Whose the fragments of a list are and where. On the CPU the list's layout says it, which is enough for most of
    what is done with a list: there the arrays are made when they are first asked for."""

    def __init__(self, find: Callable[[], dict[str, Tensor]]) -> None:
        self._find = find
        self._found: dict[str, Tensor] | None = None

    def arrays(self) -> dict[str, Tensor]:
        """surfel, pixel [F] int32."""
        if self._found is None:
            with torch.inference_mode(False):  # kept, so that a graph may need them later
                self._found = self._find()
        return self._found


def too_many(geom: Tensor, projection: Projection, count: int, most: int, places: bool) -> TooManyFragments:
    """The refusal of a list of `count` fragments: 5 numbers each like those of `geom`, and 8 bytes with `places`."""
    size = 5 * geom.element_size() + 8 * places
    return TooManyFragments(count, most, projection.camera.width, projection.camera.height, size)
