"""Integer codes of texels: the quantised cosine transform of every tile."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.codec import streams
from bitymi_ns.codec.limits import ALPHA_ONE, RESIDUAL_LIMIT
from bitymi_ns.codec.pages import first_texels, size_classes
from bitymi_ns.codec.surfel_codes import SurfelCodes
from bitymi_ns.ops import backend

BLOCK = 8  # side of the largest block that is transformed, texels
GRADES = (-8, 24)  # range of the grades: a tile's step is the common one times 2^(grade / 2)
RESIDUAL_STEP = 4.0 / 255  # step of the mean residuals of tiles and of the residuals of surfels without a tile
LEAST_WEIGHT = 1e-3  # least weight of a texel, pixels, so that unseen ones stay near their values
SPARSE_ROUNDS = 8  # round in which coefficients that only texels nobody sees would need are shrunk
ALPHA_GAIN = 6.0
"""Step of alphas in those of residual colours: an error of alpha costs the contrast of a surfel with what is behind it,
and at equal bytes 4 to 8 give the same PSNR."""
SHRINK = 0.6  # soft threshold of an iteration as a share of the step, where all texels of a block are seen alike
_ATTEMPTS = 16
_FAST = 9
_SMALLEST_STEP, _LARGEST_STEP = 1e-5, 50.0
# Brightness, and two differences: an orthonormal basis, so that errors are as large as those of the channels.
_OPPONENT = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, -1.0], [1.0, -2.0, 1.0]])
_OPPONENT = _OPPONENT / _OPPONENT.norm(dim=1, keepdim=True)
_CHANNELS = {3: _OPPONENT, 1: torch.ones(1, 1)}  # coded channels of values, by their number: of colours, and of alphas


@dataclass
class TexelCodeOptions:
    """Precision of coded texels."""

    step: float = 7.5
    """Step of a coefficient, in 8-bit steps, of texels that make up one pixel of the views each: of those that make up
    w pixels it is step / sqrt(w)."""
    most_bytes: int | None = None
    """Texels take no more than this, with their residuals and mean alphas: the step grows until they fit. None = it
    stays."""
    fill: bool = False  # The step also shrinks while the texels are tuned, until they take nearly `most_bytes`.

    def check(self) -> None:
        """Refuse values that make no sense."""
        if not 0.01 <= self.step <= 1000:
            raise ValueError(f"the step of the texels must be from 0.01 to 1000, not {self.step}")
        if self.most_bytes is not None and self.most_bytes < 1:
            raise ValueError(f"no bytes are left for the texels ({self.most_bytes}): ask for more")


@dataclass(frozen=True)
class Blocks:
    """The blocks of one size of all tiles, by the rows of their surfels, then from the top, then from the left."""

    size: tuple[int, int]  # (b_u, b_v) texels
    tile: Tensor  # [B] int64, the number of the block's tile among the surfels that have one
    texels: Tensor  # [B, b_v, b_u] int64, rows of its texels in the list of `TexelTiles`

    @property
    def name(self) -> str:
        """Name of its column."""
        return f"{self.size[0]}x{self.size[1]}"

    @property
    def order(self) -> list[tuple[int, int]]:
        """(k_v, k_u) of the coefficients, in the order in which they are kept: from the lowest frequency."""
        b_u, b_v = self.size
        every = ((k_v, k_u) for k_v in range(b_v) for k_u in range(b_u))
        return sorted(every, key=lambda k: (k[0] * b_u + k[1] * b_v, k))


def blocks_of(sizes: Tensor) -> list[Blocks]:
    """The blocks of tiles of the sizes [N, 2], by (b_u, b_v)."""
    first, number = first_texels(sizes), (sizes[:, 0] > 0).long().cumsum(0) - 1
    found: dict[tuple[int, int], list[tuple[Tensor, Tensor]]] = {}
    for r_u, r_v, rows in size_classes(sizes):
        b_u, b_v = min(r_u, BLOCK), min(r_v, BLOCK)
        tile = torch.arange(r_u * r_v).view(r_v // b_v, b_v, r_u // b_u, b_u).transpose(1, 2).reshape(-1, b_v, b_u)
        texels = first[rows, None, None, None] + tile
        owner = number[rows].repeat_interleave(len(tile))
        found.setdefault((b_u, b_v), []).append((owner, texels.reshape(-1, b_v, b_u)))
    blocks = []
    for size in sorted(found):
        owner, texels = (torch.cat(parts) for parts in zip(*found[size], strict=True))
        order = torch.argsort(owner, stable=True)
        blocks.append(Blocks(size, owner[order], texels[order]))
    return blocks


@dataclass(frozen=True)
class AlphaCodes:
    """The alphas of the texels of N surfels as integers."""

    mean: npt.NDArray[np.int64]  # [N] of every tile, or the constant: 0 to 255, 128 = 1
    step: float  # of the coefficients of a tile of grade 0
    coefficients: Sequence[Tensor]  # as in `TexelCodes`, [coefficients, B, 1]

    @property
    def means(self) -> Tensor:
        """[N] float32 mean alphas."""
        return mean_alphas_of(self.mean)

    def values(self, sizes: Tensor, grades: Tensor) -> Tensor:
        """[T] float32 alphas of tiles of the sizes [N, 2] and grades [tiles]: whole bytes / 128, as they are drawn."""
        found = _decoded(self.means[:, None], self.coefficients, sizes, _steps(self.step, grades))
        return _bytes(found[:, 0]) / ALPHA_ONE


@dataclass(frozen=True)
class TexelCodes:
    """The texels of N surfels as integers."""

    sizes: Tensor  # [N, 2] int64 sides of the tiles; (0, 0) = one constant
    step: float  # of the coefficients of a tile of grade 0, colour units
    # [N, 3] int64, mean of every tile or the constant, in steps: green, red - green, blue - green
    residual: npt.NDArray[np.int64]
    residual_step: float  # of these, colour units
    grades: Tensor  # [tiles] int64
    # of every entry of `blocks_of(sizes)`, int32 [coefficients, B, 3] in their order; the channels are (r + g + b) /
    # sqrt(3), (r - b) / sqrt(2), (r - 2 g + b) / sqrt(6)
    coefficients: Sequence[Tensor]
    alpha: AlphaCodes | None = None  # None = opaque texels

    @property
    def columns(self) -> dict[str, npt.NDArray[np.int64]]:
        """The columns of texels.bin: name to [rows, numbers]."""
        columns = {"grade": self.grades.numpy()[:, None]}
        names, alphas = coefficient_columns(blocks_of(self.sizes))
        parts = zip(names, self.coefficients, strict=True)
        if self.alpha is not None:
            parts = chain(parts, zip(alphas, self.alpha.coefficients, strict=True))
        for name, values in parts:
            columns[name] = values.reshape(-1, values.shape[2]).numpy().astype(np.int64)
        return columns

    def nbytes(self, level: int = streams.LEVEL) -> int:
        """Bytes of texels.bin, and of residuals and mean alphas in surfels.bin."""
        columns = [*self.columns.values(), self.residual]
        if self.alpha is not None:
            columns.append(self.alpha.mean[:, None])
        return sum(len(streams.compress(column, level).data) for column in columns)

    @property
    def constants(self) -> Tensor:
        """[N, 3] mean residuals."""
        return constants(self.residual, self.residual_step)

    def texels(self) -> Tensor:
        """[T, 3] residual colours, in the order of `TexelTiles`."""
        return _decoded(self.constants, self.coefficients, self.sizes, _steps(self.step, self.grades))

    def alphas(self) -> Tensor | None:
        """[T] alphas in the same order; None = opaque texels."""
        return None if self.alpha is None else self.alpha.values(self.sizes, self.grades)


def coefficient_columns(blocks: Sequence[Blocks]) -> tuple[list[str], list[str]]:
    """Names of the columns of the blocks' coefficients: of colours, and of alphas."""
    names = [each.name for each in blocks]
    return names, [f"alpha_{name}" for name in names]


