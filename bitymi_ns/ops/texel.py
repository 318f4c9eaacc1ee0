"""Colours from texels: what the baked renderer shows, differentiable, of a view whose fragments are known or learn."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .backend import cuda_backend, dense, kernel, module, on_same_device, require
from .trace import Fragments


def _on_the_cpu(operation: str, like: Tensor) -> None:
    require(operation, "cpu", like.device, "move them to the CPU")


@dataclass(frozen=True)
class TexelTiles:
    """Where the tiles of the surfels lie in one list of texels, [T, 3].

    Texel (i, j) of surfel s, i along u and j along v, is row first[s] + j r_u + i; its centre lies at
    u = (i + 0.5) / r_u * 2e - e, v likewise. A tile of 1 x 1 texel is a constant.

    Attributes:
        first: [N] int64.
        size: [N, 2] int32 (r_u, r_v); (0, 0) = no tile.
        extent: [N] half side e of the tile in scale units, of the texels' dtype.
    """

    first: Tensor
    size: Tensor
    extent: Tensor

    @classmethod
    def of_sizes(cls, size: Tensor, extent: Tensor) -> TexelTiles:
        """Tiles of the sizes [N, 2] and extents [N], one after the other."""
        area = size.long().prod(dim=1)
        return cls(area.cumsum(0) - area, size.to(torch.int32).contiguous(), extent.contiguous())

    def rows_of(self, surfels: Tensor) -> Tensor:
        """[t] int64 rows of the texels of some surfels [n] int64, tile after tile in their order."""
        area = self.size[surfels].long().prod(dim=1)
        shift = self.first[surfels] - (area.cumsum(0) - area)
        return shift.repeat_interleave(area) + torch.arange(int(area.sum()), device=area.device)

    @property
    def arrays(self) -> dict[str, Tensor]:
        """What the kernels take of each tile."""
        return {"first": self.first, "size": self.size, "extent": self.extent}

    @functools.cached_property
    def count(self) -> int:
        """T: texels of all tiles. Read back once: a step must not wait for the device to tell."""
        return int(self.size.long().prod(dim=1).sum())


@dataclass(frozen=True)
class TexelDescent:
    """How a backward pass moves texels: texel t by -rate share[t] times its gradient.

    Attributes:
        share: [T] of the texels' dtype.
        rate: of all texels.
        moved: [T, 3] the texels that are moved; None = those that are read.
    """

    share: Tensor
    rate: float
    moved: Tensor | None = None

    def arguments(self, read: Tensor) -> dict[str, Any]:
        """The kernels' keywords, for a backward pass that reads the texels `read`."""
        return {"moved": read if self.moved is None else self.moved, "share": self.share, "rate": self.rate}


@dataclass(frozen=True)
class TexelFragments:
    """What the colours of a view depend on while its geometry is fixed. Nothing here has a gradient.

    Attributes:
        weight: [F] blending weight.
        uv: [2, F] surfel coordinates in scale units.
        surfel, pixel: [F] int32, row of the surfel and y * width + x.
        tile_start: [tiles + 1] int64, where the fragments of each screen tile begin.
        run_start: [R + 1] int64; fragments run_start[r] to run_start[r + 1] - 1 are of one surfel.
        order: [R] int64, the runs sorted by surfel. The backward pass gives whole surfels to each thread, so that no
            two threads add to one texel, and sums do not depend on the number of threads.
        width, height: of the image, pixels.
    """

    weight: Tensor
    uv: Tensor
    surfel: Tensor
    pixel: Tensor
    tile_start: Tensor
    run_start: Tensor
    order: Tensor
    width: int
    height: int

    @classmethod
    def of(cls, fragments: Fragments, keep: Tensor | None = None) -> TexelFragments:
        """The fragments of a view on the CPU, or those of them that `keep` [F] bool names."""
        return cls.of_lists([(fragments, keep)])

    @classmethod
    def of_lists(cls, lists: Iterable[tuple[Fragments, Tensor | None]]) -> TexelFragments:
        """The same of a view whose fragments come in several lists, from top to bottom."""
        parts: list[tuple[Tensor, ...]] = []
        starts, count, height, width = [torch.zeros(1, dtype=torch.int64)], 0, 0, 0
        for fragments, keep in lists:
            _on_the_cpu("TexelFragments.of", fragments.weight)
            weight, uv = fragments.weight.detach(), fragments.uv.detach()
            surfel, pixel, tile_start = fragments.surfel, fragments.pixel, fragments.tile_start
            width = fragments.width
            if keep is not None:
                rows = torch.nonzero(keep).squeeze(1)
                weight, uv, surfel, pixel = weight[rows], uv[:, rows].contiguous(), surfel[rows], pixel[rows]
                tile_start = torch.searchsorted(rows, tile_start)
            parts.append((weight, uv, surfel, pixel + height * width if height else pixel))
            starts.append(tile_start[1:] + count)
            count, height = count + len(surfel), height + fragments.height
            del fragments, keep  # before the next list is made
        weight, uv, surfel, pixel = (
            column[0] if len(column) == 1 else torch.cat(column, dim=-1) for column in zip(*parts, strict=True)
        )
        new = torch.ones(len(surfel) + 1, dtype=torch.bool)
        new[1:-1] = surfel[1:] != surfel[:-1]
        run_start = torch.nonzero(new).squeeze(1) if len(surfel) else torch.zeros(1, dtype=torch.int64)
        order = torch.argsort(surfel[run_start[:-1]], stable=True)
        return cls(weight, uv, surfel, pixel, torch.cat(starts), run_start, order, width, height)

    def __len__(self) -> int:
        return self.weight.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        arrays = (self.weight, self.uv, self.surfel, self.pixel, self.tile_start, self.run_start, self.order)
        return sum(array.numel() * array.element_size() for array in arrays)

    @property
    def arrays(self) -> dict[str, Tensor]:
        """What the kernels take of each fragment."""
        return {"surfel": self.surfel, "pixel": self.pixel, "weight": self.weight, "uv": self.uv}


