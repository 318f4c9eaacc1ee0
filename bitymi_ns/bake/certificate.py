"""Certificate of a bake: the error of the stored residual colours against those before quantisation, as training views
see it. Alphas are not covered."""

from collections.abc import Sequence

import torch

from bitymi_ns.bake.baked import Baked
from bitymi_ns.bake.tile_errors import closest_pixels, listed_errors
from bitymi_ns.bake.tiles import Shown
from bitymi_ns.bundle.sketch import sketches_text
from bitymi_ns.bundle.statistics import Certificate
from bitymi_ns.codec.pages import listed_texels
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.tile_sizes import kernel_parameters


@torch.no_grad()
def certified(baked: Baked, cameras: Sequence[Camera]) -> Baked:
    """Measure the error of the stored texels' colours and state it in the statistics. A bake that has a certificate
    already, against the field, or no texels, or no tolerance, is returned as it is.

    Args:
        baked: encoded, on the CPU.
    """
    scene, options = baked.scene, baked.options
    if baked.atlas is None or options.tolerance == 0 or baked.statistics.certificate:
        return baked
    stored = listed_texels(torch.from_numpy(baked.atlas.decoded()[..., :3]), baked.packing, baked.mean_residual)
    before = (baked.texels if baked.uncoded is None else baked.uncoded)[:, :3]
    pixels = closest_pixels(scene.surfels, cameras, options.extent, scene.near) if cameras else None
    opacity, beta = kernel_parameters(scene.surfels, baked.in_front)
    shown = Shown(opacity, beta, baked.extent, scene.weight_bound, pixels=pixels)
    errors, seen = listed_errors(stored - before, baked.sizes, shown)
    rms = STEPS * float((stored - before).double().square().mean().sqrt())
    certificate = Certificate.of(errors[seen], options.tolerance, "texels").but(
        texel_rms=round(rms, 4), marks=sketches_text(before, stored)
    )
    return baked.with_statistics(certificate=certificate)
