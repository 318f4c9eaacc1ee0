"""How far what is stored of a bake is from its texels before, as views see it; and marks by which that can be measured
again without them.

The marks of a list of numbers x_i are M sums, S_g = sum over i in group g of s_i x_i, where a hash of i gives the group
and the sign s_i. They are linear, and over the hashes sum_g (S_g(x) - S_g(y))^2 has the mean |x - y|^2 and a relative
standard deviation of at most sqrt(2 / M). So the marks of the texels before tell how far those that were read are from
them, and the marks of the stored ones whether they are those that were measured.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.bake.errors import listed_errors
from bitymi_ns.bake.field.footprint import closest_pixels
from bitymi_ns.bake.field.plan import Shown
from bitymi_ns.bake.options import STEPS
from bitymi_ns.bake.pipeline import Baked
from bitymi_ns.bake.statistics import MARKS, Certificate
from bitymi_ns.codec.pages import listed_texels
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.tile_sizes import kernel_parameters

_CHUNK = 1 << 20


@torch.no_grad()
def certified(baked: Baked, cameras: Sequence[Camera]) -> Baked:
    """The bake with the certificate of what is stored of its texels; as it is where it has one, against the field, or
    where there are no texels or no tolerance.

    Args:
        baked: encoded, on the CPU.
        cameras: training views.
    """
    scene, options = baked.scene, baked.options
    if baked.texels is None or baked.atlas is None or options.tolerance == 0 or baked.statistics.certificate:
        return baked
    stored = listed_texels(torch.from_numpy(baked.atlas.decoded()), baked.packing, baked.mean_residual)
    before = baked.uncoded
    if before is None:
        before = listed_texels(baked.texels, baked.packing, baked.mean_residual)
    pixels = closest_pixels(scene.surfels, cameras, options.extent, scene.near) if cameras else None
    opacity, beta = kernel_parameters(scene.surfels, baked.in_front)
    shown = Shown(opacity, beta, baked.extent, scene.weight_bound, pixels=pixels)
    errors, seen = listed_errors(stored - before, torch.from_numpy(baked.packing.tiles[:, 3:]), shown)
    certificate = Certificate.of(errors[seen], options.tolerance, "texels").but(
        texel_rms=round(texel_rms(stored, before), 4), marks=marks_text(before, stored)
    )
    return baked.with_statistics(certificate=certificate)


def texel_rms(stored: Tensor, before: Tensor) -> float:
    """Root mean square of the differences of two lists of texels [T, 3], 8-bit steps."""
    return STEPS * float((stored - before).double().square().mean().sqrt())


def marks(texels: Tensor) -> npt.NDArray[np.float64]:
    """[MARKS] of a list of texels [T, 3]."""
    values, sums = texels.double().numpy().reshape(-1), np.zeros(MARKS)
    for start in range(0, len(values), _CHUNK):
        part = values[start : start + _CHUNK]
        key = _hashed(np.arange(start, start + len(part), dtype=np.uint64))
        signed = np.where(key >> np.uint64(63), -part, part)
        sums += np.bincount((key % np.uint64(MARKS)).astype(np.int64), weights=signed, minlength=MARKS)
    return sums


def marks_text(before: Tensor, stored: Tensor) -> str:
    """The marks of texels [T, 3] before they were stored, and as they are stored, as bundle.json holds them: base64 of
    little-endian float32."""
    return base64.b64encode(np.stack([marks(before), marks(stored)]).astype("<f4").tobytes()).decode()


def marks_of(text: str) -> npt.NDArray[np.float64]:
    """[2, MARKS] of `marks_text`."""
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(2, MARKS).astype(np.float64)


def measured_rms(texels: Tensor, before: npt.NDArray[np.float64]) -> float:
    """About how far texels [T, 3] are from those of the marks [MARKS]: root mean square, 8-bit steps."""
    return STEPS * float(np.sqrt(np.square(marks(texels) - before).sum() / max(1, texels.numel())))


def _hashed(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """64 bits of each number: the finaliser of SplitMix64, the same everywhere."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
