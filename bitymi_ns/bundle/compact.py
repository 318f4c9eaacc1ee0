"""surfels.bin and texels.bin of a compact bundle: integer columns described by bundle.json. A `digest` takes their
integers, little-endian int64, for `Manifest.decoded`."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.codec import streams
from bitymi_ns.codec.packing import Packing, pack
from bitymi_ns.codec.streams import StreamError
from bitymi_ns.codec.surfel_codes import POSITION_BITS, REFERENCE, Codes, PositionGrid, SurfelCodes, columns_of
from bitymi_ns.codec.texel_codes import GRADES, AlphaCodes, TexelCodes, blocks_of, coefficient_columns
from bitymi_ns.ops.view_kinds import VIEW_COLORS
from .manifest import COMPACT_SURFELS, TEXELS, AtlasEntry, ColumnEntry, Manifest, Surfels

if TYPE_CHECKING:
    from hashlib import _Hash as Digest

SURFELS_PER_BYTE, TEXELS_PER_BYTE = 1, 64
"""Upper bounds, plus `SPARE_*`, on what a file may claim: constant columns take memory, but no bytes on disk. Trained
scenes have a surfel per 12 bytes or more, and at most 5 texels per byte of both files."""
SPARE_SURFELS, SPARE_TEXELS = 1 << 12, 1 << 20
MOST_EXPONENT = 12  # largest log2 of a tile side
MOST_COEFFICIENT = 1 << 24


def encode_surfels(
    codes: SurfelCodes, residual: Codes, residual_step: float, alpha: Codes | None, digest: Digest
) -> tuple[dict[str, Any], bytes]:
    """Encode surfels.bin; returns its entries in bundle.json and its bytes. `residual`, `alpha`: [N, 3] and [N], as in
    `SceneCodes`."""
    columns = {**codes.columns, "residual": residual}
    if alpha is not None:
        columns["alpha"] = alpha[:, None]
    steps = {**codes.steps, "residual": residual_step}
    columns = {name: columns[name] for name in columns_of(codes.kind, alpha is not None)}
    described, data = _compressed(columns, steps, digest)
    frame = {"center": codes.frame.center, "scale": codes.frame.scale, "low": codes.frame.low}
    return {"frame": frame, "columns": described}, data


def decode_surfels(
    info: Surfels, data: memoryview, has_alpha: bool = False, digest: Digest | None = None
) -> tuple[SurfelCodes, Codes, float, Codes | None]:
    """Decode surfels.bin to the codes, the residuals [N, 3] and their step, and mean alphas [N]. Raises StreamError:
    the file is damaged, contradicts bundle.json, or holds a number out of range."""
    assert info.columns is not None and info.frame is not None
    numbers = columns_of(info.view_color, has_alpha, [column.name for column in info.columns])
    steps = _check_columns(info.columns, numbers, (*REFERENCE, "residual"))
    rows = dict.fromkeys(numbers, info.count) | dict.fromkeys(("term_shape", "term_color"), info.terms or 0)
    codes: dict[str, Codes] = {}
    for column, part in zip(info.columns, _parts(data, info.columns), strict=True):
        if column.name == "extent":
            rows["extent"] = int((codes["size"] > 0).sum())
        codes[column.name] = _decompressed(part, rows[column.name], column, digest)
        _check_codes(column.name, codes[column.name], info)
    codes["place"] = np.cumsum(codes["place"], axis=0)
    f, residual = info.frame, codes.pop("residual")
    frame = PositionGrid(f.center, f.scale, f.low)
    residual_step = steps.pop("residual")
    alpha = codes.pop("alpha")[:, 0] if has_alpha else None
    return SurfelCodes(info.view_color, frame, steps, codes), residual, residual_step, alpha


def encode_texels(codes: TexelCodes, digest: Digest) -> tuple[dict[str, Any], bytes]:
    """Encode texels.bin; returns its entries in bundle.json and its bytes."""
    columns, alpha = codes.columns, codes.alpha
    steps = {} if alpha is None else {name: alpha.step for name in columns if name.startswith("alpha_")}
    described, data = _compressed(columns, steps, digest)
    count = int(codes.sizes.clamp(min=1).prod(dim=1)[codes.sizes[:, 0] > 0].sum())
    return {"texels": count, "step": codes.step, "columns": described}, data


def decoded_hash(info: Manifest, files: Mapping[str, bytes | bytearray]) -> str:
    """Compute `Manifest.decoded` of the files of a compact bundle, as this machine decodes them."""
    digest = hashlib.sha256()
    data = memoryview(files[COMPACT_SURFELS])
    codes, residual, step, alpha = decode_surfels(info.surfels, data, info.has_alpha, digest)
    if info.atlas is not None:
        sizes, data = torch.from_numpy(codes.sizes), memoryview(files[TEXELS])
        decode_texels(info.atlas, sizes, residual, step, data, alpha, digest)
    return digest.hexdigest()


def _compressed(
    columns: Mapping[str, npt.NDArray[np.integer]], steps: Mapping[str, float], digest: Digest
) -> tuple[list[dict[str, Any]], bytes]:
    for values in columns.values():
        digest.update(np.ascontiguousarray(values, "<i8").data)
    coded = {name: streams.compress(values) for name, values in columns.items()}
    entries = [{"name": name, "step": steps.get(name), "bytes": column.sizes} for name, column in coded.items()]
    return entries, b"".join(column.data for column in coded.values())


def _decompressed(data: memoryview, rows: int, column: ColumnEntry, digest: Digest | None, blocks: int = 0) -> Codes:
    codes = streams.decompress(data, rows, column.bytes, blocks)
    if digest is not None:
        digest.update(np.ascontiguousarray(codes, "<i8").data)
    return codes


def decode_texels(
    info: AtlasEntry,
    sizes: Tensor,
    residual: Codes,
    residual_step: float,
    data: memoryview,
    alpha: Codes | None = None,
    digest: Digest | None = None,
) -> TexelCodes:
    """Decode texels.bin, with what `decode_surfels` returned; `sizes`: [N, 2] tile sides. Raises StreamError: the file
    is damaged or contradicts bundle.json or the tile sizes."""
    assert info.columns is not None and info.step is not None and info.texels is not None
    count = int(sizes.prod(dim=1).sum())
    if count != info.texels:
        raise StreamError(f"the tiles of the surfels have {count} texels, atlas.texels says {info.texels}")
    blocks = blocks_of(sizes)
    names, alphas = coefficient_columns(blocks)
    alphas = [] if alpha is None else alphas
    numbers = {"grade": 1} | dict.fromkeys(names, 3) | dict.fromkeys(alphas, 1)
    steps = set(_check_columns(info.columns, numbers, alphas).values())
    if len(steps) > 1:
        raise StreamError("the columns of alphas have different steps")
    parts = _parts(data, info.columns)
    column, tiles = info.columns[0], int((sizes[:, 0] > 0).sum())
    grades = _decompressed(next(parts), tiles, column, digest)[:, 0]
    if tiles and not (GRADES[0] <= grades.min() and grades.max() <= GRADES[1]):
        raise StreamError(f"a grade is not from {GRADES[0]} to {GRADES[1]}")
    coefficients = []
    for group, column, part in zip([*blocks, *blocks[: len(alphas)]], info.columns[1:], parts, strict=True):
        values = _decompressed(part, group.texels.numel(), column, digest, len(group.texels))
        if np.abs(values).max(initial=0) > MOST_COEFFICIENT:
            raise StreamError(f"a coefficient of {column.name} is beyond {MOST_COEFFICIENT}")
        narrow = torch.from_numpy(values.astype(np.int32, order="C"))
        coefficients.append(narrow.view(-1, len(group.texels), values.shape[1]))
    coded = None if alpha is None else AlphaCodes(alpha, steps.pop() if steps else 1.0, coefficients[len(blocks) :])
    colors = coefficients[: len(blocks)]
    return TexelCodes(sizes, info.step, residual, residual_step, torch.from_numpy(grades), colors, coded)


def packing_of(info: AtlasEntry, sizes: Tensor) -> Packing:
    """Lay out the tiles of these sizes [N, 2] in pages. Raises StreamError: the pages differ from bundle.json's."""
    try:
        packing = pack(sizes.numpy(), info.page_width or 0, info.page_rows or 0)
    except ValueError as error:
        raise StreamError(str(error)) from error
    pages = (packing.width, packing.height, packing.layers)
    if pages != (info.width, info.height, info.layers):
        raise StreamError(f"the tiles make pages {pages}, width, height and layers of the atlas are others")
    return packing