def _check(base: Tensor, texels: Tensor, tiles: TexelTiles) -> None:
    if tiles.count != texels.shape[0] or texels.shape[1:] != (3,):
        raise ValueError(f"the tiles hold {tiles.count} texels, texels has the shape {list(texels.shape)}")
    if tuple(base.shape) != (len(tiles.first), 3):
        raise ValueError(f"base must have shape {[len(tiles.first), 3]}, not {list(base.shape)}")


def check_texels(
    fragments: Fragments, base: Tensor, texels: Tensor, tiles: TexelTiles, descent: TexelDescent | None
) -> None:
    """Refuses what does not belong together; see `texel_colors`.

    Raises:
        ValueError: says what it is.
    """
    named = {} if descent is None else descent.arguments(texels)
    named.pop("rate", None)
    on_same_device(fragments.weight, base=base, texels=texels, **tiles.arrays, **named)
    _check(base, texels, tiles)
    if fragments.surfels != len(base):
        raise ValueError(f"the fragments are those of {fragments.surfels} surfels, not of {len(base)}")
    if descent is not None and (texels.requires_grad or not texels.is_contiguous()):
        raise ValueError("texels that the backward pass moves are dense and ask for no gradient")


class _TexelImage(torch.autograd.Function):
    @staticmethod
    def forward(ctx, base, texels, fragments, tiles, bound):
        b, t, f = dense(base, texels), dense(texels, texels), fragments
        image = t.new_empty(f.width * f.height, 3)
        kernel("texel_image_forward", t)(
            **f.arrays, **tiles.arrays, tile_start=f.tile_start, bound=bound, base=b, texels=t, image=image
        )
        ctx.save_for_backward(b, t)
        ctx.fragments, ctx.tiles, ctx.bound = fragments, tiles, bound
        return image

    @staticmethod
    def backward(ctx, dimage):
        b, t = ctx.saved_tensors
        dbase = torch.empty_like(b) if ctx.needs_input_grad[0] else None
        dtexels = torch.zeros_like(t) if ctx.needs_input_grad[1] else None
        add_texel_gradient(dimage, ctx.fragments, b, t, ctx.tiles, ctx.bound, dtexels, dbase)
        return dbase, dtexels, None, None, None


def texel_image(
    fragments: TexelFragments, base: Tensor, texels: Tensor, tiles: TexelTiles, bound: float = 0.0
) -> Tensor:
    """Sum over a pixel's fragments of w ReLU(ReLU(f_view(d) + 0.5) + r(u, v)), eq. (color) with the texels' residual r:
    bilinear between the four nearest texel centres, constant beyond the outer ones.

    Differentiable in `base` and `texels`.

    Args:
        fragments: of an H x W view; weights and coordinates have the texels' dtype.
        base: [N, 3] f_view of every surfel.
        texels: [T, 3] residual colours.
        tiles: where they lie.
        bound: fragments of weight below this, and those of surfels without a tile, keep ReLU(f_view + 0.5).

    Returns:
        [H * W, 3]; the background is not included.

    Raises:
        ValueError: the tiles are not those of these texels or surfels.
        RuntimeError: the tensors are not on the CPU.
    """
    _on_the_cpu("texel_image", texels)
    _check(base, texels, tiles)
    return _TexelImage.apply(base, texels, fragments, tiles, bound)


