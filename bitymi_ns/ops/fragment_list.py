"""What a list of fragments is made of, on a CPU and on a CUDA device alike."""

from __future__ import annotations

import torch
from torch import Tensor

from .errors import TooManyFragments
from .project import Projection


def empty_list(geom: Tensor, count: int) -> tuple[Tensor, ...]:
    """surfel, pixel, weight, uv, depth, sigma as in `Fragments`, for the kernels to fill."""
    surfel, pixel = (geom.new_empty(count, dtype=torch.int32) for _ in range(2))
    weight, depth, sigma = (geom.new_empty(count) for _ in range(3))
    return surfel, pixel, weight, geom.new_empty(2, count), depth, sigma


def too_many(geom: Tensor, projection: Projection, count: int, most: int) -> TooManyFragments:
    """The refusal of a list of `count` fragments: 8 bytes each and 5 numbers like those of `geom`."""
    return TooManyFragments(count, most, projection.camera.width, projection.camera.height, 8 + 5 * geom.element_size())
