"""The fragment list by the CPU kernels."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from .backend import kernel, kernel_class
from .fragment_list import empty_list, too_many
from .project import Projection

MOST = 1 << 25
"""Fragments of a list whose length memory decides: 1.9 GB with what shading, blending and their backward pass add, 56
bytes per fragment. Fixed, so that what is computed does not depend on the machine."""

_idle: dict[object, list] = defaultdict(list)
_lock = threading.Lock()


@contextmanager
def borrowed_tracer(like: Tensor) -> Iterator[Any]:
    """A tracer for tensors like `like`. Tracers keep their memory from view to view; one is used by one thread at a
    time."""
    make = kernel_class("Trace", like)
    with _lock:
        tracer = _idle[make].pop() if _idle[make] else make()
    try:
        yield tracer
    finally:
        with _lock:
            _idle[make].append(tracer)


def find(geom: Tensor, projection: Projection, most: int | None = None) -> tuple[Tensor, ...]:
    """The fragments of a view.

    Args:
        geom: [N, 16] without graph.
        projection: the view's.
        most: fragments that there may be; 0 = `MOST`, None = any number.

    Returns:
        layout (tile_start), tile_start, surfel, pixel, weight, uv, depth, sigma as in `Fragments`.

    Raises:
        TooManyFragments: there are more than `most`.
    """
    camera = projection.camera
    most = MOST if most == 0 else most or 0
    with borrowed_tracer(geom) as tracer:
        size = (camera.width, camera.height)
        n = tracer.run(geom, projection.radii, *size, projection.near, projection.through_pixel, most)
        if most and n > most:
            raise too_many(geom, projection, n, most)
        arrays = empty_list(geom, n)
        tile_start = torch.empty(tracer.tiles + 1, dtype=torch.int64)
        tracer.copy(tile_start, *arrays)
    return tile_start, tile_start, *arrays


def count(projection: Projection) -> int:
    """Number of fragments of a view; their list is not made."""
    camera, geom = projection.camera, projection.geom.detach()
    size = (camera.width, camera.height)
    with borrowed_tracer(geom) as tracer:
        return tracer.run(geom, projection.radii, *size, projection.near, projection.through_pixel, 1)


def backward(
    geom: Tensor,
    projection: Projection,
    rim: float,
    tile_start: Tensor,
    arrays: Sequence[Tensor],
    grads: Sequence[Tensor | None],
    dgeom: Tensor,
    absgrad: Tensor,
) -> None:
    """Writes dgeom [N, 16] and absgrad [N, 2] from the gradients of weight, uv and depth (None = zero)."""
    p = projection
    kernel("trace_backward", geom)(
        geom, p.near, p.through_pixel, rim, p.camera.width, tile_start, *arrays, *grads, dgeom, absgrad
    )
