"""Pairs of surfel and screen tile of a view, by the CUDA kernels."""

from dataclasses import dataclass

import torch
from torch import Tensor

from .backend import kernel, workspace
from .constants import TILE
from .project import CameraLike, Projection


@dataclass(frozen=True)
class Bins:
    """P pairs of a surfel and a screen tile that it may touch. Slots number them by surfel, front to back."""

    order: Tensor  # [N] int32 surfels front to back
    slot_start: Tensor  # [N + 1] int64 first slot of the surfel at each rank of that order
    slot: Tensor  # [P] int32, by tile, then front to back: the pair's slot
    surfel: Tensor  # [P] int32, likewise: the pair's surfel
    tile_pairs: Tensor  # [tiles + 1] int64, first pair of each tile


def int32s(like: Tensor, *shape: int) -> Tensor:
    return torch.empty(shape, dtype=torch.int32, device=like.device)


def int64s(like: Tensor, count: int) -> Tensor:
    return torch.empty(count, dtype=torch.int64, device=like.device)


def check_pair_count(pairs: int, camera: CameraLike) -> None:
    """Raise RuntimeError for 2^31 pairs of surfel and tile or more."""
    if pairs >= 2**31:
        raise RuntimeError(
            f"the view has {pairs:,} pairs of surfel and tile, not below 2^31: the surfels are far too large for an "
            f"image of {camera.width} x {camera.height} pixels"
        )


def tile_lists(geom: Tensor, projection: Projection) -> Bins:
    """List the pairs of surfel and tile of a view; waits once for their number. Raises: as `check_pair_count`."""
    camera, n, view = projection.camera, geom.shape[0], projection.view(geom)
    tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
    ranks = {"order": int32s(geom, n), "slot_start": int64s(geom, n + 1)}
    kernel("bin_count", geom)(**view, **ranks, workspace=workspace("bin_count", geom, n=n))
    pairs = int(ranks["slot_start"][-1])
    check_pair_count(pairs, camera)
    lists = {"slot": int32s(geom, pairs), "surfel": int32s(geom, pairs), "tile_pairs": int64s(geom, tiles + 1)}
    space = workspace("bin_fill", geom, pairs=pairs, width=camera.width, height=camera.height)
    kernel("bin_fill", geom)(**view, **ranks, **lists, workspace=space)
    return Bins(**ranks, **lists)
