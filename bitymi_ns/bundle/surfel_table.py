"""Conversion between surfels and the columns of a PLY file.

The names of 3D Gaussian splatting come first, so that its viewers show a sensible colour: x y z, f_dc_0..2, opacity
(logit), scale_0..2 (log; scale_2 = -31, a flat disc), rot_0..3 (wxyz, unit). Then beta (raw), the view colour as
`<parameter>_<i>` in C order, the tile rectangle tile_x, tile_y, tile_layer, tile_ru, tile_rv, its half side in scale
units, tile_extent, and the mean residual residual_0..2. Texels with alphas add alpha, their mean. A surfel
without a tile is drawn with its means.

Reduced view colours (`ops.view_color.REDUCED`) have view_base_0..2 and view_terms (number of terms) instead; the terms,
surfel after surfel, are rows of a second element, `view_term`: term_0, term_1, ...
"""

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.codec.limits import ALPHA_LIMIT, EXTENTS, UNIT_SLACK, beyond, limit_of
from bitymi_ns.codec.surfel_codes import term_rows
from bitymi_ns.ops import view_color
from bitymi_ns.ops.constants import MAX_TERMS, SH_C0, SUPPORT
from bitymi_ns.ops.parameters import GEOMETRY_PARAMETERS
from bitymi_ns.ops.view_color import REDUCED, check_reduced
from bitymi_ns.ops.view_kinds import VIEW_COLORS, fibonacci_sphere, kind_of
from bitymi_ns.ply import PlyError
from bitymi_ns.scene.baked import BakedScene

FLAT_LOG_SCALE = -31.0
TILE_COLUMNS = ("tile_x", "tile_y", "tile_layer", "tile_ru", "tile_rv")
EXTENT_COLUMN = "tile_extent"
ALPHA_COLUMN = "alpha"
COUNT_COLUMN = "view_terms"
TERMS = "view_term"

# Columns of the parameters that are not named `<parameter>_<i>`.
COLUMNS: dict[str, tuple[str, ...]] = {
    **{name: parameter.columns for name, parameter in GEOMETRY_PARAMETERS.items() if parameter.columns},
    "mean_residual": ("residual_0", "residual_1", "residual_2"),
    "view_terms": tuple(f"term_{i}" for i in range(max(kind.reduced_width for kind in VIEW_COLORS.values()))),
}


def mean_view_color(surfels: Mapping[str, Tensor], kind: str | None = None) -> Tensor:
    """Average f_view over all directions, without the bias 0.5: [N, 3]. By the closed form of the kind, if there is
    one; else, and for reduced colours, which need `kind`, over 32 directions."""
    kind = kind or kind_of(surfels)
    entry = VIEW_COLORS[kind]
    if entry.mean is not None and "view_terms" not in surfels:
        return entry.mean(*entry.of(surfels))
    n, origin = len(surfels["means"]), torch.zeros(3, dtype=torch.float32)
    parts = [view_color(kind, surfels, d.expand(n, 3).contiguous(), origin) for d in fibonacci_sphere(32)]
    return torch.stack(parts).mean(0)


def to_columns(scene: BakedScene, has_alpha: bool = False) -> dict[str, npt.NDArray]:
    """Convert a scene to the columns of surfels.ply, without the terms of reduced view colours (`term_columns`). The
    colour that other viewers show includes the mean residuals."""
    kind, surfels, tiles = scene.view_color, scene.surfels, scene.tiles.numpy()
    reduced = "view_terms" in surfels
    surfels = {name: _plain(value) for name, value in surfels.items()}
    color = mean_view_color(surfels, kind)
    if scene.mean_residual is not None:
        color = color + scene.mean_residual
    color = color.nan_to_num(0.0).clamp(-0.5, 0.5) / SH_C0  # (mean colour - 0.5) / SH_C0
    quats = torch.nn.functional.normalize(surfels["quats"], dim=1)
    flat = torch.full((len(quats), 1), FLAT_LOG_SCALE, dtype=torch.float32)
    groups: dict[tuple[str, ...], Tensor] = {
        COLUMNS["means"]: surfels["means"],
        _numbered("f_dc", 3): color,
        ("opacity",): surfels["opacity_logits"][:, None],
        _numbered("scale", 3): torch.cat([surfels["log_scales"], flat], dim=1),
        COLUMNS["quats"]: quats,
    }
    for name in GEOMETRY_PARAMETERS:  # in the table's order, behind those of 3D Gaussian splatting
        if name not in ("means", "opacity_logits", "log_scales", "quats"):
            groups[COLUMNS[name]] = surfels[name].reshape(len(quats), -1)
    for name in ("view_base",) if reduced else VIEW_COLORS[kind].names:
        values = surfels[name].reshape(len(quats), int(np.prod(surfels[name].shape[1:])))
        groups[_numbered(name, values.shape[1])] = values
    columns = {name: values[:, i].numpy() for names, values in groups.items() for i, name in enumerate(names)}
    if reduced:
        columns[COUNT_COLUMN] = surfels["view_span"][:, 1].numpy()
    columns |= {name: tiles[:, i] for i, name in enumerate(TILE_COLUMNS)}
    if scene.extent is not None:
        columns[EXTENT_COLUMN] = _plain(scene.extent).numpy()
    if scene.mean_residual is not None:
        residual = _plain(scene.mean_residual).numpy()
        columns |= {name: residual[:, i] for i, name in enumerate(COLUMNS["mean_residual"])}
    if has_alpha and scene.mean_alpha is not None:
        columns[ALPHA_COLUMN] = _plain(scene.mean_alpha).numpy()
    return columns


