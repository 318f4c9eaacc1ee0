"""A scene whose texels learned in training, as a bake."""

from __future__ import annotations

import copy

import torch

from bitymi_ns.bake.inputs import drawable
from bitymi_ns.bake.pipeline import BakeableScene, Baked
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import KeptSurfels, KeptTexels, Statistics
from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.pages import paged_texels, tile_means
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.field import TexelField


@torch.no_grad()
def learned(scene: BakeableScene, options: BakeOptions) -> Baked:
    """The tiles and texels that a scene has learned, all of them, with all view colours and all surfels that can be
    drawn. `pipeline.reduced` then leaves out what the options say.

    Args:
        scene: with a `TexelField`.
        options: see `BakeOptions`.

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
    pages, constants = paged_texels(listed, packing), torch.where(bare[:, None], listed[field.tiles.first], 0.0)
    baked = BakedScene(
        surfels,
        kind_of(surfels),
        torch.from_numpy(packing.tiles),
        extent=field.extent.float(),
        mean_residual=tile_means(pages, packing, constants),
        near=scene.near,
        weight_bound=scene.config.weight_bound,
        prefilter=scene.config.prefilter,
    )
    statistics = Statistics(
        surfels=KeptSurfels(
            trained=len(scene.surfels["means"]), kept=len(rows), left_out=left_out, without_tile=int(bare.sum())
        ),
        texels=KeptTexels(learned=packing.texels, kept=packing.texels),
    )
    return Baked(baked, rows, packing, pages if packing.texels else None, None, options, statistics)
