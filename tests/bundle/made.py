"""Bundles of a few random surfels."""

import numpy as np
import torch

from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.quantise import Range, encode
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from tests.bake.scenes import write
from tests.ops.test_view_color import reduced_parameters


def make(surfels, folder, kind="sv", format="uint8", count=6, reduced=False, alpha=False, **kwargs):
    params = surfels(count, kind)
    if reduced:
        params = {k: v for k, v in params.items() if k not in VIEW_COLORS[kind].names}
        params |= reduced_parameters(kind, count, torch.float32)
    packing = pack([[8, 4]] * count)
    texels = np.random.default_rng(0).random((packing.layers, packing.height, packing.width, 4)).astype(np.float32)
    texels = texels if alpha else texels[..., :3]
    if alpha:
        kwargs.setdefault("mean_alpha", torch.linspace(0, 2, count))
    atlas = None if format is None else encode(texels, packing, format, Range(-0.5, 2.0, "test"))
    tiles = packing.tiles if atlas else np.zeros_like(packing.tiles)
    write(folder, params, tiles, atlas, kind=kind, **kwargs)
    return params, tiles, texels, atlas
