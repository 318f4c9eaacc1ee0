"""First stages of the bake of trained texels: all of them as tiles, and reduced to a tolerance."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from bitymi_ns.bake.baked import Baked, joined, with_means
from bitymi_ns.bake.inputs import BakeInput, device_of, drawable, photo_resolution, visible
from bitymi_ns.bake.lean_color import kept_view_colors
from bitymi_ns.bake.reduce import reduced_tiles
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import KeptSurfels, KeptTexels, Statistics
from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.pages import paged_texels, tile_means
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import TexelField


class BakeableScene(Protocol):
    """The part of a scene that the bake uses."""

    surfels: Mapping[str, Tensor]
    field: Any  # a residual field, a `TexelField`, or None
    near: float
    config: Any  # weight_bound, prefilter


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
    packing = pack(torch.where(bare[:, None], 0, field.size), options.page_width, options.page_rows)
    listed = field.texels.detach().float()
    if field.alpha is not None:
        listed = joined(listed, field.alpha.detach().float())
    pages, constants = paged_texels(listed, packing), torch.where(bare[:, None], listed[field.tiles.first], 0.0)
    baked = BakedScene(
        surfels,
        kind_of(surfels),
        torch.from_numpy(packing.tiles),
        extent=field.extent.float(),
        near=scene.near,
        weight_bound=scene.config.weight_bound,
        prefilter=scene.config.prefilter,
    )
    baked = with_means(baked, tile_means(pages, packing, constants))
    statistics = Statistics(
        surfels=KeptSurfels(
            trained=len(scene.surfels["means"]), kept=len(rows), left_out=left_out, without_tile=int(bare.sum())
        ),
        texels=KeptTexels(learned=packing.texels, kept=packing.texels),
    )
    return Baked(baked, rows, packing, pages if packing.texels else None, None, options, statistics)


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
    if options.tolerance > 0 and result.texels is not None:
        result = result.with_tiles(reduced_tiles(result.tiles, inputs, options, progress))
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
    if result.texels is None:
        statistics = statistics.but(atlas=None)
    return replace(result, statistics=statistics)