def check_size(info: Manifest, name: str, size: int) -> None:
    """Check the size of surfels.bin or texels.bin against bundle.json before reading. Raises StreamError."""
    surfels, atlas = info.surfels, info.atlas
    entry = surfels if name == COMPACT_SURFELS else atlas
    stated = sum(sum(column.bytes) for column in (entry and entry.columns) or ())
    if stated != size:
        raise StreamError(f"truncated or too long: the columns need {stated} bytes, the file has {size}")
    if name == COMPACT_SURFELS:
        if max(surfels.count, surfels.terms or 0) > SURFELS_PER_BYTE * size + SPARE_SURFELS:
            raise StreamError(f"{surfels.count} surfels with {surfels.terms} terms cannot be in {size} bytes")
    elif atlas is not None:
        beside = info.files[COMPACT_SURFELS].bytes
        texels = max(atlas.texels or 0, atlas.width * atlas.height * atlas.layers)
        if texels > TEXELS_PER_BYTE * (size + beside) + SPARE_TEXELS:
            raise StreamError(f"{atlas.texels} texels cannot be in {size} bytes, and {beside} of {COMPACT_SURFELS}")


def _check_columns(
    columns: Sequence[ColumnEntry], numbers: Mapping[str, int], stepped: Sequence[str]
) -> dict[str, float]:
    names = [column.name for column in columns]
    if names != list(numbers):
        raise StreamError(f"the columns are {names}, not {list(numbers)}")
    steps = {}
    for column in columns:
        count, given = numbers[column.name], len(column.bytes)
        if given != count:
            raise StreamError(f"the column {column.name} needs {count} numbers, not {given}")
        if column.name in stepped:
            if column.step is None:
                raise StreamError(f"the column {column.name} has no step")
            steps[column.name] = column.step
    return steps


