"""Images by CUDA kernels without fragment lists (csrc/cuda/rasterize.cu).

Two bits per fragment are kept, in masks of the pairs of surfel and tile; the backward pass recomputes the rest tile by
tile. So a view with any number of fragments is drawn at once, and the host waits once, for the number of pairs.
"""

import torch
from torch import Tensor

from .backend import cuda_backend, dense, kernel, module
from .bands import Unlisted
from .bin_cuda import tile_lists
from .blend import blend_sums, checked_texels, image_channels
from .project import Projection
from .texel import TexelDescent, TexelTiles, gradient_or_step
from .trace_cuda import layout_of


def can_rasterize(device: torch.device) -> bool:
    """Return True if `rasterize_image` can run: on CUDA devices without deterministic algorithms. These need a list,
    because integer sums need a bound of the gradients of alpha texels."""
    return cuda_backend(device) and not torch.are_deterministic_algorithms_enabled()


class _Rasterized(torch.autograd.Function):
    @staticmethod
    def forward(ctx, geom, base, texels, texel_alpha, projection, tiles, bound, rim, maps, moves, descent):
        g, b, t = dense(geom, geom), dense(base, geom), dense(texels, geom)
        camera, bins = projection.camera, tile_lists(g, projection)
        pairs, pixels = len(bins.surfel), camera.width * camera.height
        masks = torch.empty(module(g.device).TILE_WARPS, pairs, dtype=torch.int32, device=g.device)
        cuts = torch.empty_like(masks) if projection.alpha is not None else None
        image = g.new_empty(pixels, image_channels(maps))
        transmittance = g.new_empty(pixels)
        ctx.arguments = {**projection.view(g), **projection.alpha_arrays, **tiles.arrays, "bound": bound, "maps": maps}
        kernel("rasterize_forward", g)(
            **ctx.arguments,
            base=b,
            texels=t,
            surfel=bins.surfel,
            tile_pairs=bins.tile_pairs,
            masks=masks,
            cuts=cuts,
            image=image,
            transmittance=transmittance,
        )
        ctx.layout = layout_of({"masks": masks, **vars(bins)}, camera.width, camera.height)
        ctx.save_for_backward(g, b, t, texel_alpha, cuts, transmittance)
        ctx.projection, ctx.rim, ctx.moves, ctx.descent = projection, rim, moves, descent
        return image, ctx.layout

    @staticmethod
    def backward(ctx, dimage, _):
        geom, base, texels, texel_alpha, cuts, transmittance = ctx.saved_tensors
        pairs, kernels = ctx.layout.handle.pairs, module(geom.device)
        out = {
            "dgeom": torch.empty_like(geom),
            "absgrad": geom.new_empty(len(geom), 2),
            "dbase": torch.empty_like(base),
        }
        dtexels, step = gradient_or_step(texels, ctx.needs_input_grad[2], ctx.descent)
        work = {"partial": geom.new_empty(pairs, kernels.TRACE_SUMS)}
        work["color_partial"] = geom.new_empty(pairs, blend_sums(ctx.arguments["maps"]))
        dalpha = torch.empty_like(texel_alpha) if ctx.needs_input_grad[3] else None
        if "moved" in step or dalpha is not None:
            work["texel_work"] = geom.new_empty(4 * len(texels))
        kernel("rasterize_backward", geom)(
            **ctx.arguments,
            **step,
            **work,
            **out,
            base=base,
            texels=texels,
            layout=ctx.layout.handle,
            rim=ctx.rim,
            moves=ctx.moves,
            cuts=cuts,
            transmittance=transmittance,
            dimage=dense(dimage, geom),
            dtexel_alpha=dalpha,
        )
        ctx.projection.take_mean2d(out["dgeom"][:, :2], out["absgrad"])
        return out["dgeom"], out["dbase"], dtexels, dalpha, *(None,) * 7


def rasterize_image(
    projection: Projection,
    base: Tensor,
    texels: Tensor | None = None,
    tiles: TexelTiles | None = None,
    bound: float = 0.0,
    maps: bool = False,
    move_surfels: bool = True,
    descent: TexelDescent | None = None,
    rim: float = 1e-3,
) -> tuple[Tensor, Unlisted]:
    """Draw a view: `trace` and `blended_image` in one kernel each forward and backward.

    Differentiable in `projection.geom`, its alpha texels, `base` and `texels`. The backward pass fills
    `projection.mean2d_grad` and `projection.mean2d_absgrad`. Only sums over texels depend on the thread order.

    Args:
        projection: from `project`, on a device where `can_rasterize`; geom [N, 16].
        base, texels, tiles, bound, maps, move_surfels, descent: as in `blended_image`.
        rim: as in `trace`.

    Returns:
        [H * W, 5 or, with maps, 9] as from `blended_image`; and the view's fragments.

    Raises:
        RuntimeError: 2^31 pairs of surfel and tile or more, or not a CUDA device.
        ValueError: tiles do not match texels, surfels or alpha texels; texels that require a gradient have a descent;
            or tensors are on different devices.
    """
    geom = projection.geom
    texels, tiles, move_surfels, descent = checked_texels(
        geom, len(geom), base, texels, tiles, move_surfels, descent, projection.alpha
    )
    if descent is not None and not base.requires_grad:
        base = base.detach().requires_grad_()  # so that there is a backward pass, even if nothing else learns
    alpha = None if projection.alpha is None else projection.alpha.values
    how = (projection, tiles, bound, rim, maps, move_surfels, descent)
    image, layout = _Rasterized.apply(geom, base, texels, alpha, *how)
    return image, Unlisted(projection.detached(), rim, layout=layout)
