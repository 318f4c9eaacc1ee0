"""Shading and compositing in one pass, from surfels with view colours and residuals."""

import functools

import torch
from torch import Tensor

from .backend import check_shapes, cuda_backend, dense, kernel, module, on_same_device
from .constants import IMAGE_CHANNELS, MAP_CHANNELS
from .project import Projection
from .texel import TexelAlpha, TexelDescent, TexelTiles, gradient_or_step
from .trace import Fragments


@functools.lru_cache(maxsize=4)
def _no_tiles(surfels: int, dtype: torch.dtype, device: torch.device) -> TexelTiles:
    """Return tiles of surfels without texels; cached, so that a training step on a GPU does not clear them again."""
    size = torch.zeros(surfels, 2, dtype=torch.int32, device=device)
    return TexelTiles.of_sizes(size, torch.zeros(surfels, dtype=dtype, device=device))


def image_channels(maps: bool) -> int:
    """Count the channels of a blended image."""
    return MAP_CHANNELS if maps else IMAGE_CHANNELS


def blend_sums(maps: bool) -> int:
    """Count the gradients per pair of surfel and tile that the backward pass sums (csrc/ops/blend.h)."""
    return 8 if maps else 4


def backward_memory(fragments: Fragments, maps: bool, texels: int) -> dict[str, Tensor]:
    """Allocate working memory of the backward kernel by name; none on the CPU. `texels`: number T of texels with a
    gradient. On CUDA a row of four numbers each; with deterministic algorithms int64 sums instead, which do not depend
    on the order."""
    like = fragments.weight
    if not cuda_backend(like.device):
        return {}
    work = {"partial": like.new_empty(fragments.layout.handle.pairs, blend_sums(maps))}
    if texels and torch.are_deterministic_algorithms_enabled():
        numbers = module(like.device).exact_size(4 * texels)
        work["exact_work"] = torch.empty(numbers, dtype=torch.int64, device=like.device)
    elif texels:
        work["texel_work"] = like.new_empty(4 * texels)
    return work


class _BlendedImage(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weight, depth, uv, geom, base, texels, residual, fragments, tiles, bound, maps, descent):
        g = dense(geom, geom)
        b = dense(base, geom)
        t = dense(texels, geom)
        arrays = fragments.arrays
        r = None if residual is None else dense(residual, geom)
        image = geom.new_empty(fragments.width * fragments.height, image_channels(maps))
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
    alpha: TexelAlpha | None = None,
) -> tuple[Tensor, TexelTiles, bool, TexelDescent | None]:
    """Check and complete the texel arguments of `blended_image`: texels [T, 3], tiles, move_surfels, descent.

    Args:
        like: on the device of all tensors.
        surfels: N.
        base: [N, 3] view colours.
        texels, tiles, move_surfels, descent: as in `blended_image`.
        alpha: alphas that the view was projected with.

    Raises:
        ValueError: as `blended_image`.
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
    if alpha is not None and alpha.tiles.first is not tiles.first:
        raise ValueError("the alphas of texels lie in other tiles than their colours")
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
    """Shade and composite per pixel: sums of w times colour, 1 and beta; with maps also depth and normal.

    A fragment's colour is ReLU(ReLU(f_view(d) + 0.5) + r), eq. (color). The residual r is that of texels at (u, v),
    bilinear between the four nearest texel centres and constant beyond the outer ones; or of each fragment, as from
    `fragment_residual`; or 0. Differentiable in the fragments' weights, depths and coordinates, `projection.geom`,
    `base`, `texels` and `residual`. Along u and v the slope is that of the bilinear fetch, and 0 beyond the outer texel
    centres.

    Forward and backward are one pass over the fragments each and store neither colours nor their gradients, which saves
    24 of 64 bytes per fragment on CUDA and 32 on the CPU. CPU gradients do not depend on the number of threads or on
    what requires gradients: one thread adds up each surfel. On CUDA only gradients of texels depend on the order of
    sums, unless torch.use_deterministic_algorithms(True) is set.

    Args:
        fragments: F fragments of an H x W view.
        projection: of the view and N surfels.
        base: [N, 3] f_view of each surfel.
        texels: [T, 3] residual colours, of the fragments' dtype; None: none.
        bound: fragments of weight below this, or without a tile, have the colour ReLU(f_view + 0.5).
        maps: add depth and normal.
        move_surfels: propagate the gradient of r with respect to u and v to the fragments.
        descent: step on the texels of the view, taken in place in the backward pass without storing their gradient,
            which saves clearing and reading a whole atlas per view.
        residual: [F, 3] residual colour of each fragment, instead of texels.

    Returns:
        [H * W, 5] rgb, alpha, sum w beta; with maps [H * W, 9]: also sum w z (camera z) and sum w n (unit normals in
        the camera frame, OpenCV axes, facing the camera). Nothing is divided by alpha; the background is not included.

    Raises:
        ValueError: tiles do not match texels or surfels, or fragments do not match the projection; texels that require
            a gradient have a descent; texels and a residual are both given; or tensors are on different devices.
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
        base = base.detach().requires_grad_()  # so that there is a backward pass, even if nothing else learns
    rest = (projection.geom, base, texels, residual, fragments, tiles, bound, maps, descent)
    return _BlendedImage.apply(fragments.weight, fragments.depth, uv, *rest)


def soft_overdraw(fragments: Fragments, half: float) -> Tensor:
    """Count the fragments of a pixel differentiably: sum of w / (w + half), [H * W].

    Args:
        fragments: of an H x W view.
        half: the weight that counts one half, > 0. Far larger weights count 1, far smaller ones w / half.

    Raises:
        ValueError: half is not positive.
    """
    if not half > 0.0:
        raise ValueError(f"the weight that counts one half must be above 0, not {half}")
    count = fragments.weight / (fragments.weight + half)
    return count.new_zeros(fragments.width * fragments.height).index_add(0, fragments.pixel, count)
