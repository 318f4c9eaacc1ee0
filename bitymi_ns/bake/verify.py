"""Checks of a bundle: that its files are whole, that they make sense, and that they hold what bundle.json states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bitymi_ns.bake.bundle import Bundle, BundleError, file_problem, read_bundle, read_manifest
from bitymi_ns.bake.errors import tile_errors
from bitymi_ns.bake.lean_color import centers_of, view_color_errors
from bitymi_ns.bake.manifest import MANIFEST
from bitymi_ns.bake.options import BakeOptions
from bitymi_ns.bake.plan import Field, kernel_parameters, make_plan
from bitymi_ns.bake.visibility import visibility
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import HashField

_SLACK = 1.02  # sums in another order, rotations that were written with length 1
_SLACK_STEPS = 0.02


@dataclass(frozen=True)
class Check:
    """One line of the result: what was looked at, whether it holds, and the numbers."""

    name: str
    ok: bool
    detail: str


def check_files(folder: str | Path) -> tuple[Bundle | None, list[Check]]:
    """Checks a bundle by itself: sizes and hashes of its files, their formats, its numbers, its tiles.

    Returns:
        the bundle, None when it cannot be read, and the checks in the order they were made.
    """
    folder = Path(folder)
    try:
        info = read_manifest(folder)
    except BundleError as error:
        return None, [Check(MANIFEST, False, str(error))]
    checks = [Check(MANIFEST, True, f"version {info['version']}, by {info.get('generator', 'an unnamed program')}")]
    for name, entry in info["files"].items():
        problem = file_problem(folder / name, entry)
        checks.append(Check(name, problem is None, problem or f"{entry['bytes']:,} bytes, sha256 as stated"))
    if not all(check.ok for check in checks):
        return None, checks
    try:
        bundle = read_bundle(folder, verify=False)
    except BundleError as error:
        return None, [*checks, Check("contents", False, str(error))]
    checks.append(Check("contents", True, f"{len(bundle):,} surfels, all numbers finite, tiles inside the atlas"))
    return bundle, [*checks, _tiles(bundle), _statements(bundle)]


def check_field(bundle: Bundle, field: Field, cameras: Sequence[Camera]) -> Check:
    """Measures the stored tiles against the field anew, and compares with the error that bundle.json states.

    Args:
        bundle: what `check_files` read.
        field: the residual field of the scene that was baked.
        cameras: its training views.
    """
    stated = bundle.info["statistics"].get("error")
    if stated is None:
        return Check("error against the field", True, "not stated: the texels were changed after the bake")
    levels = bundle.info["statistics"].get("field")
    if levels is not None and isinstance(field, HashField):
        field = field.only(*levels["kept"])
    options = bake_options(bundle)
    render = bundle.info["render"]
    near, weight_bound = float(render["near"]), float(render["weight_bound"])
    transmittance = None
    if cameras and options.looks_at_views:
        seen = visibility(bundle.surfels, cameras, near, render.get("prefilter", "low_pass"))
        transmittance = seen.in_front
    plan = make_plan(bundle.surfels, field, options, cameras, transmittance, near, weight_bound)
    tiled = bundle.tiles[:, 3] > 0
    plan.extent = torch.where(tiled, bundle.extent, plan.extent)
    residuals = None if bundle.atlas is None else bundle.residuals().numpy()
    found = tile_errors(field, plan, bundle.tiles.numpy(), bundle.mean_residual, residuals).summary()
    lines, ok = [], True
    for name in ("rms", "largest"):
        bound, measured = float(stated[name]["p100"]), found[name]["p100"]
        ok &= measured <= bound * _SLACK + _SLACK_STEPS
        lines.append(f"{name} {measured:.3f} (stated {bound:.3f})")
    return Check("error against the field", ok, ", ".join(lines) + " steps")


def check_view_color(bundle: Bundle, surfels: Mapping[str, Tensor], cameras: Sequence[Camera]) -> Check:
    """Measures lean view colours against the trained ones anew, and compares with the error that bundle.json states.

    Args:
        bundle: what `check_files` read.
        surfels: per-surfel parameters of the scene that was baked; a surfel of the bundle is found by its geometry.
        cameras: its training views.
    """
    name = "error of the view colours"
    if "view_terms" not in bundle.surfels:
        return Check(name, True, "none: all of them are kept")
    stated = bundle.info["statistics"].get("view_color")
    if stated is None:
        return Check(name, True, "not stated")
    trained = {name: value.detach().float().cpu() for name, value in surfels.items()}
    places = {key: row for row, key in enumerate(_keys(trained))}
    rows = [places.get(key) for key in _keys(bundle.surfels)]
    if None in rows:
        return Check(name, False, f"surfel {rows.index(None)} is none of the trained scene")
    trained = {name: value[torch.tensor(rows)] for name, value in trained.items()}
    means, render = bundle.surfels["means"], bundle.info["render"]
    seen, transmittance = means.new_zeros(0, len(means), dtype=torch.bool), None
    if cameras:
        views = visibility(trained, cameras, float(render["near"]), render.get("prefilter", "low_pass"))
        seen, transmittance = views.seen, views.in_front
    opacity, _ = kernel_parameters(trained, transmittance)
    at = (means, seen, centers_of(cameras, means), opacity)
    found = float(view_color_errors(bundle.view_color, trained, bundle.surfels, *at).amax())
    bound, tolerance = float(stated["error"]["p100"]), float(stated["tolerance"])
    ok = found <= bound * _SLACK + _SLACK_STEPS
    return Check(name, ok, f"largest {found:.3f} (stated {bound:.3f}, tolerance {tolerance:g}) steps")


def _keys(surfels: Mapping[str, Tensor]) -> list[bytes]:
    """The numbers of every surfel that a bundle holds bit for bit."""
    parts = [surfels["means"], surfels["log_scales"], surfels["opacity_logits"][:, None], surfels["beta_raw"][:, None]]
    return [row.tobytes() for row in torch.cat(parts, dim=1).numpy()]


def bake_options(bundle: Bundle) -> BakeOptions:
    """The options that a bundle was baked with, as far as it states them."""
    stated = bundle.info["statistics"].get("options", {})
    return BakeOptions(**{f.name: stated[f.name] for f in fields(BakeOptions) if f.name in stated})


def _tiles(bundle: Bundle) -> Check:
    """Sides are powers of two on the grid of 4 x 4 blocks, no texel belongs to two tiles, extents are in range."""
    tiled = bundle.tiles[bundle.tiles[:, 3] > 0].long()
    if len(tiled) == 0:
        return Check("tiles", True, "none")
    sides = tiled[:, 3:]
    if ((sides & (sides - 1)) != 0).any() or (tiled[:, [0, 1, 3, 4]] % 4 != 0).any():
        return Check("tiles", False, "a tile is not a power of two on the grid of 4 x 4 blocks")
    if not torch.isfinite(bundle.extent).all() or (bundle.extent > 16.0).any():
        return Check("tiles", False, "a tile's extent is out of range")
    blocks = int((sides // 4).prod(1).sum())
    owned = _blocks(tiled, bundle.atlas)
    if int((owned > 0).sum()) != blocks:
        return Check("tiles", False, f"{blocks - int((owned > 0).sum()):,} blocks belong to more than one tile")
    return Check("tiles", True, f"{len(tiled):,} of {len(bundle):,} surfels, {16 * blocks:,} texels, no two overlap")


def _blocks(tiles: Tensor, atlas: Tensor | None) -> Tensor:
    """How many tiles every 4 x 4 block belongs to, [layers, height / 4, width / 4], from differences at the corners."""
    layers, height, width = (1, 4, 4) if atlas is None else atlas.shape[:3]
    counts = torch.zeros(layers, height // 4 + 1, width // 4 + 1, dtype=torch.int32)
    x, y, layer, r_u, r_v = tiles.unbind(1)
    one = torch.ones(len(tiles), dtype=torch.int32)
    for dx, dy, sign in ((0, 0, 1), (1, 0, -1), (0, 1, -1), (1, 1, 1)):
        counts.index_put_((layer, (y + dy * r_v) // 4, (x + dx * r_u) // 4), sign * one, accumulate=True)
    return counts.cumsum(1).cumsum(2)[:, :-1, :-1]


def _statements(bundle: Bundle) -> Check:
    """What bundle.json states about the bake agrees with the files."""
    statistics: dict[str, Any] = bundle.info["statistics"]
    tiled = bundle.tiles[:, 3] > 0
    found = {"surfels kept": len(bundle), "texels kept": int(bundle.tiles[:, 3:].long().prod(1).sum())}
    stated = {
        "surfels kept": statistics.get("surfels", {}).get("kept"),
        "texels kept": statistics.get("texels", {}).get("kept"),
        "surfels without_tile": statistics.get("surfels", {}).get("without_tile"),
    }
    found["surfels without_tile"] = int((~tiled).sum())
    lean = statistics.get("view_color")
    if lean is not None and "view_terms" in bundle.surfels:
        stated |= {"view colour sites": lean["sites"]["after"], "surfels of one colour": lean["one_color"]}
        found["view colour sites"] = len(bundle) + len(bundle.surfels["view_terms"])
        found["surfels of one colour"] = int((bundle.surfels["view_span"][:, 1] == 0).sum())
    for name, value in stated.items():
        if value is not None and value != found[name]:
            return Check("statistics", False, f"{name}: {value:,} stated, {found[name]:,} found")
    error = statistics.get("error")
    detail = "agree with the files"
    if error is not None:
        detail += f"; error of a tile at most {error['rms']['p100']:.3f} steps, tolerance {error['tolerance']}"
    if lean is not None:
        detail += f"; of a view colour at most {lean['error']['p100']:.3f}, tolerance {lean['tolerance']:g}"
    return Check("statistics", True, detail)
