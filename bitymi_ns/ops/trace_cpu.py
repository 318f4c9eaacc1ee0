"""The fragment list by the CPU kernels."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor

from .backend import function, kernel_class, module, require
from .fragment_list import Places, empty_list, empty_places, too_many
from .pool import Pool
from .project import Projection

MOST = 1 << 25
"""Fragments of a list whose length memory decides: 1.2 GB with what blending and its backward pass add, 36 bytes per
fragment; 68 where a field shades them. Fixed, so that what is computed does not depend on the machine."""

_pool = functools.cache(Pool)


def tracers(like: Tensor) -> Pool[Any]:
    """Tracers for tensors like `like`, which keep their memory from view to view."""
    return _pool(kernel_class("Trace", like))


def find_fragments(
    geom: Tensor, projection: Projection, most: int | None = None
) -> tuple[Any, Tensor, dict[str, Tensor], Places]:
    """The fragments of a view.

    Args:
        geom: [N, 16] without graph.
        projection: the view's.
        most: fragments that there may be; 0 = `MOST`, None = any number.

    Returns:
        layout, tile_start, the numbers of `Fragments` by name, and its places.

    Raises:
        TooManyFragments: there are more than `most`.
        RuntimeError: the tensors are not on the CPU.
    """
    require("trace_cpu.find_fragments", "cpu", geom.device, "call `trace`")
    most = MOST if most == 0 else most or 0
    with tracers(geom).borrow() as tracer:
        n = tracer.run(**projection.view(geom), most=most)
        if most and n > most:
            raise too_many(geom, projection, n, most, places=False)
        found = empty_list(geom, n)
        starts = {name: torch.empty(tracer.tiles + 1, dtype=torch.int64) for name in ("tile_start", "pack_start")}
        packs = torch.empty(tracer.packs, 2, dtype=torch.int32)
        tracer.copy(**found, **starts, packs=packs)
    layout = module(geom.device).TilePacks(**starts, packs=packs)
    size = {"width": projection.camera.width, "height": projection.camera.height}
    list_places = function("list_places", packs.device)

    def places() -> dict[str, Tensor]:
        listed = empty_places(packs, n)
        list_places(layout=layout, **size, **listed)
        return listed

    return layout, starts["tile_start"], found, Places(places)


def count(projection: Projection) -> int:
    """Number of fragments of a view on the CPU; their list is not made.

    Raises:
        RuntimeError: the projection is not on the CPU.
    """
    geom = projection.geom.detach()
    require("trace_cpu.count", "cpu", geom.device, "count those of `trace`")
    with tracers(geom).borrow() as tracer:
        return tracer.run(**projection.view(geom), most=1)
