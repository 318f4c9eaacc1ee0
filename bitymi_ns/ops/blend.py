"""Shading and compositing in one: the image of surfels with texels, or with their view colours alone."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from .backend import cuda_backend, dense, kernel
from .composite import check_projection
from .constants import IMAGE_CHANNELS, MAP_CHANNELS
from .project import Projection
from .texel import TexelDescent, TexelTiles, backward_memory, check_texels
from .trace import Fragments


@functools.lru_cache(maxsize=4)
def _no_tiles(surfels: int, dtype: torch.dtype, device: torch.device) -> TexelTiles:
    """Tiles of surfels without texels. Kept: a step on a card should not clear them anew."""
    size = torch.zeros(surfels, 2, dtype=torch.int32, device=device)
    return TexelTiles.of_sizes(size, torch.zeros(surfels, dtype=dtype, device=device))


class _BlendedImage(torch.autograd.Function):
    @staticmethod
    def forward(ctx, weight, depth, uv, geom, base, texels, fragments, tiles, bound, maps, descent):
        g, b, t, arrays = dense(geom, geom), dense(base, geom), dense(texels, geom), fragments.arrays_for_layout
        view = {"maps": maps, "width": fragments.width, "height": fragments.height, "layout": fragments.layout}
        image = geom.new_empty(fragments.width * fragments.height, MAP_CHANNELS if maps else IMAGE_CHANNELS)
        ctx.given = {**view, **tiles.arrays, "bound": bound}
        kernel("blend_forward", geom)(**ctx.given, **arrays, geom=g, base=b, texels=t, image=image)
        ctx.save_for_backward(g, b, t, *arrays.values())
        ctx.descent, ctx.names = descent, tuple(arrays)
        return image

    @staticmethod
    def backward(ctx, dimage):
        geom, base, texels, *rest = ctx.saved_tensors
        arrays = dict(zip(ctx.names, rest, strict=True))
        _, _, moves, _, _, learns, *_ = ctx.needs_input_grad
        out = {"dweight": torch.empty_like(arrays["weight"]), "dgeom": torch.empty_like(geom)}
        out |= {"dbase": torch.empty_like(base), "dtexels": torch.empty_like(texels) if learns else None}
        out |= {"duv": torch.empty_like(arrays["uv"]) if moves else None}
        out |= {"ddepth": torch.empty_like(arrays["depth"]) if ctx.given["maps"] else None}
        step = {"rate": 0.0} if ctx.descent is None else ctx.descent.arguments(texels)
        inputs = {"geom": geom, "base": base, "texels": texels, "dimage": dense(dimage, geom)}
        work = backward_memory(texels, 0, learns or ctx.descent is not None)
        if cuda_backend(geom.device):  # what a pair of surfel and tile adds to its surfel
            work["partial"] = geom.new_empty(ctx.given["layout"].pairs, 8 if ctx.given["maps"] else 4)
        kernel("blend_backward", geom)(**ctx.given, **arrays, **inputs, **step, **work, **out)
        gradients = (out[name] for name in ("dweight", "ddepth", "duv", "dgeom", "dbase", "dtexels"))
        return *gradients, None, None, None, None, None


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
) -> Tensor:
    """What `composite_image` gives for the colours of `texel_colors`, or of `shade` where there are no texels.

    It is one pass over the fragments, and one backward, which list neither colours nor their gradients: of 64 bytes per
    fragment 40 are left on a card, 32 on the CPU. On the CPU the sums of the backward pass depend neither on the number
    of threads nor on what learns: each surfel's are added by one thread. On a card only the gradients of texels depend
    on the order of sums, and not even they after torch.use_deterministic_algorithms(True).

    Args:
        fragments: F fragments of an H x W view.
        projection: the view's, of N surfels.
        base: [N, 3] f_view of every surfel.
        texels, tiles, bound, move_surfels, descent: as in `texel_colors`; without texels there is no residual.
        maps: add depth and normal.

    Returns:
        [H * W, 5], with maps [H * W, 9]: as `composite_image` does.

    Raises:
        ValueError: what `composite_image` and `texel_colors` raise.
    """
    check_projection(fragments, projection)
    if texels is None or tiles is None:
        tiles = _no_tiles(fragments.surfels, base.dtype, base.device)
        texels, move_surfels, descent = base.new_zeros(0, 3), False, None
    check_texels(fragments, base, texels, tiles, descent)
    uv = fragments.uv if move_surfels else fragments.uv.detach()
    given = (projection.geom, base, texels, fragments, tiles, bound, maps, descent)
    return _BlendedImage.apply(fragments.weight, fragments.depth, uv, *given)
