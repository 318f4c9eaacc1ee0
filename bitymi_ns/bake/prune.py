"""Reduction of a bake: surfels are dropped, tiles and view colours reduced."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from bitymi_ns.bundle.statistics import KeptSurfels, KeptTexels, LeftOut
from bitymi_ns.codec.limits import within
from bitymi_ns.ops.constants import ALPHA_MIN
from bitymi_ns.ops.parameters import Tensors
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.visibility import visibility
from .inputs import BakeInput, photo_resolution
from .stages import Reduced, Trained
from .tiles import Tiles, reduced_tiles
from .view_colors import reduce_view_colors


def drawable(surfels: Tensors) -> tuple[Tensor, Counter[str]]:
    """Find the rows, int64, that can be drawn and stored; count those left out, by field of `LeftOut`."""
    finite = torch.stack([value.isfinite().unsqueeze(-1).flatten(1).all(1) for _, value in surfels.items()]).all(0)
    scales = surfels["log_scales"].exp()
    finite &= torch.isfinite(scales).all(1) & (scales > 0).all(1)
    turned = surfels["quats"].norm(dim=1)
    finite &= torch.isfinite(turned) & (turned > 1e-12)
    storable = finite & within(surfels, kind_of(surfels))
    transparent = storable & (surfels["opacity_logits"].sigmoid() < ALPHA_MIN)
    counts = {"not_finite": ~finite, "beyond_limits": finite & ~storable, "transparent": transparent}
    left_out = Counter({reason: int(mask.sum()) for reason, mask in counts.items()})
    return torch.nonzero(storable & ~transparent).squeeze(1), left_out


def drop_unseen(
    baked: Trained, cameras: Sequence[Camera], progress: Progress = no_progress
) -> tuple[Trained, BakeInput]:
    """Leave out, and count, surfels that cannot be drawn or stored and, by option, those that no view blends. Also
    returns the kept surfels and their visibility, on the bake's device. Raises ValueError: none is left."""
    scene, device = baked.scene, baked.device
    rows, gone = drawable(scene.surfels)
    surfels = {name: value[rows].to(device) for name, value in scene.surfels.items()}
    alpha = None if baked.alpha is None else baked.alpha.of(rows).to(device)
    moved, views = [camera.to(device) for camera in cameras], None
    if moved and (baked.options.drop_unseen or baked.options.tolerance > 0):
        views = visibility(surfels, moved, scene.near, scene.weight_bound, progress, alpha)
    inputs = BakeInput(surfels, moved, scene.near, scene.weight_bound, views, alpha)
    if views is not None and baked.options.drop_unseen:
        seen = torch.nonzero(views.transmittance > 0).squeeze(1)
        gone["unseen"] = len(rows) - len(seen)
        inputs, rows = inputs.of(seen), rows[seen.to(rows.device)]
    if len(rows) == 0:
        raise ValueError("no surfel is left to bake")
    kept = torch.zeros(len(baked.rows), dtype=torch.bool)
    kept[rows] = True
    left_out = baked.left_out.copy()
    left_out.update(+gone)  # without reasons that left out none
    return replace(baked.only(kept), left_out=left_out), inputs


@torch.no_grad()
def prune_and_resample(baked: Trained, cameras: Sequence[Camera], progress: Progress = no_progress) -> Reduced:
    """Drop surfels (`drop_unseen`), and reduce tiles and view colours by the bake's options."""
    result, inputs = drop_unseen(baked, cameras, progress)
    surfels, colors, view_color = reduce_view_colors(inputs, baked.options, progress)
    if baked.options.tolerance > 0 and result.textured:
        tiles = Tiles(result.sizes, result.extent, result.texels)
        result = result.with_tiles(reduced_tiles(tiles, inputs, baked.options, progress))
    result = result.with_surfels(surfels)
    in_front = torch.ones(len(result.rows)) if inputs.transmittance is None else inputs.transmittance.cpu()
    scene = replace(result.scene, photographed=photo_resolution(inputs))
    counts = KeptSurfels(
        trained=result.trained,
        kept=len(result.rows),
        left_out=LeftOut(**result.left_out),
        without_tile=int((result.packing.tiles[:, 3] == 0).sum()),
    )
    texels = dict(result.texel_counts)
    if texels:
        texels["kept"] = result.packing.texels
    result = replace(result, texel_counts=texels)
    return result.become(Reduced, scene=scene, in_front=in_front, colors=colors).stating(
        surfels=counts, view_color=view_color, texels=KeptTexels(**texels) if texels else None
    )
