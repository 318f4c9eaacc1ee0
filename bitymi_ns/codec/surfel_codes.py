"""Integer codes of surfels and their decoding."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.ops.parameters import GEOMETRY_PARAMETERS, SMALLEST_SHARE, Parameter
from bitymi_ns.ops.view_color import REDUCED
from bitymi_ns.ops.view_kinds import COLOR_LIMIT, VIEW_COLORS
from . import streams
from .limits import EXTENTS, limit_of

Codes = npt.NDArray[np.int64]

POSITION_BITS = 17  # bits per axis of a position: three axes fit exactly into a float64
LINEAR = {parameter.code or name: parameter for name, parameter in GEOMETRY_PARAMETERS.items() if parameter.step}
"""Parameters whose numbers are coded one by one, by column."""
LATER = {column for column, parameter in LINEAR.items() if parameter.absent is not None}
"""Columns that bundles of earlier versions lack."""
REFERENCE: dict[str, float] = {
    "place": 1.0 / 512,
    "rotation": 1.0 / 128,
    **{column: parameter.step for column, parameter in LINEAR.items() if parameter.step},
    "extent": 1.0 / 16,
    "view_base": 1.0 / 96,
    "term_shape": 1.0 / 12,
    "term_color": 1.0 / 64,
}
"""Reference steps of the columns whose precision is chosen. Units: place (positions) as in `PositionGrid`, opacity and
beta shares of their ranges, term_shape asinh."""
CODED = {parameter.code: name for name, parameter in GEOMETRY_PARAMETERS.items() if parameter.code}
"""Surfel parameter of each column whose name differs."""


def columns_of(kind: str, has_alpha: bool, stated: Collection[str] | None = None) -> dict[str, int]:
    """Count the numbers per row of the columns of surfels.bin, in order; `stated` columns may lack those of `LATER`."""
    colors, shapes = term_numbers(kind)
    numbers = {"place": 1, "largest": 1, "rotation": 3, **{column: p.width for column, p in LINEAR.items()}, "size": 1}
    numbers |= {"residual": 3, **({"alpha": 1} if has_alpha else {}), "view_base": 3, "extent": 1, "view_count": 1}
    numbers |= {"term_shape": len(shapes), "term_color": len(colors)}
    lacking = set() if stated is None else LATER.difference(stated)
    return {column: count for column, count in numbers.items() if column not in lacking}


@dataclass(frozen=True)
class PositionGrid:
    """Grid of positions: x = center + scale sinh(low + step k), per axis, with integers k >= 0: about uniform within
    `scale` of the centre, growing with the distance beyond."""

    # center, low: per axis
    center: tuple[float, float, float]
    scale: float  # world units
    low: tuple[float, float, float]


@dataclass(frozen=True)
class SurfelCodes:
    """N surfels as integers, in Morton order."""

    kind: str  # view-colour kind, a name of `ops.VIEW_COLORS`
    frame: PositionGrid
    steps: Mapping[str, float]  # quantisation step by column, as in `REFERENCE`
    # column of surfels.bin (docs/baking.md), but residual and alpha, to [rows, numbers] int64; place is the Morton
    # codes themselves, ascending
    codes: Mapping[str, Codes]

    def __len__(self) -> int:
        return len(self.codes["place"])

    @property
    def columns(self) -> dict[str, Codes]:
        """The columns of surfels.bin, but residual and alpha."""
        return {**self.codes, "place": np.diff(self.codes["place"], axis=0, prepend=0)}

    def nbytes(self) -> int:
        """Count the bytes of surfels.bin without residuals."""
        return streams.bytes_of(self.columns.values())

    @property
    def sizes(self) -> npt.NDArray[np.int64]:
        """[N, 2] tile sides, texels; (0, 0) without a tile."""
        size = self.codes["size"][:, 0]
        return np.where(size[:, None] > 0, 1 << np.stack([size >> 4, size & 15], axis=1), 0)

    def extent(self, default: float) -> Tensor:
        """Decode the tiles' half sides [N] in scale units; `default` without a tile."""
        tiled, extent = self.codes["size"][:, 0] > 0, np.full(len(self), default)
        extent[tiled] = np.clip(self._linear("extent")[:, 0], *EXTENTS)
        return torch.from_numpy(extent.astype(np.float32)).clamp(*EXTENTS)

    def surfels(self) -> dict[str, Tensor]:
        """Decode the parameters, float32."""
        entry, (colors, shapes) = VIEW_COLORS[self.kind], term_numbers(self.kind)
        terms = np.zeros((len(self.codes["term_color"]), entry.reduced_width))
        count = self.codes["view_count"][:, 0]
        terms[:, colors] = self.steps["term_color"] * from_differences(self.codes["term_color"])
        terms[:, shapes] = _sinh(self._linear("term_shape"))
        values = {
            "means": self._means(),
            "quats": self._rotations(),
            **{parameter.name: self._values(column, parameter) for column, parameter in LINEAR.items()},
            "view_base": self.steps["view_base"] * from_differences(self.codes["view_base"]),
            "view_terms": terms,
        }
        surfels = {name: _clip_to_limits(name, self.kind, value) for name, value in values.items()}
        span = np.stack([np.cumsum(count) - count, count], axis=1).astype(np.int32)
        return {**surfels, "view_span": torch.from_numpy(span)}

    def _linear(self, name: str) -> npt.NDArray[np.float64]:
        return self.steps[name] * self.codes[name]

    def _values(self, column: str, parameter: Parameter) -> npt.NDArray[np.float64]:
        if column not in self.codes:
            return np.full((len(self), *parameter.shape), parameter.absent)
        values = self._linear(column).reshape(-1, *parameter.shape)
        return values if parameter.least is None else _logit(values, parameter.least)

    def _means(self) -> npt.NDArray[np.float64]:
        frame = self.frame
        bent = np.array(frame.low) + self.steps["place"] * morton_cells(self.codes["place"])
        return np.array(frame.center) + frame.scale * _sinh(bent)

    def _rotations(self) -> npt.NDArray[np.float64]:
        rest, largest = self._linear("rotation"), self.codes["largest"][:, 0]
        quats = np.empty((len(rest), 4))
        at = np.arange(4)[None, :] != largest[:, None]
        quats[at] = rest.reshape(-1)
        quats[~at] = np.sqrt(np.clip(1.0 - (rest**2).sum(1), 0.0, None))
        return quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-9)


