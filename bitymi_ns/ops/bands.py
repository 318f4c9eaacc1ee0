"""Views whose fragments are in no list. Those whose fragments exceed memory are drawn in bands of rows of tiles: a band
is the same projection with the rows above it cut off; its fragments are found when it is drawn and again in its
backward pass."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from .backend import cuda_backend
from .capacity import TooManyFragments
from .constants import TILE
from .fragment_list import Layout
from .project import Projection
from .trace import Fragments, check_mask, count_masked, trace

T = TypeVar("T")

PASSING = 1 << 18
"""Pixels of a temporary CPU list. Its memory is kept and reused; memory for a whole view would go back to the system
and be cleared for the next, which takes longer than finding the fragments."""


@dataclass(frozen=True)
class Unlisted:
    """Fragments of a view that are in no list: too many for one, or drawn without; found again per query, without
    gradient."""

    projection: Projection
    rim: float  # as in `trace`
    most: int = 0  # largest number of fragments of a list, likewise
    count: int | None = None  # number of fragments, where it is known
    layout: Layout | None = None  # pairs and masks of a view drawn without a list, which suffice for counts by surfel

    def __len__(self) -> int:
        if self.count is not None:
            return self.count
        camera = self.projection.camera
        every = torch.ones(camera.width * camera.height, dtype=torch.bool, device=self.projection.geom.device)
        return int(self.masked_counts(every).sum())

    def lists(self) -> Iterator[Fragments]:
        """Yield lists of the fragments from top to bottom."""
        return fitting_lists(self.projection, self.most, self.rim)

    def overdraw(self) -> Tensor:
        """Count the blended surfels per pixel: [H, W, 1] int32."""
        return torch.cat([fragments.overdraw() for fragments in self.lists()])

    def masked_counts(self, mask: Tensor) -> Tensor:
        """Count the fragments of each surfel on masked pixels; see `Fragments.masked_counts`."""
        camera, n = self.projection.camera, len(self.projection.geom)
        check_mask(mask, self.projection.geom, camera.width, camera.height)
        if self.layout is not None:
            view = {"layout": self.layout.handle, "width": camera.width, "height": camera.height}
            return count_masked(view, mask, n)
        counts = torch.zeros(n, dtype=torch.int32, device=mask.device)
        rows, top = mask.view(camera.height, -1), 0
        for fragments in self.lists():
            counts += fragments.masked_counts(rows[top : top + fragments.height].reshape(-1))
            top += fragments.height
            del fragments  # before the next list is made
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


def draw_by_lists(
    projection: Projection,
    draw: Callable[[Projection, int | None], tuple[Tensor, Fragments]],
    most: int = 0,
    rim: float = 1e-3,
) -> tuple[Tensor, Fragments | Unlisted]:
    """Draw a view by a list of its fragments, or in bands if they are too many for one.

    Args:
        draw: draws the view or a band, given its projection and the largest number of fragments, as in `trace`: image
            [pixels, C] and fragments. Called again in the backward pass of a band.
        most, rim: as in `trace`.

    Returns:
        image [H * W, C], and the fragments.

    Raises:
        TooManyFragments: a single row of tiles has too many.
    """
    try:
        return draw(projection, most)
    except TooManyFragments as error:
        bands = split_refused(0, projection.camera.height, error)
    counts: list[int] = []  # fragments of each band

    def draw_band(top: int, bottom: int) -> Tensor:
        part, limits = band(projection, top, bottom), [most]

        def draw_once(geom: Tensor) -> Tensor:
            # no limit in the backward pass: the band fitted in the forward pass
            forward = bool(limits)
            image, fragments = draw(replace(part, geom=geom), limits.pop() if forward else None)
            if forward:
                counts.append(len(fragments))
            return image

        return checkpoint(draw_once, part.geom, use_reentrant=False, preserve_rng_state=False)

    image = torch.cat([drawn for _, _, drawn in by_bands(bands, draw_band)])
    return image, Unlisted(projection.detached(), rim, most, sum(counts))


def split_refused(top: int, bottom: int, error: TooManyFragments) -> list[tuple[int, int]]:
    """Split refused rows into bands by their number of fragments, at least two."""
    return split(top, bottom, max(2, -(-error.count // max(1, error.most))))


def band(projection: Projection, top: int, bottom: int) -> Projection:
    """Crop a projection to the pixel rows from `top`, a multiple of TILE, to `bottom` (exclusive).

    Its backward pass adds to `mean2d_grad` and `mean2d_absgrad` of `projection`.
    """
    shift = projection.geom.new_zeros(projection.geom.shape[1])
    shift[1] = top
    camera = projection.camera.part(0, top, projection.camera.width, bottom)
    return replace(projection, geom=projection.geom - shift, camera=camera, whole=projection)


def split(top: int, bottom: int, parts: int) -> list[tuple[int, int]]:
    """Split pixel rows into at most `parts` bands of whole tiles, at least one row of tiles each."""
    tiles = -(-(bottom - top) // TILE)
    parts = min(parts, tiles)
    edges = [top + TILE * (tiles * i // parts) for i in range(parts)]
    return list(zip(edges, [*edges[1:], bottom], strict=True))
