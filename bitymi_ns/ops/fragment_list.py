"""What a list of fragments is made of, on a CPU and on a CUDA device alike."""

from __future__ import annotations

import torch
from torch import Tensor

from .errors import TooManyFragments
from .project import Projection


def empty_list(geom: Tensor, count: int) -> dict[str, Tensor]:
    """The arrays of `Fragments` by name, for the kernels to fill."""
    found = {name: geom.new_empty(count, dtype=torch.int32) for name in ("surfel", "pixel")}
    found |= {name: geom.new_empty(count) for name in ("weight", "depth", "sigma")}
    return found | {"uv": geom.new_empty(2, count)}


def too_many(geom: Tensor, projection: Projection, count: int, most: int) -> TooManyFragments:
    """The refusal of a list of `count` fragments: 8 bytes each and 5 numbers like those of `geom`."""
    return TooManyFragments(count, most, projection.camera.width, projection.camera.height, 8 + 5 * geom.element_size())