def code_surfels(
    surfels: Mapping[str, Tensor], kind: str, sizes: npt.ArrayLike, extent: Tensor, steps: Mapping[str, float]
) -> tuple[SurfelCodes, Tensor]:
    """Quantise surfels, on the CPU with reduced view colours, and sort them in Morton order; returns the codes, and
    their order: [N] int64 rows of `surfels`. `sizes`: [N, 2] sides of the tiles, texels; (0, 0) = none. `extent`: [N]
    half sides of the tiles, scale units. `steps`: by column, as in `REFERENCE`; that of place grows if its cells would
    exceed `POSITION_BITS`."""
    values = {name: value.detach().double().numpy() for name, value in surfels.items()}
    frame, step, cell = _grid_cells(values["means"], steps["place"])
    steps = {**steps, "place": step}
    position = morton_codes(cell)
    order = np.argsort(position, kind="stable")
    quats = values["quats"] / np.linalg.norm(values["quats"], axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    rest = quats[np.arange(4)[None, :] != largest[:, None]].reshape(-1, 3)
    sides = np.asarray(sizes, dtype=np.int64)
    tiled = sides[:, 0] > 0
    exponents = np.log2(np.maximum(sides, 1)).astype(np.int64)
    per_surfel = {
        "place": position[:, None],
        "largest": largest[:, None],
        "rotation": quantised(rest, steps["rotation"]),
        **{column: quantised(_coded(values[p.name], p), steps[column]) for column, p in LINEAR.items()},
        "size": np.where(tiled, 16 * exponents[:, 0] + exponents[:, 1], 0)[:, None],
        "view_base": to_differences(quantised(values["view_base"], steps["view_base"])),
        "view_count": values["view_span"][:, 1:].astype(np.int64),
    }
    codes = {name: np.ascontiguousarray(value[order]) for name, value in per_surfel.items()}
    tiles = order[tiled[order]]
    codes["extent"] = quantised(extent.double().numpy()[tiles, None], steps["extent"])
    colors, shapes = term_numbers(kind)
    terms = values["view_terms"][term_rows(values["view_span"].astype(np.int64)[order])]
    codes["term_shape"] = quantised(np.arcsinh(terms[:, shapes]), steps["term_shape"])
    codes["term_color"] = to_differences(quantised(terms[:, colors], steps["term_color"]))
    return SurfelCodes(kind, frame, steps, codes), torch.from_numpy(order)


def reordered(surfels: Mapping[str, Tensor], order: Tensor) -> dict[str, Tensor]:
    """Reorder surfels with reduced view colours by rows [N]; terms follow their surfels."""
    span = surfels["view_span"].long()[order]
    moved = {name: value[order].contiguous() for name, value in surfels.items() if name not in REDUCED}
    moved["view_base"] = surfels["view_base"][order].contiguous()
    moved["view_terms"] = surfels["view_terms"][torch.from_numpy(term_rows(span.numpy()))].contiguous()
    moved["view_span"] = torch.stack([span[:, 1].cumsum(0) - span[:, 1], span[:, 1]], dim=1).int()
    return moved


def term_numbers(kind: str) -> tuple[list[int], list[int]]:
    """Split the indices of a reduced term's numbers into colours (in threes) and others."""
    limit = limit_of("view_terms", kind)
    every = limit * (VIEW_COLORS[kind].reduced_width if len(limit) == 1 else 1)
    colors = [i for i, each in enumerate(every) if each == COLOR_LIMIT]
    return colors, [i for i in range(len(every)) if i not in colors]


def morton_codes(cell: Codes) -> Codes:
    """Interleave cells [N, 3], below 2^17 per axis, to Morton codes [N]: bit 3 i + a is bit i along axis a."""
    bits = (((cell[:, a] >> i) & 1) << (3 * i + a) for i in range(POSITION_BITS) for a in range(3))
    return sum(bits, start=np.zeros(len(cell), np.int64))


def morton_cells(codes: Codes) -> Codes:
    """Deinterleave Morton codes [N, 1] to cells [N, 3]."""
    axes = [sum(((codes[:, 0] >> (3 * i + a)) & 1) << i for i in range(POSITION_BITS)) for a in range(3)]
    return np.stack(axes, axis=1)


def _grid_cells(means: npt.NDArray[np.float64], step: float) -> tuple[PositionGrid, float, Codes]:
    """Fit the grid to positions [N, 3]; returns it, its step, and the cells [N, 3]."""
    center = np.median(means, axis=0)
    scale = float(np.median(np.abs(means - center))) or 1.0
    bent = np.arcsinh((means - center) / scale)
    low = bent.min(axis=0)
    step = max(step, float((bent.max(axis=0) - low).max()) / (2**POSITION_BITS - 1))
    (x, y, z), (low_x, low_y, low_z) = center.tolist(), low.tolist()
    return PositionGrid((x, y, z), scale, (low_x, low_y, low_z)), step, np.rint((bent - low) / step).astype(np.int64)


def term_rows(span: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """List the rows of the terms of spans [N, 2], surfel after surfel."""
    first, count = span[:, 0], span[:, 1]
    start = np.cumsum(count) - count
    return np.repeat(first - start, count) + np.arange(int(count.sum()))


def quantised(values: npt.NDArray[np.float64], step: float) -> Codes:
    return np.rint(values / step).astype(np.int64)


def _coded(values: npt.NDArray[np.float64], parameter: Parameter) -> npt.NDArray[np.float64]:
    return (values if parameter.least is None else _sigmoid(values)).reshape(len(values), parameter.width)


def to_differences(rgb: Codes) -> Codes:
    """Convert channels (r, g, b repeated) to green, red - green, blue - green."""
    r, g, b = (rgb[:, i::3] for i in range(3))
    return np.stack([g, r - g, b - g], axis=2).reshape(rgb.shape)


def from_differences(differences: Codes) -> Codes:
    """Invert `to_differences`."""
    g, r, b = (differences[:, i::3] for i in range(3))
    return np.stack([r + g, g, b + g], axis=2).reshape(differences.shape)


def _sinh(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.sinh(np.clip(x, -50.0, 50.0))  # beyond all limits, and finite


def _sigmoid(x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return 1.0 / (1.0 + np.exp(-np.clip(x, -500.0, 500.0)))


def _logit(p: npt.NDArray[np.float64], least: float) -> npt.NDArray[np.float64]:
    p = np.clip(p, least, 1.0 - SMALLEST_SHARE)
    return np.log(p) - np.log1p(-p)


def _clip_to_limits(name: str, kind: str, values: npt.NDArray[np.float64]) -> Tensor:
    """Clip to the limits of a bundle, which rounding may exceed, as float32."""
    limit = np.array(limit_of(name, kind))
    return torch.from_numpy(np.clip(values, -limit, limit).astype(np.float32))