def term_columns(surfels: Mapping[str, Tensor]) -> dict[str, npt.NDArray]:
    """Convert the terms of reduced view colours to columns, surfel after surfel: term_0, term_1, ...; [T] float32."""
    span = surfels["view_span"].long().cpu().numpy()  # spans may lie anywhere, the file has them in order
    ordered = surfels["view_terms"].detach().float().cpu().numpy()[term_rows(span)]
    return {name: ordered[:, i] for i, name in enumerate(_numbered("term", ordered.shape[1]))}


def check_range(
    name: str, values: Tensor, low: float, high: float, refuse: Callable[[str], Exception] = PlyError
) -> Tensor:
    """Return a column's values [N]. Raises `refuse`, naming the row: one is out of range."""
    bad = ~((values >= low) & (values <= high))
    if bad.any():
        row = int(torch.nonzero(bad)[0])
        raise refuse(f"{name} is {values[row]:g} in row {row}; it must be from {low:g} to {high:g}")
    return values


def check_limits(surfels: Mapping[str, Tensor], kind: str, refuse: Callable[[str], Exception] = PlyError) -> None:
    """Raise `refuse`, naming column and row, if a number is beyond its limit (`limits.LIMITS`). `surfels`: parameters
    by name, also mean_residual. `kind`: a name of `ops.VIEW_COLORS`."""
    for name, values in surfels.items():
        bad = beyond(name, kind, values)
        if bad.any():
            row, *inner = (int(i) for i in torch.nonzero(bad)[0])
            index = int(np.ravel_multi_index(inner, values.shape[1:])) if inner else 0
            largest = limit_of(name, kind)
            bound = largest[inner[-1] if len(largest) > 1 else 0]
            value = float(values[(row, *inner)])
            column = COLUMNS[name][index] if name in COLUMNS else f"{name}_{index}"
            raise refuse(f"{column} is {value:g} in row {row}; it must be from {-bound:g} to {bound:g}")


