"""Views whose fragments exceed memory, drawn in bands of rows of tiles. A band is the same projection with the rows
above it cut off; its fragments are computed when it is drawn and again in its backward pass."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from .backend import cuda_backend
from .capacity import TooManyFragments
from .constants import TILE
from .project import Projection
from .trace import Fragments, masked_counts, trace

T = TypeVar("T")

PASSING = 1 << 18
"""Pixels of a temporary CPU list. Its memory is kept and reused; memory for a whole view would go back to the system
and be cleared for the next, which takes longer than finding the fragments."""


@dataclass(frozen=True)
class Bands:
    """Fragments of a view drawn in bands; recomputed per query."""

    projection: Projection  # of the whole view
    rows: tuple[tuple[int, int], ...]  # first and last pixel row (exclusive) of each band, top to bottom
    rim: float  # as in `trace`
    count: int  # number of fragments F

    def __len__(self) -> int:
        return self.count

    def lists(self) -> Iterator[Fragments]:
        """Yield the fragments band by band, without gradient."""
        for top, bottom in self.rows:
            with torch.no_grad():
                fragments = trace(band(self.projection, top, bottom), self.rim)
            yield fragments
            del fragments  # before the next list is made

    def overdraw(self) -> Tensor:
        """Count the blended surfels per pixel: [H, W, 1] int32."""
        return torch.cat([fragments.overdraw() for fragments in self.lists()])

    def masked_counts(self, mask: Tensor, n: int) -> Tensor:
        """Count fragments on masked pixels; see `trace.masked_counts`."""
        camera = self.projection.camera
        if mask.numel() != camera.width * camera.height:
            raise ValueError(f"the mask has {mask.numel()} pixels, the view {camera.width * camera.height}")
        rows = mask.reshape(camera.height, camera.width)
        counts = torch.zeros(n, dtype=torch.int32, device=mask.device)
        for (top, bottom), fragments in zip(self.rows, self.lists(), strict=True):
            counts += masked_counts(fragments, rows[top:bottom].reshape(-1), n)
        return counts


def fitting_lists(projection: Projection, most: int = 0, rim: float = 1e-3) -> Iterator[Fragments]:
    """Yield the fragments of a view for a single read: one list on a CUDA device, lists of some rows of tiles on the
    CPU; smaller ones if a list has too many fragments. `most`: largest number of fragments of a list, as in `trace`.
    Raises TooManyFragments: a single row of tiles has too many."""
    width, height = projection.camera.width, projection.camera.height
    parts = 1 if cuda_backend(projection.geom.device) else -(-width * height // PASSING)

    @torch.no_grad()  # on the generator, it would keep the yielded lists alive
    def find(top: int, bottom: int) -> Fragments:
        return trace(projection if bottom - top == height else band(projection, top, bottom), rim, most)

    for _, _, fragments in by_bands(split(0, height, parts), find):
        yield fragments
        del fragments  # before the next list is made


def by_bands(waiting: list[tuple[int, int]], draw: Callable[[int, int], T]) -> Iterator[tuple[int, int, T]]:
    """Draw bands from top to bottom, splitting those that raise `TooManyFragments`.

    Args:
        waiting: first and last pixel row (exclusive) of each band.
        draw: draws the rows of a band.

    Yields:
        first and last row of each band as drawn, and the result of `draw`.

    Raises:
        TooManyFragments: a single row of tiles has too many.
    """
    while waiting:
        (top, bottom), *rest = waiting
        try:
            drawn = draw(top, bottom)
        except TooManyFragments as error:
            parts = split_refused(top, bottom, error)
            if len(parts) == 1:
                raise
            waiting = parts + rest
            continue
        yield top, bottom, drawn
        del drawn  # may hold a list of fragments: free it before the next
        waiting = rest


def draw_in_bands(
    projection: Projection,
    draw: Callable[[Projection, int | None], tuple[Tensor, Fragments]],
    error: TooManyFragments,
    most: int = 0,
    rim: float = 1e-3,
) -> tuple[Tensor, Bands]:
    """Draw a view that has too many fragments for one list.

    Args:
        draw: draws a band, given its projection and the largest number of fragments, as in `trace`: image [pixels, C]
            and fragments. Called again in the backward pass.
        error: of the whole view.
        most, rim: as in `trace`.

    Returns:
        image [H * W, C], and the fragments.

    Raises:
        TooManyFragments: a single row of tiles has too many.
    """

    def draw_band(top: int, bottom: int) -> tuple[Tensor, int]:
        part, found = band(projection, top, bottom), []

        def draw_once(geom: Tensor) -> Tensor:
            # no limit in the backward pass: the band fitted in the forward pass
            image, fragments = draw(replace(part, geom=geom), None if found else most)
            found.append(len(fragments))
            return image

        image = checkpoint(draw_once, part.geom, use_reentrant=False, preserve_rng_state=False)
        return image, found[0]

    drawn = list(by_bands(split_refused(0, projection.camera.height, error), draw_band))
    seen = replace(projection, geom=projection.geom.detach(), frames=projection.frames.detach())
    rows = tuple((top, bottom) for top, bottom, _ in drawn)
    count = sum(length for _, _, (_, length) in drawn)
    return torch.cat([image for _, _, (image, _) in drawn]), Bands(seen, rows, rim, count)


def split_refused(top: int, bottom: int, error: TooManyFragments) -> list[tuple[int, int]]:
    """Split refused rows into bands by their number of fragments, at least two."""
    return split(top, bottom, max(2, -(-error.count // max(1, error.most))))


def band(projection: Projection, top: int, bottom: int) -> Projection:
    """Crop a projection to the pixel rows from `top`, a multiple of TILE, to `bottom` (exclusive).

    Its backward pass adds to `mean2d_grad` and `mean2d_absgrad` of `projection`.
    """
    shift = projection.geom.new_zeros(projection.geom.shape[1])
    shift[1] = top
    camera = projection.camera.rows(top, bottom)
    return replace(projection, geom=projection.geom - shift, camera=camera, whole=projection)


def split(top: int, bottom: int, parts: int) -> list[tuple[int, int]]:
    """Split pixel rows into at most `parts` bands of whole tiles, at least one row of tiles each."""
    tiles = -(-(bottom - top) // TILE)
    parts = min(parts, tiles)
    edges = [top + TILE * (tiles * i // parts) for i in range(parts)]
    return list(zip(edges, [*edges[1:], bottom], strict=True))
