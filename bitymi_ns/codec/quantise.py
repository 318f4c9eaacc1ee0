"""Quantisation of the atlas: global range and texel formats."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.ops.baked_scene import decode_bc7
from bitymi_ns.progress import Progress, no_progress
from .bc7_encode import STRIP, Profile, bc7_encoder
from .limits import ALPHA_LIMIT, ALPHA_ONE, ALPHA_SCALE, RESIDUAL_LIMIT
from .packing import Packing
from .pages import covered_blocks, paged_texels

Format = Literal["bc7", "uint8", "fp16"]
RangeRule = Literal["sigma6", "minmax", "auto"]

STEPS = 255.0  # 8-bit steps per colour unit: the unit of errors and of the tolerance
BYTES_PER_TEXEL: dict[str, int] = {"bc7": 1, "uint8": 4, "fp16": 8}
_SMALLEST_SPAN = 1e-6


@dataclass(frozen=True)
class Range:
    """Global quantisation range: value = offset + scale * unorm with unorm in [0, 1]."""

    offset: float
    scale: float
    rule: str

    def to_unorm8(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
        """Quantise to the nearest 8-bit codes, clipped to the range."""
        unorm = (values - np.float32(self.offset)) * np.float32(1.0 / self.scale)
        return np.rint(np.clip(unorm, 0.0, 1.0) * 255.0).astype(np.uint8)

    def from_unorm8(self, codes: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
        return codes.astype(np.float32) * np.float32(self.scale / 255.0) + np.float32(self.offset)


@dataclass(frozen=True)
class Atlas:
    """Format of an atlas, and the error of its quantisation."""

    format: Format
    # width, height: page size in texels
    width: int
    height: int
    layers: int  # number of pages
    range: Range  # offset 0 and scale 1 for fp16
    encoder: str  # name and profile
    clipped_fraction: float  # share of the tiles' colour values outside the range
    mse: float  # mean squared error of the decoded tiles' colours against the atlas, colour units squared
    alpha_scale: float  # as in `BakedScene`

    @property
    def psnr(self) -> float | None:
        """PSNR of `mse` in dB, peak 1; None: no error."""
        return None if self.mse == 0 else float(-10.0 * np.log10(self.mse))


@dataclass(frozen=True)
class EncodedAtlas(Atlas):
    """An atlas in its stored format."""

    payload: list[bytes]  # by page: BC7 blocks, RGBA8 texels, or RGBA half floats, rows from the top

    @property
    def nbytes(self) -> int:
        return sum(len(page) for page in self.payload)

    def pages(self) -> Tensor:
        """Decode as `decode_pages`."""
        return torch.from_numpy(decode_pages(self.payload, self.format, self.width, self.height))

    def decoded(self) -> npt.NDArray[np.float32]:
        """Decode to [layers, height, width, C]: residual colours and, if stored, alphas."""
        return dequantised(self.pages().numpy(), self.range, self.alpha_scale)


def choose_range(
    texels: npt.NDArray[np.float32], rule: RangeRule = "sigma6", samples: int = 1 << 18, seed: int = 0
) -> Range:
    """Choose the quantisation range of an atlas's three colour channels.

    sigma6: mean +- 6 standard deviations of a bootstrap sample (paper, Quantization). minmax: smallest to largest
    value. auto: the one with the smaller mean squared error on the sample. `texels`: [T, C] float32, of the tiles."""
    if len(texels) == 0:
        return Range(0.0, 1.0, rule if rule != "auto" else "sigma6")
    sample = texels[np.random.default_rng(seed).integers(0, len(texels), samples), :3]
    if rule == "auto":
        candidates = [choose_range(texels, name, samples, seed) for name in ("sigma6", "minmax")]
        errors = [candidate.from_unorm8(candidate.to_unorm8(sample)) - sample for candidate in candidates]
        return candidates[int(np.argmin([np.square(error.astype(np.float64)).mean() for error in errors]))]
    if rule == "sigma6":
        values = sample.astype(np.float64)
        mean, spread = float(values.mean()), 6.0 * float(values.std())
        low, high = mean - spread, mean + spread
    elif rule == "minmax":
        low, high = float(texels[:, :3].min()), float(texels[:, :3].max())
    else:
        raise ValueError(f"the range rule must be sigma6, minmax or auto, not {rule!r}")
    low, high = (float(np.clip(end, -RESIDUAL_LIMIT, RESIDUAL_LIMIT)) for end in (low, high))
    if high - low < _SMALLEST_SPAN:  # a constant atlas: its value is code 0
        low, high = (low + high) / 2, (low + high) / 2 + _SMALLEST_SPAN
    return Range(low, high - low, rule)


def encode(
    texels: npt.NDArray[np.float32],
    packing: Packing,
    format: Format = "bc7",
    value_range: Range | None = None,
    profile: Profile = "veryfast",
    progress: Progress = no_progress,
) -> EncodedAtlas:
    """Quantise and encode texels [layers, height, width, C] float32, residual colours and, where C = 4, alphas, and
    measure the error of the colours inside the tiles. `format`: bc7 (1 byte per texel), uint8 (RGBA, 4) or fp16 (RGBA
    half floats, 8). `value_range`: not used by fp16; None: `choose_range` with its defaults."""
    if format not in BYTES_PER_TEXEL:
        raise ValueError(f"the atlas format must be bc7, uint8 or fp16, not {format!r}")
    layers, height, width, channels = texels.shape
    alpha_scale = 0.0 if channels == 3 else 1.0 if format == "fp16" else ALPHA_SCALE
    owned = covered_blocks(packing.tiles, width, height, layers)
    if format == "fp16":
        value_range = Range(0.0, 1.0, "none")
    elif value_range is None:
        value_range = choose_range(texels[owned.repeat(4, axis=1).repeat(4, axis=2)])
    encoder = bc7_encoder(profile, channels == 4) if format == "bc7" else None

    def strip(layer: int, top: int) -> tuple[bytes, int, float]:
        values = texels[layer, top : top + STRIP]  # [h, width, C]
        mask = owned[layer, top // 4 : (top + len(values)) // 4].repeat(4, axis=0).repeat(4, axis=1)
        rgba = _quantised(values, format, value_range)
        data = encoder(rgba) if encoder else rgba.tobytes()
        decoded = dequantised(decode_pages([data], format, width, len(values)), value_range)[0]
        whole = Range(-RESIDUAL_LIMIT, 2 * RESIDUAL_LIMIT, "none")
        return data, *_errors(values[mask, :3], decoded[mask], whole if format == "fp16" else value_range)

    strips = [(layer, top) for layer in range(layers) for top in range(0, height, STRIP)]
    pages: list[list[bytes]] = [[] for _ in texels]
    clipped, squares = 0, 0.0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = pool.map(lambda at: strip(*at), strips)
        for done, ((layer, _), (data, clips, square)) in enumerate(zip(strips, results, strict=True), start=1):
            pages[layer].append(data)
            clipped, squares = clipped + clips, squares + square
            progress("encoding the atlas", done, len(strips))
    values = max(1, int(owned.sum()) * 16 * 3)
    return EncodedAtlas(
        payload=[b"".join(page) for page in pages],
        format=format,
        width=width,
        height=height,
        layers=layers,
        range=value_range,
        encoder=f"ispc_texcomp {profile}" if format == "bc7" else f"{format} rounding",
        clipped_fraction=clipped / values,
        mse=squares / values,
        alpha_scale=alpha_scale,
    )


def round_to_bytes(texels: Tensor, packing: Packing, value_range: Range) -> tuple[Atlas, Tensor]:
    """Round decoded texels [T, C] of a compact bundle as its readers do, to the atlas and its `byte_pages`."""
    colors = texels.numpy()[packing.of_tiles, :3]
    clipped, squares = _errors(colors, value_range.from_unorm8(value_range.to_unorm8(colors)), value_range)
    atlas = Atlas(
        format="uint8",
        width=packing.width,
        height=packing.height,
        layers=packing.layers,
        range=value_range,
        encoder="cosine transform",
        clipped_fraction=clipped / max(1, colors.size),
        mse=squares / max(1, colors.size),
        alpha_scale=ALPHA_SCALE if texels.shape[1] == 4 else 0.0,
    )
    return atlas, byte_pages(texels, packing, value_range)


def byte_pages(texels: Tensor, packing: Packing, value_range: Range) -> Tensor:
    """Round listed texels [T, C] and lay them out as pages [layers, height, width, 4] uint8."""
    zero = torch.zeros(1, texels.shape[1])
    listed, nothing = (torch.from_numpy(_quantised(part.numpy(), "uint8", value_range)) for part in (texels, zero))
    # as int32, so that each texel moves at once
    return paged_texels(listed.view(torch.int32), packing, int(nothing.view(torch.int32))).view(torch.uint8)


def _errors(values: npt.NDArray[np.float32], decoded: npt.NDArray[np.float32], value_range: Range) -> tuple[int, float]:
    """Count colour values outside the range, and sum the squared errors of the decoded ones."""
    low, high = value_range.offset, value_range.offset + value_range.scale
    slack = 1e-6 * (high - low)  # the extremes may round to float32 just outside
    clipped = int(((values < low - slack) | (values > high + slack)).sum())
    return clipped, float(np.square(decoded.astype(np.float64) - values).sum())


def decode_pages(payload: Sequence[bytes | memoryview], format: Format, width: int, height: int) -> np.ndarray:
    """Decode pages to stored texels [layers, height, width, 4], float16 for fp16, else uint8. Raises ValueError: a page
    has the wrong number of bytes."""
    dtype = np.float16 if format == "fp16" else np.uint8
    pages = np.empty((len(payload), height, width, 4), dtype=dtype)
    for page, data in zip(pages, payload, strict=True):
        expected = width * height * BYTES_PER_TEXEL[format]
        if len(data) != expected:
            raise ValueError(f"a {format} page of {width} x {height} texels has {expected} bytes, not {len(data)}")
        if format == "bc7":
            page[:] = decode_bc7(bytes(data), width, height)
        else:
            page[:] = np.frombuffer(data, dtype=np.dtype(dtype).newbyteorder("<")).reshape(height, width, 4)
    return pages


def dequantised(pages: np.ndarray, value_range: Range, alpha_scale: float = 0.0) -> npt.NDArray[np.float32]:
    """Dequantise texels [..., 4], uint8 or float16, to [..., C]: colours and, unless `alpha_scale` is 0, alphas."""
    stored = pages[..., : 4 if alpha_scale else 3]
    if stored.dtype == np.float16:
        return stored.astype(np.float32)
    values = value_range.from_unorm8(stored)
    if alpha_scale:
        values[..., 3] = stored[..., 3] * np.float32(alpha_scale / 255.0)
    return values


def _quantised(values: npt.NDArray[np.float32], format: Format, value_range: Range) -> np.ndarray:
    """Quantise to RGBA texels [..., 4], uint8 or little-endian float16."""
    alpha = values[..., 3] if values.shape[-1] == 4 else None
    if format == "fp16":
        rgba = np.ones((*values.shape[:-1], 4), dtype="<f2")
        rgba[..., :3] = np.clip(values[..., :3], -RESIDUAL_LIMIT, RESIDUAL_LIMIT)
        if alpha is not None:
            rgba[..., 3] = np.clip(alpha, 0.0, ALPHA_LIMIT)
        return rgba
    rgba = np.full((*values.shape[:-1], 4), 255, dtype=np.uint8)
    rgba[..., :3] = value_range.to_unorm8(values[..., :3])
    if alpha is not None:
        rgba[..., 3] = np.rint(np.clip(alpha * np.float32(ALPHA_ONE), 0.0, 255.0))  # 128 = 1
    return rgba