def mean_alphas_of(mean: npt.NDArray[np.int64]) -> Tensor:
    """[N] float32 mean alphas of integers."""
    return torch.from_numpy(mean).float() / ALPHA_ONE


def constants(residual: npt.NDArray[np.int64], step: float) -> Tensor:
    """[N, 3] float32 residuals of integers: green, red - green, blue - green."""
    g, r, b = np.ascontiguousarray(residual.T)
    values = np.stack([r + g, g, b + g], axis=1) * step
    return torch.from_numpy(np.clip(values, -RESIDUAL_LIMIT, RESIDUAL_LIMIT).astype(np.float32))


def residual_codes(values: Tensor) -> npt.NDArray[np.int64]:
    """[N, 3] integers of residuals."""
    r, g, b = np.rint(values.double().numpy() / RESIDUAL_STEP).astype(np.int64).T
    return np.stack([g, r - g, b - g], axis=1)


@dataclass(frozen=True)
class SceneCodes:
    """Surfels and texels of a compact bundle as integers."""

    surfels: SurfelCodes  # of N surfels
    texels: TexelCodes | None  # of their tiles; None without tiles, or before they are coded
    residual: npt.NDArray[np.int64]  # [N, 3] int64 mean residuals: green, red - green, blue - green
    residual_step: float  # of these, colour units
    # page_width, page_rows: arguments of `packing.pack`
    page_width: int
    page_rows: int

    @property
    def alpha(self) -> npt.NDArray[np.int64] | None:
        """[N] int64 mean alphas, 0 to 255: 128 = 1; None = opaque texels."""
        return None if self.texels is None or self.texels.alpha is None else self.texels.alpha.mean


