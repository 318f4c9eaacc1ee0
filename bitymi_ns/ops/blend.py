"""Shading and compositing in one: the image of surfels with their view colours and a residual."""

import functools

import torch
from torch import Tensor

from .backend import check_shapes, cuda_backend, dense, kernel, module, on_same_device
from .constants import IMAGE_CHANNELS, MAP_CHANNELS
from .project import Projection
from .texel import TexelDescent, TexelTiles, gradient_or_step
from .trace import Fragments


@functools.lru_cache(maxsize=4)
def _no_tiles(surfels: int, dtype: torch.dtype, device: torch.device) -> TexelTiles:
    """Tiles of surfels without texels. Kept: a step on a card should not clear them again."""
    size = torch.zeros(surfels, 2, dtype=torch.int32, device=device)
    return TexelTiles.of_sizes(size, torch.zeros(surfels, dtype=dtype, device=device))


def backward_memory(fragments: Fragments, maps: bool, texels: int) -> dict[str, Tensor]:
    """Working memory of the backward kernel by name: none on the CPU.

    Args:
        texels: T of which gradients are added up. On CUDA a row of four numbers each; where torch is asked for
            deterministic algorithms, int64 sums in its place: a sum of integers does not depend on the order.
    """
    like = fragments.weight
    if not cuda_backend(like.device):
        return {}
    work = {"partial": like.new_empty(fragments.layout.handle.pairs, 8 if maps else 4)}  # of surfels, by pair
    if texels and torch.are_deterministic_algorithms_enabled():
        numbers = module(like.device).exact_size(4 * texels)
        work["exact_work"] = torch.empty(numbers, dtype=torch.int64, device=like.device)
    elif texels:
        work["texel_work"] = like.new_empty(4 * texels)
    return work


class _BlendedImage(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weight, depth, uv, geom, base, texels, residual, fragments, tiles, bound, maps, descent):
        g, b, t, arrays = dense(geom, geom), dense(base, geom), dense(texels, geom), fragments.arrays
        r = None if residual is None else dense(residual, geom)
        image = geom.new_empty(fragments.width * fragments.height, MAP_CHANNELS if maps else IMAGE_CHANNELS)
        ctx.arguments = {"maps": maps, **fragments.view, **tiles.arrays, "bound": bound}
        kernel("blend_forward", geom)(**ctx.arguments, **arrays, geom=g, base=b, texels=t, residual=r, image=image)
        ctx.save_for_backward(g, b, t, r, *arrays.values())
        ctx.descent, ctx.names, ctx.fragments = descent, tuple(arrays), fragments
        return image

    @staticmethod
    def backward(ctx, dimage):
        geom, base, texels, residual, *rest = ctx.saved_tensors
        arrays = dict(zip(ctx.names, rest, strict=True))
        weighs, _, moves, _, _, learns, residual_learns, *_ = ctx.needs_input_grad
        out = {"dweight": torch.empty_like(arrays["weight"]) if weighs else None, "dgeom": torch.empty_like(geom)}
        out |= {"dbase": torch.empty_like(base)}
        out |= {"duv": torch.empty_like(arrays["uv"]) if moves else None}
        out |= {"dresidual": torch.empty_like(residual) if residual_learns else None}
        out |= {"ddepth": torch.empty_like(arrays["depth"]) if ctx.arguments["maps"] else None}
        dtexels, step = gradient_or_step(texels, learns, ctx.descent)
        inputs = {"geom": geom, "base": base, "texels": texels, "residual": residual, "dimage": dense(dimage, geom)}
        work = backward_memory(ctx.fragments, ctx.arguments["maps"], len(texels) if "moved" in step else 0)
        kernel("blend_backward", geom)(**ctx.arguments, **arrays, **inputs, **step, **work, **out)
        gradients = (out[name] for name in ("dweight", "ddepth", "duv", "dgeom", "dbase"))
        return *gradients, dtexels, out["dresidual"], None, None, None, None, None


def checked_texels(
    like: Tensor,
    surfels: int,
    base: Tensor,
    texels: Tensor | None,
    tiles: TexelTiles | None,
    move_surfels: bool,
    descent: TexelDescent | None,
) -> tuple[Tensor, TexelTiles, bool, TexelDescent | None]:
    """Return texels [T, 3], tiles, move_surfels and descent of `blended_image`, filled in where there are none.

    Args:
        like: of the device that all have to lie on.
        surfels: N.
        base: [N, 3] view colours.
        texels, tiles, move_surfels, descent: as in `blended_image`.

    Raises:
        ValueError: as of `blended_image`.
    """
    if texels is None or tiles is None:
        tiles = _no_tiles(surfels, base.dtype, base.device)
        texels, move_surfels, descent = base.new_zeros(0, 3), False, None
    named = {} if descent is None else descent.arguments(texels)
    named.pop("rate", None)
    on_same_device(like, base=base, texels=texels, **tiles.arrays, **named)
    if tiles.count != texels.shape[0] or texels.shape[1:] != (3,):
        raise ValueError(f"the tiles hold {tiles.count} texels, texels has the shape {list(texels.shape)}")
    check_shapes(base=(base, (len(tiles.first), 3)))
    if surfels != len(base):
        raise ValueError(f"the fragments are those of {surfels} surfels, not of {len(base)}")
    if descent is not None and (texels.requires_grad or not texels.is_contiguous()):
        raise ValueError("texels that the backward pass moves are dense and ask for no gradient")
    return texels, tiles, move_surfels, descent


