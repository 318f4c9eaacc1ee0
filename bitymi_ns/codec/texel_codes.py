"""Integer codes of texels: quantised cosine transform of each tile."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from scipy.fft import dct
from torch import Tensor

from bitymi_ns.ops import backend
from . import streams
from .limits import ALPHA_ONE, RESIDUAL_LIMIT
from .pages import first_texels, joined, size_classes
from .surfel_codes import SurfelCodes, from_differences, quantised, to_differences

BLOCK = 8  # largest side of a transformed block, texels
GRADES = (-8, 24)  # range of a tile's grade: its step is the common one times 2^(grade / 2)
RESIDUAL_STEP = 4.0 / 255  # step of mean residuals
STEP = 7.5  # of coefficients, 8-bit steps, where nothing decides it
LEAST_WEIGHT = 1e-3  # added to texel weights, pixels, so that unseen texels stay near their values
SPARSE_ROUNDS = 8  # ISTA iterations
ALPHA_GAIN = 6.0
"""Step of alphas relative to residual colours; at equal bytes 4 to 8 give the same PSNR."""
SHRINK = 0.6  # soft threshold of an iteration relative to the step, for equally weighted texels
_ATTEMPTS = 16
_SMALLEST_STEP, _LARGEST_STEP = 1e-5, 50.0
# Brightness and two differences: orthonormal, so that errors keep their size.
_OPPONENT = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]], dtype=torch.float32)
_OPPONENT = _OPPONENT / _OPPONENT.norm(dim=1, keepdim=True)
# transform of the channels, by their number (colours, alphas)
_CHANNELS = {3: _OPPONENT, 1: torch.ones(1, 1, dtype=torch.float32)}


@dataclass(frozen=True)
class Blocks:
    """All tiles' blocks of one size, sorted by surfel, row and column."""

    size: tuple[int, int]  # (b_u, b_v) texels
    tile: Tensor  # [B] int64 index among the surfels that have a tile
    texels: Tensor  # [B, b_v, b_u] int64 rows in the list of `TexelTiles`

    @property
    def name(self) -> str:
        return f"{self.size[0]}x{self.size[1]}"

    @property
    def order(self) -> list[tuple[int, int]]:
        """(k_v, k_u) of the coefficients in stored order: ascending frequency."""
        b_u, b_v = self.size
        every = ((k_v, k_u) for k_v in range(b_v) for k_u in range(b_u))
        return sorted(every, key=lambda k: (k[0] * b_u + k[1] * b_v, k))


