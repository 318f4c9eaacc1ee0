"""Count sketches of texel lists, from which the distance of two lists is estimated.

The sketch of numbers x_i is M sums S_g = sum over i in group g of s_i x_i, where a hash of i gives its group and sign
s_i. sum_g (S_g(x) - S_g(y))^2 has the mean |x - y|^2 and a relative standard deviation of at most sqrt(2 / M)."""

import base64

import numpy as np
import numpy.typing as npt
from torch import Tensor

from bitymi_ns.codec.quantise import STEPS

SIZE = 128  # M
_CHUNK = 1 << 20


def sketch(texels: Tensor) -> npt.NDArray[np.float64]:
    """Compute the count sketch [SIZE] of texels [T, 3]."""
    values, sums = texels.double().numpy().reshape(-1), np.zeros(SIZE)
    for start in range(0, len(values), _CHUNK):
        part = values[start : start + _CHUNK]
        key = _splitmix64(np.arange(start, start + len(part), dtype=np.uint64))
        signed = np.where(key >> np.uint64(63), -part, part)
        sums += np.bincount((key % np.uint64(SIZE)).astype(np.int64), weights=signed, minlength=SIZE)
    return sums


def sketches_text(before: Tensor, stored: Tensor) -> str:
    """Encode for bundle.json the sketches of texels [T, 3] before quantisation and as stored: base64 of little-endian
    float32."""
    return base64.b64encode(np.stack([sketch(before), sketch(stored)]).astype("<f4").tobytes()).decode()


def sketches_of(text: str) -> npt.NDArray[np.float64]:
    """Decode the sketches [2, SIZE] of `sketches_text`."""
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(2, SIZE).astype(np.float64)


def estimated_rms(texels: Tensor, before: npt.NDArray[np.float64]) -> float:
    """Estimate the root mean square difference between texels [T, 3] and a sketched list [SIZE], 8-bit steps."""
    return STEPS * float(np.sqrt(np.square(sketch(texels) - before).sum() / max(1, texels.numel())))


def _splitmix64(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Hash 64-bit integers with the finaliser of SplitMix64."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