def from_columns(
    columns: Mapping[str, npt.NDArray],
    kind: str,
    terms: Mapping[str, npt.NDArray] | None = None,
    extent: float = SUPPORT,
    has_alpha: bool = False,
) -> dict[str, Any]:
    """Convert the columns of surfels.ply to surfels and tiles.

    Args:
        columns: of element `vertex`.
        kind: a name of `ops.VIEW_COLORS`.
        terms: columns of element `view_term`, for reduced view colours.
        extent: half side of the tiles in scale units if there is no column.
        has_alpha: require mean alphas.

    Returns fields of `BakedScene`, with unit quaternions. Raises PlyError: a column is missing or of the wrong type,
    the view colour has the wrong number of columns, or a value is beyond its limit."""
    if kind not in VIEW_COLORS:
        raise PlyError(f"the view colour {kind!r} is none of {sorted(VIEW_COLORS)}")
    tiles = _stack(columns, TILE_COLUMNS, np.int32)
    count = len(tiles)
    surfels = {
        name: _stack(columns, COLUMNS[name]).reshape(count, *parameter.shape)
        if parameter.absent is None or COLUMNS[name][0] in columns
        else torch.full((count, *parameter.shape), parameter.absent, dtype=torch.float32)
        for name, parameter in GEOMETRY_PARAMETERS.items()
    }
    if terms is not None:
        surfels |= _reduced_from_columns(columns, terms, kind)
    else:
        surfels |= _full_from_columns(columns, kind, count)
    check_limits(surfels, kind)
    turned = (surfels["quats"].norm(dim=1) - 1.0).abs() > UNIT_SLACK
    if turned.any():
        raise PlyError(f"rot_0 to rot_3 are not of length 1 in row {int(torch.nonzero(turned)[0])}")
    residual = torch.zeros(count, 3, dtype=torch.float32)
    if COLUMNS["mean_residual"][0] in columns:
        residual = _stack(columns, COLUMNS["mean_residual"])
        check_limits({"mean_residual": residual}, kind)
    extents = torch.full((count,), extent, dtype=torch.float32)
    if EXTENT_COLUMN in columns:
        extents = check_range(EXTENT_COLUMN, _stack(columns, (EXTENT_COLUMN,))[:, 0], *EXTENTS)
    alphas = None
    if has_alpha:
        alphas = check_range(ALPHA_COLUMN, _stack(columns, (ALPHA_COLUMN,))[:, 0], 0.0, ALPHA_LIMIT)
    return {
        "surfels": surfels,
        "tiles": tiles.contiguous(),
        "extent": extents,
        "mean_residual": residual,
        "mean_alpha": alphas,
    }


def _full_from_columns(columns: Mapping[str, npt.NDArray], kind: str, count: int) -> dict[str, Tensor]:
    entry, surfels = VIEW_COLORS[kind], {}
    for name, shape, width in ((p.name, p.shape, p.width) for p in entry.parameters):
        matches = map(re.compile(rf"{name}_([0-9]{{1,5}})").fullmatch, columns)
        numbers = sorted(int(match[1]) for match in matches if match)
        total = len(numbers)
        if numbers != list(range(total)) or total % width or (-1 not in shape and total != width):
            raise PlyError(f"the view colour needs {name}_0.. in groups of {width}, not {total} columns")
        values = _stack(columns, _numbered(name, total)) if total else torch.zeros(count, 0, dtype=torch.float32)
        surfels[name] = values.reshape(count, *(total // width if size < 0 else size for size in shape))
    if len({surfels[p.name].shape[1] for p in entry.parameters if -1 in p.shape}) != 1:
        raise PlyError(f"the parameters of {entry.title} disagree about the number of {entry.term}s")
    return surfels


def _reduced_from_columns(
    columns: Mapping[str, npt.NDArray], terms: Mapping[str, npt.NDArray], kind: str
) -> dict[str, Tensor]:
    names = _numbered("term", VIEW_COLORS[kind].reduced_width)
    if set(terms) != set(names):
        raise PlyError(f"the element {TERMS} needs the properties {names[0]} to {names[-1]}, not {sorted(terms)}")
    count = _stack(columns, (COUNT_COLUMN,), np.int32)[:, 0].long()
    if ((count < 0) | (count > MAX_TERMS)).any() or int(count.sum()) != len(terms[names[0]]):
        raise PlyError(f"{COUNT_COLUMN} does not count the {len(terms[names[0]])} rows of {TERMS}")
    span = torch.stack([count.cumsum(0) - count, count], dim=1).int()
    values = (_stack(columns, _numbered("view_base", 3)), span, _stack(terms, names))
    reduced: dict[str, Tensor] = dict(zip(REDUCED, values, strict=True))
    try:
        check_reduced(kind, reduced, len(count))
    except ValueError as error:
        raise PlyError(str(error)) from error
    return reduced


def _plain(value: Tensor) -> Tensor:
    value = value.detach().cpu()
    return value.float() if value.is_floating_point() else value


def _stack(columns: Mapping[str, npt.NDArray], names: tuple[str, ...], dtype: type = np.float32) -> Tensor:
    """Stack columns to [N, len(names)]. Raises PlyError: one is missing or of another type."""
    for name in names:
        if name not in columns:
            raise PlyError(f"the column {name} is missing")
        if columns[name].dtype != dtype:
            raise PlyError(f"the column {name} holds {columns[name].dtype}, not {np.dtype(dtype)}")
    return torch.from_numpy(np.stack([columns[name] for name in names], axis=1).astype(dtype, copy=False))


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}_{i}" for i in range(count))