def _check_codes(name: str, codes: Codes, info: Surfels) -> None:
    """Check codes for values that the decoder does not clip."""
    if codes.size == 0:
        return
    low, high = int(codes.min()), int(codes.max())
    if name == "place" and (low < 0 or float(codes.astype(np.float64).sum()) >= 2.0 ** (3 * POSITION_BITS)):
        raise StreamError("the positions are not in ascending order, or beyond their grid")
    if name == "largest" and (low < 0 or high > 3):
        raise StreamError("a rotation's largest number is not one of four")
    if name == "alpha" and (low < 0 or high > 255):
        raise StreamError(f"the mean alpha of a surfel is {low if low < 0 else high}; it must be from 0 to 255")
    if name == "size":
        sides = np.stack([codes >> 4, codes & 15])[:, codes > 0]
        if low < 0 or (sides < 2).any() or (sides > MOST_EXPONENT).any():
            raise StreamError("a tile has a side that is not a power of two from 4 to 4096")
    if name == "view_count":
        counts = VIEW_COLORS[info.view_color].reduced_counts
        if not np.isin(codes, list(counts)).all() or int(codes.sum()) != (info.terms or 0):
            raise StreamError("the view colours do not have the terms that bundle.json counts")


def _parts(data: memoryview, columns: Sequence[ColumnEntry]) -> Iterator[memoryview]:
    for column in columns:
        size = sum(column.bytes)
        yield data[:size]
        data = data[size:]