def add_texel_gradient(
    dimage: Tensor,
    fragments: TexelFragments,
    base: Tensor,
    texels: Tensor,
    tiles: TexelTiles,
    bound: float,
    dtexels: Tensor | None,
    dbase: Tensor | None = None,
) -> None:
    """The backward pass of `texel_image` for callers that sum over views: autograd would clear and add a whole atlas
    for each.

    Args:
        dimage: [H * W, 3] gradient of the image.
        fragments, base, texels, tiles, bound: as in `texel_image`.
        dtexels: [T, 3], added to; None = not wanted.
        dbase: [N, 3], written; None = not wanted.

    Raises:
        RuntimeError: the tensors are not on the CPU.
    """
    _on_the_cpu("add_texel_gradient", texels)
    runs = {"run_start": fragments.run_start, "order": fragments.order}
    inputs = {"bound": bound, "base": base, "texels": texels, "dimage": dense(dimage, texels)}
    kernel("texel_image_backward", texels)(
        **fragments.arrays, **tiles.arrays, **runs, **inputs, dtexels=dtexels, dbase=dbase
    )


def backward_memory(texels: Tensor, surfels: int, sums_texels: bool) -> dict[str, Tensor]:
    """Working memory of the backward kernel of `texel_colors`, by name: none on the CPU.

    On CUDA: a row of four numbers per texel, where their gradients are added up; where torch is asked for deterministic
    algorithms, int64 sums in its place, as in `field.backward_memory`.
    """
    if not cuda_backend(texels.device):
        return {}
    entries = 4 * len(texels) if sums_texels else 0
    if not torch.are_deterministic_algorithms_enabled():
        return {"texel_work": texels.new_empty(entries)} if entries else {}
    numbers = module(texels.device).exact_size(entries, surfels, False)
    return {"exact_work": torch.empty(numbers, dtype=torch.int64, device=texels.device)}


class _TexelColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx, base, texels, uv, fragments, tiles, bound, descent):
        b, t, arrays = dense(base, texels), dense(texels, texels), fragments.arrays
        colors = t.new_empty(len(fragments), 3)
        inputs = {"bound": bound, "base": b, "texels": t, **tiles.arrays}
        kernel("texel_colors_forward", t)(**arrays, **inputs, colors=colors)
        ctx.save_for_backward(b, t, colors, *arrays.values())
        ctx.tiles, ctx.bound, ctx.descent, ctx.names = tiles, bound, descent, tuple(arrays)
        return colors

    @staticmethod
    def backward(ctx, dcolors):
        base, texels, colors, *rest = ctx.saved_tensors
        arrays = dict(zip(ctx.names, rest, strict=True))
        wanted = (base, texels, arrays["uv"])
        dbase, dtexels, duv = (
            torch.empty_like(x) if needed else None for x, needed in zip(wanted, ctx.needs_input_grad, strict=False)
        )
        inputs = {"bound": ctx.bound, "base": base, "texels": texels, **ctx.tiles.arrays}
        given = {"colors": colors, "dcolors": dense(dcolors, texels), "rate": 0.0}
        if ctx.descent is not None:
            given |= ctx.descent.arguments(texels)
        given |= backward_memory(texels, len(base), dtexels is not None or ctx.descent is not None)
        kernel("texel_colors_backward", texels)(**arrays, **inputs, **given, dbase=dbase, dtexels=dtexels, duv=duv)
        return dbase, dtexels, duv, None, None, None, None


def texel_colors(
    fragments: Fragments,
    base: Tensor,
    texels: Tensor,
    tiles: TexelTiles,
    bound: float = 0.0,
    move_surfels: bool = True,
    descent: TexelDescent | None = None,
) -> Tensor:
    """Colour of every fragment, ReLU(ReLU(f_view(d) + 0.5) + r(u, v)), with the texels' residual r of `texel_image`.

    Differentiable in `base`, `texels` and the fragments' coordinates. Along u and v the slope is that of the bilinear
    fetch, and 0 beyond the outer texel centres. Sums do not depend on the number of threads of the CPU; those of a card
    are the same from call to call after torch.use_deterministic_algorithms(True).

    Args:
        fragments: F fragments, of N surfels.
        base: [N, 3] f_view of every surfel.
        texels: [T, 3] residual colours, of the fragments' dtype.
        tiles: where they lie.
        bound: fragments of weight below this, and those of surfels without a tile, keep ReLU(f_view + 0.5).
        move_surfels: the gradient of r with respect to u and v reaches the fragments.
        descent: the backward pass moves the texels that the view shows, in place, and keeps no gradient of them. So a
            whole atlas need not be cleared and read for every view.

    Returns:
        [F, 3].

    Raises:
        ValueError: the tiles are not those of these texels or surfels, or the fragments those of others; or texels
            that ask for a gradient are to be moved; or tensors lie on several devices.
    """
    check_texels(fragments, base, texels, tiles, descent)
    uv = fragments.uv if move_surfels else fragments.uv.detach()
    return _TexelColors.apply(base, texels, uv, fragments, tiles, bound, descent)