def blocks_of(sizes: Tensor) -> list[Blocks]:
    """Split tiles of sizes [N, 2] into blocks, grouped and sorted by (b_u, b_v)."""
    first, number = first_texels(sizes), (sizes[:, 0] > 0).long().cumsum(0) - 1
    parts: dict[tuple[int, int], list[tuple[Tensor, Tensor]]] = {}
    for r_u, r_v, rows in size_classes(sizes):
        b_u, b_v = min(r_u, BLOCK), min(r_v, BLOCK)
        tile = torch.arange(r_u * r_v).view(r_v // b_v, b_v, r_u // b_u, b_u).transpose(1, 2).reshape(-1, b_v, b_u)
        texels = first[rows, None, None, None] + tile
        owner = number[rows].repeat_interleave(len(tile))
        parts.setdefault((b_u, b_v), []).append((owner, texels.reshape(-1, b_v, b_u)))
    blocks = []
    for size in sorted(parts):
        owner, texels = map(torch.cat, zip(*parts[size], strict=True))
        order = torch.argsort(owner, stable=True)
        blocks.append(Blocks(size, owner[order], texels[order]))
    return blocks


@dataclass(frozen=True)
class AlphaCodes:
    """Alphas of the texels of N surfels as integers."""

    mean: npt.NDArray[np.int64]  # [N] mean of each tile, or the constant: 0 to 255, 128 = 1
    step: float  # of coefficients at grade 0
    coefficients: Sequence[Tensor]  # as in `TexelCodes`, [coefficients, B, 1]

    @property
    def means(self) -> Tensor:
        """[N] float32 mean alphas."""
        return mean_alphas_of(self.mean)

    def values(self, sizes: Tensor, grades: Tensor) -> Tensor:
        """Decode the alphas [T] float32 of tiles of sizes [N, 2] and grades [tiles]: bytes / 128, as drawn."""
        steps = _steps(self.step, grades)
        alphas = _decode(self.means[:, None], self.coefficients, blocks_of(sizes), sizes, steps)
        return _round_to_bytes(alphas[:, 0]) / ALPHA_ONE


@dataclass(frozen=True)
class TexelCodes:
    """Texels of N surfels as integers."""

    sizes: Tensor  # [N, 2] int64 sides of the tiles; (0, 0) = one constant
    step: float  # of coefficients at grade 0, colour units
    residual: npt.NDArray[np.int64]  # [N, 3] mean of each tile, or the constant: green, red - green, blue - green
    residual_step: float  # colour units
    grades: Tensor  # [tiles] int64
    coefficients: Sequence[Tensor]  # per entry of `blocks_of(sizes)`: int32 [coefficients, B, 3], as in docs/baking.md
    alpha: AlphaCodes | None = None  # None = opaque texels

    @property
    def columns(self) -> dict[str, npt.NDArray[np.integer]]:
        """The columns of texels.bin: name to [tiles, 1] grades, or [coefficients, blocks, numbers]."""
        names, alphas = coefficient_columns(blocks_of(self.sizes))
        coefficients = list(self.coefficients)
        if self.alpha is not None:
            names = names + alphas
            coefficients = coefficients + list(self.alpha.coefficients)
        named = zip(names, (values.numpy() for values in coefficients), strict=True)
        return {"grade": self.grades.numpy()[:, None], **dict(named)}

    def nbytes(self) -> int:
        """Count the bytes of texels.bin, and of residuals and mean alphas in surfels.bin."""
        means = [] if self.alpha is None else [self.alpha.mean[:, None]]
        return streams.bytes_of([*self.columns.values(), self.residual, *means])

    @property
    def constants(self) -> Tensor:
        """[N, 3] mean residuals."""
        return constants(self.residual, self.residual_step)

    def texels(self, blocks: Sequence[Blocks] | None = None) -> Tensor:
        """Decode the residual colours [T, 3], in the order of `TexelTiles`. `blocks`: of the sizes, if at hand."""
        blocks = blocks_of(self.sizes) if blocks is None else blocks
        return _decode(self.constants, self.coefficients, blocks, self.sizes, _steps(self.step, self.grades))

    def decoded(self) -> Tensor:
        """Decode to [T, C]: residual colours and, if there are any, alphas."""
        return joined(self.texels(), self.alphas())

    @property
    def means(self) -> Tensor:
        """[N, C] means of `decoded`."""
        return joined(self.constants, None if self.alpha is None else self.alpha.means)

    def alphas(self) -> Tensor | None:
        """Decode the alphas [T], in the same order; None if opaque."""
        return None if self.alpha is None else self.alpha.values(self.sizes, self.grades)


def coefficient_columns(blocks: Sequence[Blocks]) -> tuple[list[str], list[str]]:
    """Name the coefficient columns of the blocks: colours, alphas."""
    names = [each.name for each in blocks]
    return names, [f"alpha_{name}" for name in names]


def mean_alphas_of(mean: npt.NDArray[np.int64]) -> Tensor:
    """Decode mean alphas [N] to float32."""
    return torch.from_numpy(mean).float() / ALPHA_ONE


def constants(residual: npt.NDArray[np.int64], step: float) -> Tensor:
    """Decode residuals [N, 3] (green, red - green, blue - green) to float32 RGB."""
    values = from_differences(residual) * step
    return torch.from_numpy(np.clip(values, -RESIDUAL_LIMIT, RESIDUAL_LIMIT).astype(np.float32))


def residual_codes(values: Tensor) -> npt.NDArray[np.int64]:
    """Quantise residuals [N, 3]."""
    return to_differences(quantised(values.double().numpy(), RESIDUAL_STEP))


@dataclass(frozen=True)
class SceneCodes:
    """Surfels and texels of a compact bundle as integers."""

    surfels: SurfelCodes  # of N surfels
    texels: TexelCodes | None  # None without tiles
    residual: npt.NDArray[np.int64]  # [N, 3] mean residuals in steps: green, red - green, blue - green
    residual_step: float  # colour units
    # page_width, page_rows: arguments of `packing.pack`
    page_width: int
    page_rows: int

    @property
    def alpha(self) -> npt.NDArray[np.int64] | None:
        """[N] mean alphas, 128 = 1; None if opaque."""
        return None if self.texels is None or self.texels.alpha is None else self.texels.alpha.mean


class TexelCoder:
    """Texel coder of fixed tiles, weighted by their coverage in the views."""

    def __init__(self, sizes: Tensor, weights: Tensor, step: float = STEP, first: TexelCodes | None = None) -> None:
        """Take tiles of sides `sizes` [N, 2], (0, 0) = one constant, and texel weights [T] (docs/baking.md), in the
        order of `TexelTiles`. `step`: of a coefficient, in 8-bit steps, for texels of weight 1; step / sqrt(w) for
        weight w. `first`: codes whose alphas and grades are kept."""
        self._sizes, self._weights = sizes.long(), weights + LEAST_WEIGHT
        self._step = step / 255
        self.blocks = blocks_of(self._sizes)
        tiled = self._sizes[:, 0] > 0
        area = self._sizes.clamp(min=1).prod(dim=1)
        self._owner = torch.repeat_interleave(torch.arange(len(area)), area)
        mean = self._sums(self._weights[:, None])[:, 0] / area
        low, high = GRADES
        self.grades = (-torch.log2(mean[tiled])).round().long().clamp(low, high) if first is None else first.grades
        self.alpha: AlphaCodes | None = None if first is None else first.alpha

    def fit(self, texels: Tensor, most_bytes: float, rounds: int = SPARSE_ROUNDS) -> TexelCodes:
        """Code texels [T, 3] in at most `most_bytes`, alphas included, enlarging the step if needed."""
        codes = self.code(texels, rounds)
        for _ in range(_ATTEMPTS):
            size = codes.nbytes()
            if size <= most_bytes:
                break
            self._step = min(_LARGEST_STEP, self._step * min(4.0, max(1.06, (size / most_bytes) ** 1.2)))
            codes = self.code(texels, rounds)
        return codes

    def aim(self, codes: TexelCodes, most_bytes: float) -> None:
        """Adjust the step so that codes of nearly the same texels take `most_bytes`."""
        ratio = codes.nbytes() / most_bytes
        self._step = min(_LARGEST_STEP, max(_SMALLEST_STEP, self._step * min(2.0, max(0.5, ratio))))

    def _sums(self, values: Tensor) -> Tensor:
        """Sum [T, ...] over each tile."""
        return values.new_zeros(len(self._sizes), *values.shape[1:]).index_add_(0, self._owner, values)

    def _means(self, values: Tensor) -> Tensor:
        """Average [T, C] over each tile, weighted: [N, C]."""
        weights = self._weights[:, None]
        return self._sums(values * weights) / self._sums(weights)

    @torch.no_grad()
    def code_alpha(self, alpha: Tensor, rounds: int = SPARSE_ROUNDS) -> Tensor:
        """Code alphas [T], 0 to 2, for all later `code` calls; returns them decoded, [T]."""
        step = ALPHA_GAIN * self._step
        mean = _round_to_bytes(self._means(alpha[:, None])[:, 0])
        codes = AlphaCodes(mean.numpy().astype(np.int64), step, [])
        coefficients = self._coefficients(alpha[:, None], codes.means[:, None], step, rounds)
        self.alpha = replace(codes, coefficients=coefficients)
        return self.alpha.values(self._sizes, self.grades)

    @torch.no_grad()
    def code(self, texels: Tensor, rounds: int = SPARSE_ROUNDS) -> TexelCodes:
        """Code texels t [T, 3], with the alphas coded before. Coefficients c minimise the sum of weight (t - t(c))^2
        plus an L1 penalty, by `rounds` iterations of ISTA, so that unseen texels take the values that cost least."""
        residual = residual_codes(self._means(texels))
        codes = TexelCodes(self._sizes, self._step, residual, RESIDUAL_STEP, self.grades, [], self.alpha)
        return replace(codes, coefficients=self._coefficients(texels, codes.constants, self._step, rounds))

    def _coefficients(self, texels: Tensor, means: Tensor, step: float, rounds: int) -> list[Tensor]:
        """Compute int32 [coefficients, B, C] per block size, from texels [T, C] and tile means [N, C]."""
        coefficients = []
        shared = _shared(means, self._sizes, _steps(step, self.grades))
        values = {"values": texels.contiguous(), "weights": self._weights, "rounds": rounds, "shrink": SHRINK}
        for blocks in self.blocks:
            codes = torch.empty(math.prod(blocks.size), len(blocks.tile), texels.shape[1], dtype=torch.int32)
            backend.load("_cpu").sparse_cosines_f32(**shared, **_block_arguments(blocks), **values, codes=codes)
            coefficients.append(codes)
        return coefficients


def _decode(
    means: Tensor, coefficients: Sequence[Tensor], blocks: Sequence[Blocks], sizes: Tensor, steps: Tensor
) -> Tensor:
    """Decode texels [T, C] from means [N, C] and coefficients of tiles of sizes [N, 2] and steps [tiles]."""
    texels = means.repeat_interleave(sizes.clamp(min=1).prod(dim=1), dim=0)
    shared = _shared(means, sizes, steps)
    for group, codes in zip(blocks, coefficients, strict=True):
        backend.load("_cpu").decode_cosines_f32(**shared, **_block_arguments(group), codes=codes, values=texels)
    return texels


def _shared(means: Tensor, sizes: Tensor, steps: Tensor) -> dict[str, Any]:
    """Build the arguments of csrc/cpu/kernels.h for all blocks."""
    channels = means.shape[1]
    of_tiles = means[sizes[:, 0] > 0].contiguous()
    return {"mean": of_tiles, "step": steps, "mix": _CHANNELS[channels], "channels": channels}


def _block_arguments(blocks: Blocks) -> dict[str, Any]:
    width, height = blocks.size
    order = torch.tensor([k_v * width + k_u for k_v, k_u in blocks.order])
    cosines = {"down": _cosines(height), "across": _cosines(width)}
    return {**cosines, "rows": blocks.texels, "tile": blocks.tile, "order": order, "height": height, "width": width}


def _round_to_bytes(alpha: Tensor) -> Tensor:
    """Round alphas to bytes as floats, 128 = 1."""
    return torch.floor(alpha * ALPHA_ONE + 0.5).clamp(0, 255)


def _steps(step: float, grades: Tensor) -> Tensor:
    return (step * torch.exp2(0.5 * grades.double())).float()


@cache
def _cosines(count: int) -> Tensor:
    """Compute the orthonormal cosine transform [count, count]; row k is frequency k."""
    return torch.from_numpy(dct(np.eye(count), axis=0, norm="ortho").astype(np.float32))