class TexelCoder:
    """Coder of the texels of given tiles, weighted by their coverage in the views."""

    def __init__(
        self, sizes: Tensor, weights: Tensor, options: TexelCodeOptions, first: TexelCodes | None = None
    ) -> None:
        """
        Args:
            sizes: [N, 2] sides of the tiles; (0, 0) = one constant.
            weights: [T] of the texels, in the order of `TexelTiles`: sum over views and fragments of the squared
                blending weight times the bilinear weight. An error e of a texel adds weight times e^2 to the pictures.
            first: earlier codes, whose alphas stay, and so the grades; None = there are none.
        """
        options.check()
        self._sizes, self._weights = sizes.long(), weights + LEAST_WEIGHT
        self._step = options.step / 255
        self._blocks = blocks_of(self._sizes)
        tiled = self._sizes[:, 0] > 0
        area = self._sizes.clamp(min=1).prod(dim=1)
        self._owner = torch.repeat_interleave(torch.arange(len(area)), area)
        mean = self._sums(self._weights[:, None])[:, 0] / area
        low, high = GRADES
        self.grades = (-torch.log2(mean[tiled])).round().long().clamp(low, high) if first is None else first.grades
        self.alpha: AlphaCodes | None = None if first is None else first.alpha
        self._packing = 0.0  # bytes as they are written, as a share of those of a fast packing; 0 = not known yet

    def fit(self, texels: Tensor, most_bytes: float, rounds: int = SPARSE_ROUNDS) -> TexelCodes:
        """Code texels [T, 3] in at most `most_bytes`, alphas included, with a larger step where that takes it.

        Bytes fall about as 1 / step. They are estimated with a fast packing until they fit nearly, and then counted.
        """
        codes = self.code(texels, rounds)
        for attempt in range(_ATTEMPTS):
            found = codes.nbytes(_FAST if attempt == 0 else streams.LEVEL)
            if found <= most_bytes:
                break
            self._step = min(_LARGEST_STEP, self._step * min(4.0, max(1.06, (found / most_bytes) ** 1.2)))
            codes = self.code(texels, rounds)
        return codes

    def aim(self, codes: TexelCodes, most_bytes: float) -> None:
        """Change the step of later codes of nearly the same texels, so that they take `most_bytes`."""
        fast = codes.nbytes(_FAST)
        if self._packing == 0:
            self._packing = codes.nbytes() / max(1, fast)
        ratio = self._packing * fast / most_bytes
        self._step = min(_LARGEST_STEP, max(_SMALLEST_STEP, self._step * min(2.0, max(0.5, ratio))))

    def _sums(self, values: Tensor) -> Tensor:
        """Sums over tiles of [T, ...]."""
        return values.new_zeros(len(self._sizes), *values.shape[1:]).index_add_(0, self._owner, values)

    def _means(self, values: Tensor) -> Tensor:
        """[N, C] means over tiles of [T, C]."""
        weights = self._weights[:, None]
        return self._sums(values * weights) / self._sums(weights)

    @torch.no_grad()
    def code_alpha(self, alpha: Tensor, rounds: int = SPARSE_ROUNDS) -> Tensor:
        """Code alphas [T], from 0 to 2, which stay the same in all later codes of colours: [T] as they are drawn."""
        step = ALPHA_GAIN * self._step
        mean = _bytes(self._means(alpha[:, None])[:, 0])
        codes = AlphaCodes(mean.numpy().astype(np.int64), step, [])
        found = self._coefficients(alpha[:, None], codes.means[:, None], step, rounds)
        self.alpha = replace(codes, coefficients=found)
        return self.alpha.values(self._sizes, self.grades)

    @torch.no_grad()
    def code(self, texels: Tensor, rounds: int = SPARSE_ROUNDS) -> TexelCodes:
        """Code texels [T, 3], with the alphas that were coded.

        Coefficients c minimise sum over texels of weight (t - t(c))^2 plus an L1 penalty, by as many iterations of
        ISTA (a gradient step and soft thresholding). So unseen texels take what their visible neighbours need.
        """
        residual = residual_codes(self._means(texels))
        codes = TexelCodes(self._sizes, self._step, residual, RESIDUAL_STEP, self.grades, [], self.alpha)
        return replace(codes, coefficients=self._coefficients(texels, codes.constants, self._step, rounds))

    def _coefficients(self, texels: Tensor, means: Tensor, step: float, rounds: int) -> list[Tensor]:
        """Of every entry of the blocks, int32 [coefficients, B, C], of texels [T, C] and the means [N, C] of tiles."""
        of_tile, steps = means[self._sizes[:, 0] > 0], _steps(step, self.grades)
        sparse_cosines = backend.load("_cpu").sparse_cosines_f32  # codes are made on the CPU, whatever draws
        options = {
            "values": texels.contiguous(), "weights": self._weights, "mean": of_tile.contiguous(), "step": steps,
            "mix": _CHANNELS[texels.shape[1]], "channels": texels.shape[1], "rounds": rounds, "shrink": SHRINK,
        }  # fmt: skip
        coefficients = []
        for blocks in self._blocks:
            width, height = blocks.size
            codes = torch.empty(height * width, len(blocks.tile), texels.shape[1], dtype=torch.int32)
            order = torch.tensor([k_v * width + k_u for k_v, k_u in blocks.order])
            sparse_cosines(
                **options, codes=codes, rows=blocks.texels, tile=blocks.tile, order=order,
                height=height, width=width, down=_cosines(height), across=_cosines(width),
            )  # fmt: skip
            coefficients.append(codes)
        return coefficients


