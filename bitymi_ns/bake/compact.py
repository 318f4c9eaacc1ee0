"""From a bake to what a compact bundle keeps of it: rounded surfels in the order of a Morton curve."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from bitymi_ns.bake.codes import Codes
from bitymi_ns.bake.methods import Tiles
from bitymi_ns.bake.packing import pack
from bitymi_ns.bake.pages import listed_texels, moved_texels
from bitymi_ns.bake.pipeline import Baked
from bitymi_ns.bake.precision import MOST_SHARE, PrecisionOptions, choose_precision
from bitymi_ns.bake.statistics import Rounding
from bitymi_ns.bake.texel_codes import RESIDUAL_STEP, TexelCodeOptions, TexelCoder, residual_codes
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.train.views import View


@dataclass(frozen=True)
class Compact:
    """How a bake is made compact.

    Attributes:
        precision: of the surfels.
        coding: of the texels.
        left: bytes that texels may take, once the surfels are rounded; None = as many as they need.
    """

    precision: PrecisionOptions = field(default_factory=PrecisionOptions)
    coding: TexelCodeOptions = field(default_factory=TexelCodeOptions)
    left: Callable[[Codes], int | None] = lambda codes: None

    def coding_of(self, baked: Baked) -> TexelCodeOptions:
        """How the texels of a bake with rounded surfels are coded."""
        if baked.codes is None or baked.texels is None:
            return self.coding
        return replace(self.coding, most_bytes=self.left(baked.codes))


@torch.no_grad()
def with_rounded_surfels(
    baked: Baked,
    views: Sequence[View],
    background: Tensor,
    options: PrecisionOptions | None = None,
    progress: Progress = no_progress,
) -> Baked:
    """A bake whose surfels have the values that a compact bundle keeps, in its order. Texels are as they are and are to
    be coded by `tune.tune_atlas` or `with_coded_texels`.

    Args:
        baked: with lean view colours, on the CPU.
        views: training views.
        background: [3] colour behind the scene.
        options: see `PrecisionOptions`.
        progress: called on the way.
    """
    sizes = torch.from_numpy(baked.packing.tiles[:, 3:]).long()
    options = options or PrecisionOptions()
    while True:
        codes, order, error = choose_precision(baked.unquantised(), sizes, views, background, options, progress)
        if options.most_bytes is None or options.share >= MOST_SHARE or codes.nbytes() <= options.most_bytes:
            break
        options = replace(options, share=min(MOST_SHARE, 2 * options.share))
    packing = pack(codes.sizes, baked.options.page_width, baked.options.page_rows)
    texels = baked.texels
    if texels is not None:
        texels = moved_texels(texels, torch.from_numpy(baked.packing.tiles)[order], packing)
    residual = baked.mean_residual[order]
    pages = (baked.options.page_width, baked.options.page_rows)
    kept = Codes(codes, None, residual_codes(residual), RESIDUAL_STEP, *pages)
    statistics = baked.statistics.but(rounding=Rounding(mse=error, steps=dict(codes.steps)), error=None)
    rounded = replace(baked, rows=baked.rows[order], codes=kept, statistics=statistics).with_surfels(codes.surfels())
    return rounded.with_tiles(Tiles(packing, texels, codes.extent(baked.options.extent), residual))


def with_coded_texels(baked: Baked, options: TexelCodeOptions | None = None) -> Baked:
    """A bake with rounded surfels whose texels, all of which count the same, are coded as well."""
    assert baked.codes is not None
    if baked.texels is None:
        return baked
    texels = listed_texels(baked.texels, baked.packing, baked.mean_residual)
    options = options or TexelCodeOptions()
    coder = TexelCoder(torch.from_numpy(baked.packing.tiles[:, 3:]), torch.ones(len(texels)), options)
    coded = coder.code(texels) if options.most_bytes is None else coder.fit(texels, options.most_bytes)
    return baked.with_texel_codes(coded)