def blended_image(
    fragments: Fragments,
    projection: Projection,
    base: Tensor,
    texels: Tensor | None = None,
    tiles: TexelTiles | None = None,
    bound: float = 0.0,
    maps: bool = False,
    move_surfels: bool = True,
    descent: TexelDescent | None = None,
    residual: Tensor | None = None,
) -> Tensor:
    """Shade and composite: sums of w times colour, 1 and beta, and with maps also depth and normal, per pixel.

    A fragment's colour is ReLU(ReLU(f_view(d) + 0.5) + r), eq. (color), with the residual r of texels at (u, v),
    bilinear between the four nearest texel centres, constant beyond the outer ones; or a residual of each fragment, as
    `fragment_residual` has it of a field; or none. Differentiable in the fragments' weights, depths and coordinates,
    `projection.geom`, `base`, `texels` and `residual`. Along u and v the slope is that of the bilinear fetch, and 0
    beyond the outer texel centres.

    It is one pass over the fragments, and one backward, which list neither colours nor their gradients: of 64 bytes per
    fragment 40 are left on a card, 32 on the CPU. On the CPU the sums of the backward pass depend neither on the number
    of threads nor on what learns: each surfel's are added by one thread. On a card only the gradients of texels depend
    on the order of sums, and not even they after torch.use_deterministic_algorithms(True).

    Args:
        fragments: F fragments of an H x W view.
        projection: the view's, of N surfels.
        base: [N, 3] f_view of every surfel.
        texels: [T, 3] residual colours, of the fragments' dtype; None = none.
        bound: fragments of weight below this, and those of surfels without a tile, keep ReLU(f_view + 0.5).
        maps: add depth and normal.
        move_surfels: the gradient of r with respect to u and v reaches the fragments.
        descent: the backward pass moves the texels that the view shows, in place, and keeps no gradient of them. So a
            whole atlas need not be cleared and read for every view.
        residual: [F, 3] residual colour of each fragment, in place of texels.

    Returns:
        [H * W, 5] rgb, alpha, sum w beta; with maps [H * W, 9]: also sum w z (camera z) and sum w n (unit normals in
        the camera frame, OpenCV axes, facing the camera). Nothing is divided by alpha; the background is not included.

    Raises:
        ValueError: the tiles are not those of these texels or surfels, or the fragments those of others; or texels
            that ask for a gradient are to be moved; or there are texels and a residual; or tensors lie on several
            devices.
    """
    on_same_device(fragments.weight, geom=projection.geom)
    if len(projection.geom) != fragments.surfels:
        raise ValueError(f"the fragments are those of {fragments.surfels} surfels, not of {len(projection.geom)}")
    if residual is not None:
        on_same_device(fragments.weight, residual=residual)
        check_shapes(residual=(residual, (len(fragments), 3)))
        if texels is not None:
            raise ValueError("the residual is that of texels or of fragments, not both")
    texels, tiles, move_surfels, descent = checked_texels(
        fragments.weight, fragments.surfels, base, texels, tiles, move_surfels, descent
    )
    uv = fragments.uv if move_surfels else fragments.uv.detach()
    if descent is not None and not base.requires_grad:
        base = base.detach().requires_grad_()  # so that there is a backward pass, whatever else learns
    rest = (projection.geom, base, texels, residual, fragments, tiles, bound, maps, descent)
    return _BlendedImage.apply(fragments.weight, fragments.depth, uv, *rest)


def soft_overdraw(fragments: Fragments, half: float) -> Tensor:
    """A count of a pixel's fragments with a gradient: sum of w / (w + half), [H * W].

    Args:
        fragments: of an H x W view.
        half: the weight that counts one half, above 0. A fragment far heavier counts 1, one far lighter w / half.

    Raises:
        ValueError: half is not above 0.
    """
    if not half > 0.0:
        raise ValueError(f"the weight that counts one half must be above 0, not {half}")
    count = fragments.weight / (fragments.weight + half)
    return count.new_zeros(fragments.width * fragments.height).index_add(0, fragments.pixel, count)


def composite(fragments: Fragments, values: Tensor) -> Tensor:
    """Sums of w times any values [F, C] per pixel: [H * W, C]."""
    if values.dim() != 2 or len(values) != len(fragments):
        raise ValueError(f"values must have a row for each of the {len(fragments)} fragments, not {list(values.shape)}")
    on_same_device(fragments.weight, values=values)
    out = values.new_zeros(fragments.width * fragments.height, values.shape[1])
    return out.index_add(0, fragments.pixel, fragments.weight[:, None] * values)
