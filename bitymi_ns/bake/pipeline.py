"""First stages of the bake of trained texels: all of them as tiles, and reduced to a tolerance."""

import copy
from collections.abc import Sequence
from dataclasses import replace

import torch

from bitymi_ns.bake.baked import BakeableScene, Baked, joined
from bitymi_ns.bake.inputs import BakeInput, device_of, drawable, photo_resolution, visible
from bitymi_ns.bake.lean_color import kept_view_colors
from bitymi_ns.bake.reduce import reduced_tiles
from bitymi_ns.bake.tiles import Tiles
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import KeptSurfels, KeptTexels, Statistics
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField


@torch.no_grad()
def trained_texels(scene: BakeableScene, options: BakeOptions) -> Baked:
    """Bake a scene whose texels were trained: all of its tiles and view colours, and all drawable surfels; `reduced`
    then drops what the options say.

    Args:
        scene: with a `TexelField`.

    Raises:
        ValueError: no surfel is left, an option is out of range, or the atlas would be too large.
    """
    options.check()
    rows, left_out = drawable(scene.surfels)
    if len(rows) == 0:
        raise ValueError(f"no surfel is left to bake of {len(scene.surfels['means'])}: left out {left_out}")
    surfels = {name: value.detach()[rows].float().cpu() for name, value in scene.surfels.items()}
    assert isinstance(scene.field, TexelField)
    field, rows = copy.deepcopy(scene.field).cpu(), rows.cpu()
    field.keep(rows)
    bare = field.size.long().prod(1) == 1  # their one texel is their constant
    texels = field.texels.detach().float()
    if field.alpha is not None:
        texels = joined(texels, field.alpha.detach().float())
    tiles = Tiles(torch.where(bare[:, None], 0, field.size), field.extent.float(), texels)
    baked = Baked.of(scene, surfels, rows, tiles, options)
    statistics = Statistics(
        surfels=KeptSurfels(
            trained=len(scene.surfels["means"]), kept=len(rows), left_out=left_out, without_tile=int(bare.sum())
        ),
        texels=KeptTexels(learned=baked.packing.texels, kept=baked.packing.texels),
    )
    return replace(baked, statistics=statistics)


@torch.no_grad()
def reduced(baked: Baked, cameras: Sequence[Camera], progress: Progress = no_progress) -> Baked:
    """Reduce tiles and view colours of a bake whose texels or surfels were trained, as its options say.

    Left out and counted are surfels that cannot be drawn or stored, or that no view blends. The atlas is not encoded.

    Args:
        baked: of `trained_texels`, or made with `pixels_per_texel`.
        cameras: training views; their device does the work.

    Raises:
        ValueError: no surfel is left.
    """
    rows, gone = drawable(baked.scene.surfels)
    kept = torch.zeros(len(baked.rows), dtype=torch.bool)
    kept[rows] = True
    scene, options, device = baked.scene, baked.options, device_of(cameras)
    surfels = {name: value[rows].to(device) for name, value in scene.surfels.items()}
    alpha = None if baked.alpha is None else baked.alpha.of(rows).to(device)
    inputs = BakeInput(surfels, cameras, scene.near, scene.weight_bound, scene.prefilter, alpha=alpha)
    inputs, seen = visible(inputs, options, progress)
    if seen is not None:
        gone = gone.but(unseen=int((~seen).sum()))
        kept[rows] = seen.cpu()
    if not bool(kept.any()):
        raise ValueError("no surfel is left to bake")
    lean, view_color = kept_view_colors(inputs, options, progress)
    result = baked.only(kept)
    if options.tolerance > 0 and result.textured:
        tiles = Tiles(result.sizes, result.extent, result.texels)
        result = result.with_tiles(reduced_tiles(tiles, inputs, options, progress))
    in_front = None if inputs.transmittance is None else inputs.transmittance.cpu()
    result = replace(result.with_surfels(lean), in_front=in_front)
    result = replace(result, scene=replace(result.scene, photographed=photo_resolution(inputs)))
    counts = baked.statistics.surfels
    assert counts is not None and counts.left_out is not None
    left_out = counts.left_out.but(**{name: (getattr(counts.left_out, name) or 0) + n for name, n in gone if n})
    statistics = baked.statistics.but(
        surfels=counts.but(
            kept=len(result.rows), left_out=left_out, without_tile=int((result.packing.tiles[:, 3] == 0).sum())
        ),
        view_color=view_color,
    )
    if statistics.texels is not None:
        statistics = statistics.but(texels=statistics.texels.but(kept=result.packing.texels))
    if not result.textured:
        statistics = statistics.but(atlas=None)
    return replace(result, statistics=statistics)
