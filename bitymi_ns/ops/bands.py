"""Views with more fragments than memory, drawn a few rows of tiles at a time. A band is the same projection with the
image's rows above it cut off; its fragments are made when it is drawn, and once more in its backward pass."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from .backend import cuda_backend
from .constants import TILE
from .fragment_list import TooManyFragments
from .project import Projection
from .trace import Fragments, masked_counts, trace

T = TypeVar("T")

PASSING = 1 << 18
"""Pixels of a list of the CPU that is read and dropped. Its memory then stays with the program; that of a whole
view the system takes back and clears for the next, which takes longer than finding the fragments."""


@dataclass(frozen=True)
class Bands:
    """The fragments of a view that was drawn in bands: found again for every question."""

    projection: Projection  # of the whole view
    rows: tuple[tuple[int, int], ...]  # first and last pixel row (exclusive) of every band, from top to bottom
    rim: float  # as in `trace`
    count: int  # number of fragments F

    def __len__(self) -> int:
        return self.count

    def lists(self) -> Iterator[Fragments]:
        """The fragments of one band after the other, without gradient."""
        for top, bottom in self.rows:
            with torch.no_grad():
                fragments = trace(band(self.projection, top, bottom), self.rim)
            yield fragments
            del fragments  # before the next list is made

    def overdraw(self) -> Tensor:
        """[H, W, 1] int32: blended surfels per pixel."""
        return torch.cat([fragments.overdraw() for fragments in self.lists()])

    def masked_counts(self, mask: Tensor, n: int) -> Tensor:
        """As `masked_counts` of a list."""
        camera = self.projection.camera
        if mask.numel() != camera.width * camera.height:
            raise ValueError(f"the mask has {mask.numel()} pixels, the view {camera.width * camera.height}")
        rows = mask.reshape(camera.height, camera.width)
        counts = torch.zeros(n, dtype=torch.int32, device=mask.device)
        for (top, bottom), fragments in zip(self.rows, self.lists(), strict=True):
            counts += masked_counts(fragments, rows[top:bottom].reshape(-1), n)
        return counts


def fitting_lists(projection: Projection, most: int = 0, rim: float = 1e-3) -> Iterator[Fragments]:
    """The fragments of a view, to be read and dropped: as one list on a CUDA device, on the CPU as lists of some
    rows of tiles each; smaller ones where one has too many.

    Args:
        most: fragments of a list, as in `trace`.

    Raises:
        TooManyFragments: a single row of tiles has too many.
    """
    width, height = projection.camera.width, projection.camera.height
    parts = 1 if cuda_backend(projection.geom.device) else -(-width * height // PASSING)

    @torch.no_grad()  # of the generator, it would hold on to what it has yielded
    def find(top: int, bottom: int) -> Fragments:
        return trace(projection if bottom - top == height else band(projection, top, bottom), rim, most)

    for _, _, fragments in by_bands(split(0, height, parts), find):
        yield fragments
        del fragments  # before the next list is made


def by_bands(waiting: list[tuple[int, int]], draw: Callable[[int, int], T]) -> Iterator[tuple[int, int, T]]:
    """Draw bands from top to bottom, in smaller ones where that raises `TooManyFragments`.

    Args:
        waiting: first and last pixel row (exclusive) of every band.
        draw: what is done with the rows of a band.

    Yields:
        first and last row of every band as it was drawn, and what `draw` gave.

    Raises:
        TooManyFragments: a single row of tiles has too many.
    """
    while waiting:
        (top, bottom), *rest = waiting
        try:
            drawn = draw(top, bottom)
        except TooManyFragments as error:
            parts = refused(top, bottom, error)
            if len(parts) == 1:
                raise
            waiting = parts + rest
            continue
        yield top, bottom, drawn
        del drawn  # a list of fragments, say: before the next one is made
        waiting = rest


def refused(top: int, bottom: int, error: TooManyFragments) -> list[tuple[int, int]]:
    """Bands of rows that were refused as one: as many as their number of fragments asks for, two at least."""
    return split(top, bottom, max(2, -(-error.count // max(1, error.most))))


def band(projection: Projection, top: int, bottom: int) -> Projection:
    """The pixel rows from `top`, a multiple of TILE, to `bottom` (exclusive) of a view, as a view of their own.

    Its backward pass adds to `mean2d_grad` and `mean2d_absgrad` of `projection`.
    """
    shift = projection.geom.new_zeros(projection.geom.shape[1])
    shift[1] = top
    camera = projection.camera.rows(top, bottom)
    return replace(projection, geom=projection.geom - shift, camera=camera, whole=projection)


def split(top: int, bottom: int, parts: int) -> list[tuple[int, int]]:
    """Pixel rows cut into at most `parts` bands of whole tiles; a single row of tiles stays as it is."""
    tiles = -(-(bottom - top) // TILE)
    parts = min(parts, tiles)
    edges = [top + TILE * (tiles * i // parts) for i in range(parts)]
    return list(zip(edges, [*edges[1:], bottom], strict=True))