def _decoded(means: Tensor, coefficients: Sequence[Tensor], sizes: Tensor, steps: Tensor) -> Tensor:
    """[T, C] texels of the means [N, C], and of coefficients of tiles of the sizes [N, 2] and steps [tiles]."""
    texels, of_tile = means.repeat_interleave(sizes.clamp(min=1).prod(dim=1), dim=0), means[sizes[:, 0] > 0]
    for blocks, values in zip(blocks_of(sizes), coefficients, strict=True):
        texels_of, count, width = values.shape
        channels = values.view(texels_of, -1).T.float() @ _basis(blocks)  # [B C, texels]: one product
        channels = channels.view(count, width, -1).transpose(1, 2) * steps[blocks.tile, None, None]
        found = channels @ _CHANNELS[width] + of_tile[blocks.tile, None, :]
        texels[blocks.texels.reshape(-1)] = found.reshape(-1, width)
    return texels


def _bytes(alpha: Tensor) -> Tensor:
    """Whole numbers from 0 to 255 nearest to alphas, 128 of which are 1."""
    return torch.floor(alpha * ALPHA_ONE + 0.5).clamp(0, 255)


def _steps(step: float, grades: Tensor) -> Tensor:
    return (step * torch.exp2(0.5 * grades.double())).float()


@cache
def _cosines(count: int) -> Tensor:
    """[count, count] the orthonormal cosine transform: row k is frequency k."""
    k, i = np.arange(count)[:, None], np.arange(count)[None]
    rows = np.cos(math.pi * (i + 0.5) * k / count) * math.sqrt(2.0 / count)
    rows[0] /= math.sqrt(2.0)
    return torch.from_numpy(rows.astype(np.float32))


def _basis(blocks: Blocks) -> Tensor:
    """[coefficients, texels] basis of a block, in the order of the coefficients."""
    b_u, b_v = blocks.size
    v, u = _cosines(b_v), _cosines(b_u)
    rows, columns = (list(each) for each in zip(*blocks.order, strict=True))
    return (v[rows][:, :, None] * u[columns][:, None, :]).reshape(len(rows), b_v * b_u)
