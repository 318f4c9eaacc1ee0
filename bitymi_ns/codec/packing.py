"""Shelf-First-Fit-Decreasing packing of texture tiles into pages."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

GRID = 4  # of tiles: no BC7 block is shared by two surfels
ROWS = 64  # page heights of larger atlases are multiples of this


@dataclass(frozen=True)
class Packing:
    """Layout of the tiles in pages."""

    tiles: npt.NDArray[np.int32]  # [N, 5]: x, y, layer, r_u, r_v in texels, u along x; zeros without a tile
    # width, height: of every page, texels
    width: int
    height: int
    layers: int  # pages
    occupancy: float  # share of the pages' texels that belong to a tile

    @property
    def texels(self) -> int:
        return int(self.tiles[:, 3:].astype(np.int64).prod(axis=1).sum())

    @property
    def of_tiles(self) -> npt.NDArray[np.bool_]:
        """[T] whether a texel of the list (`pages.py`) belongs to a tile."""
        sides = self.tiles[:, 3:].astype(np.int64)
        return np.repeat(sides[:, 0] > 0, sides.clip(min=1).prod(axis=1))


def pack(resolution: npt.ArrayLike, page_width: int = 4096, max_rows: int = 8192, max_layers: int = 2048) -> Packing:
    """Pack tiles by Shelf-First-Fit-Decreasing (paper, section Texture Baking).

    Tiles are sorted by r_v descending, then r_u descending, then index; each goes to the first shelf with room, or
    opens a new shelf of its own height. Sides are powers of two, so page boundaries never cut a shelf. `resolution`:
    [N, 2] integers (r_u, r_v), powers of two >= 4; (0, 0) without a tile. `page_width`: a power of two; smaller atlases
    get narrower pages. `max_rows`: WebGPU and phones take 8192. Raises ValueError: sizes are not powers of two or too
    wide, or more than `max_layers` pages are needed."""
    sizes = np.asarray(resolution, dtype=np.int64).reshape(-1, 2)
    _check_sizes(sizes, page_width, max_rows)
    tiles = np.zeros((len(sizes), 5), dtype=np.int32)
    area = int(sizes.prod(axis=1).sum())
    if area == 0:
        return Packing(tiles, GRID, GRID, 1, 0.0)
    tallest = int(sizes[:, 1].max())
    width = max(GRID, int(sizes[:, 0].max()))
    while width < page_width and width * width < area:  # a square of this side is too small
        width *= 2

    placed = np.flatnonzero(sizes[:, 0])
    order = placed[np.lexsort((placed, -sizes[placed, 0], -sizes[placed, 1]))]
    ordered = sizes[order]
    starts = np.flatnonzero(np.r_[True, np.any(ordered[1:] != ordered[:-1], axis=1)])
    origins = np.zeros((len(order), 2), dtype=np.int64)
    shelves: list[list[int]] = []  # (y, taken width) of the shelves with room left, first opened first
    rows = 0
    for start, stop in zip(starts, np.r_[starts[1:], len(order)], strict=True):
        r_u, r_v = (int(r) for r in ordered[start])
        for shelf in shelves:
            y, used = shelf
            count = min(stop - start, (width - used) // r_u)
            origins[start : start + count, 0] = used + r_u * np.arange(count)
            origins[start : start + count, 1] = y
            shelf[1] += int(count) * r_u
            start += count
        if start < stop:
            index = np.arange(stop - start)
            per_shelf = width // r_u
            origins[start:stop, 0] = index % per_shelf * r_u
            origins[start:stop, 1] = rows + index // per_shelf * r_v
            opened = -(-len(index) // per_shelf)
            rows += opened * r_v
            shelves.append([rows - r_v, (len(index) - (opened - 1) * per_shelf) * r_u])
        shelves = [shelf for shelf in shelves if shelf[1] < width]

    layers = -(-rows // max_rows)
    if layers > max_layers:
        needed = f"the atlas needs {layers} pages of {width} x {max_rows} texels, more than {max_layers}"
        raise ValueError(f"{needed}: lower r_max, cap tiles by the training views, or widen the pages")
    step = max(ROWS, tallest) if rows >= ROWS else GRID
    height = -(-rows // layers // step) * step
    tiles[order, 0] = origins[:, 0]
    tiles[order, 1] = origins[:, 1] % height
    tiles[order, 2] = origins[:, 1] // height
    tiles[:, 3:] = sizes
    return Packing(tiles, width, height, -(-rows // height), area / (width * height * -(-rows // height)))


def check_page(page_width: int, max_rows: int) -> None:
    """Raise ValueError if a page's width or height is not allowed."""
    if page_width < GRID or page_width & (page_width - 1):
        raise ValueError(f"the page width must be a power of two of at least {GRID}, not {page_width}")
    if max_rows < ROWS or max_rows % ROWS:
        raise ValueError(f"the page height must be a multiple of {ROWS}, not {max_rows}")


def _check_sizes(sizes: npt.NDArray[np.int64], page_width: int, max_rows: int) -> None:
    check_page(page_width, max_rows)
    tiled = sizes.any(axis=1)
    bad = tiled & ((sizes < GRID) | (sizes & (sizes - 1) != 0)).any(axis=1)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise ValueError(f"tile {row} is {sizes[row].tolist()} texels; sides must be powers of two of at least {GRID}")
    if tiled.any() and int(sizes[:, 0].max()) > page_width:
        raise ValueError(f"a tile is {int(sizes[:, 0].max())} texels wide, more than the page width {page_width}")
    if tiled.any() and max_rows % int(sizes[:, 1].max()):
        raise ValueError(f"tiles of {int(sizes[:, 1].max())} rows do not divide pages of {max_rows} rows")
