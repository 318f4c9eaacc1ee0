"""Fit depth maps of the training photographs to the scene, and make initial points."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs

from bitymi_ns.capture.depth_normal_maps import Values, read_depth, read_normal
from bitymi_ns.capture.image_files import in_threads, read_image
from bitymi_ns.capture.lens import Lens
from bitymi_ns.capture.points import GREY
from bitymi_ns.ranges import spread
from ..console import say, warn
from .facts import KEY, CaptureFacts, DepthFit, FittedMaps

DepthKind = Literal["auto", "metric", "relative", "off"]
"""See `BitymiDataParserConfig.depth`."""
SIDE = 320  # longest side of compared maps, pixels
TOLERANCE = 0.05  # of depths of one surface, relative
FEW_PAIRS = 20  # fewest points in a photograph to fit its depth
AGREES = 0.25  # least share of agreeing points; hidden points disagree
AGREE_MUTUALLY = 0.45
"""Least ratio, for usable depth, of pixels that another photograph confirms to those that it confirms or sees through.
Measured: 0.95; with noise of 5 % 0.57; with the unit wrong by a factor of 0.001 to 1,000 at most 0.39."""
BETTER = 0.15  # least gain in agreement for relative depth
TRIALS = 200  # pairs of points for scale and shift
SEEN_BY = 16  # photographs compared with a new point
PIXELS_PER_POINT = 30  # pixels of training photographs per initial point
MOST_POINTS = 200_000  # initial points

Floats = npt.NDArray[np.float64]


class _Seen(NamedTuple):
    """Depth map, lens and pose: centre [3], rotation [3, 3] of OpenCV axes to world."""

    values: Values
    lens: Lens
    center: Floats
    rotation: Floats

    def fitted(self, fit: DepthFit) -> _Seen:
        """Replace the values by camera z in units of the scene."""
        return self._replace(values=fit.z(self.values))


def with_depth(
    outputs: DataparserOutputs, kind: DepthKind = "auto", unit: float | None = None, add_points: bool = True
) -> DataparserOutputs:
    """Fit depth maps of training views, downscaled to SIDE, to the scene, and add points from depth up to one per
    PIXELS_PER_POINT pixels. Raises InputError: a map cannot be read, or has another shape than its photograph."""
    facts = CaptureFacts.of(outputs.metadata)
    maps = facts.maps
    if kind == "off" or not maps:
        return outputs
    _check_normals(facts)
    rows = [i for i, files in enumerate(maps) if files.depth is not None]
    seen = _read_maps(outputs, facts, rows, unit)
    old = outputs.metadata.get("points3D_xyz", torch.zeros(0, 3))
    xyz = old.double().numpy()
    fits = _fits(seen, xyz[np.isfinite(xyz).all(1)], kind, float(outputs.dataparser_scale)) if rows else []
    fit_of = dict(zip(rows, fits, strict=True)) if fits is not None else {}
    fitted = [FittedMaps(files, fit_of.get(i), unit) for i, files in enumerate(maps)]
    metadata = {**outputs.metadata, KEY: dataclasses.replace(facts, fitted=fitted)}
    used = [(i, view.fitted(fit)) for i, view in zip(rows, seen, strict=True) if (fit := fit_of.get(i)) is not None]
    pixels = int((outputs.cameras.width.long() * outputs.cameras.height.long()).sum())
    count = min(MOST_POINTS, pixels // PIXELS_PER_POINT) - len(old) if add_points else 0
    new, rgb = _new_points([view for _, view in used], [outputs.image_filenames[i] for i, _ in used], count)
    if len(new):
        say(f"{len(new):,} initial points are added from depth.")
        own = outputs.metadata.get("points3D_rgb", torch.zeros(0, 3))
        own = own if len(own) == len(old) else torch.full((len(old), 3), GREY)
        metadata["points3D_xyz"] = torch.cat([old, torch.from_numpy(new.astype(np.float32))])
        metadata["points3D_rgb"] = torch.cat([own.to(torch.uint8), torch.from_numpy(rgb)])
    return dataclasses.replace(outputs, metadata=metadata)


def _read_maps(outputs: DataparserOutputs, facts: CaptureFacts, rows: Sequence[int], unit: float | None) -> list[_Seen]:
    lenses, maps = facts.lenses, facts.maps
    small = {lens: lens.downscaled(min(1.0, SIDE / max(lens.pinhole.width, lens.pinhole.height)))
             for lens in dict.fromkeys(lenses[i] for i in rows)}  # fmt: skip
    values = in_threads(lambda i: read_depth(maps[i], small[lenses[i]], unit), rows)
    poses = outputs.cameras.camera_to_worlds.double().numpy()
    return [_Seen(depth, small[lenses[i]], poses[i, :, 3], poses[i, :, :3] * (1.0, -1.0, -1.0))
            for i, depth in zip(rows, values, strict=True)]  # fmt: skip


def _check_normals(facts: CaptureFacts) -> None:
    rows = [i for i, files in enumerate(facts.maps) if files.normal is not None]
    for i in [rows[k] for k in spread(len(rows), 8)]:
        lens, files = facts.lenses[i], facts.maps[i]
        normal = read_normal(files, lens)
        away = ((normal * lens.pinhole.rays).sum(-1) > 0.0)[normal.any(-1)]
        if len(away) and away.mean() > 0.2:
            warn(
                f"{away.mean():.0%} of the normals of {files.normal} face away from the camera (x right, "
                "y up, z back): correct them, or train without: `bitymi-data --depth off`."
            )
            return


def _project(xyz: Floats, view: _Seen) -> tuple[npt.NDArray[np.intp], Floats, npt.NDArray[np.bool_]]:
    """Project points [N, 3]: pixel (flat index), camera z, whether in the picture."""
    to = view.lens.pinhole
    local = (xyz - view.center) @ view.rotation
    front = local[:, 2] > 0.0
    z = np.where(front, local[:, 2], 1.0)
    x = np.floor(to.fx * local[:, 0] / z + to.cx)
    y = np.floor(to.fy * local[:, 1] / z + to.cy)
    inside = front & (x >= 0) & (x < to.width) & (y >= 0) & (y < to.height)
    return np.where(inside, y * to.width + x, 0).astype(np.intp), z, inside


def _unproject(pixels: npt.NDArray[np.intp], view: _Seen) -> Floats:
    """Compute world positions [N, 3] of pixels of a fitted view."""
    to, z = view.lens.pinhole, view.values.ravel()[pixels]
    x = (pixels % to.width + 0.5 - to.cx) / to.fx
    y = (pixels // to.width + 0.5 - to.cy) / to.fy
    return np.stack([x * z, y * z, z], -1) @ view.rotation.T + view.center


def _fits(seen: Sequence[_Seen], xyz: Floats, kind: DepthKind, unit: float) -> Sequence[DepthFit | None] | None:
    """Fit each map to points [N, 3]; few = metric, of `unit` scene units per metre. None = unused."""
    if not any(view.values.any() for view in seen):
        warn("The depth maps have no valid pixel: depth is not used.")
        return None
    pairs = [_pairs(view, xyz) for view in seen]
    values, z = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    if len(z) < FEW_PAIRS:
        if kind == "relative":
            warn("Relative depth needs points of the scene in the pictures: depth is not used.")
            return None
        agreement = _agreement([view.fitted(DepthFit(unit)) for view in seen])
        if agreement is not None and agreement < AGREE_MUTUALLY:
            what = f"By the poses, the depth maps agree in {agreement:.0%} of their pixels"
            warn(f"{what}: depth is not used. Its unit may be another (`bitymi-data --depth-unit-scale-factor`).")
            return None
        say(f"Depth of {len(seen)} photographs is used as metric.")
        return [DepthFit(unit)] * len(seen)
    scale = _mode(z / values)
    metric, share = float((np.abs(scale * values / z - 1.0) < TOLERANCE).mean()), 0.0
    relative: list[DepthFit | None] = []
    if kind != "metric":
        for inverse in (False, True):
            fits = [_affine(*pair, inverse) for pair in pairs]
            mean = sum(agree * len(pair[0]) for (_, agree), pair in zip(fits, pairs, strict=True)) / len(z)
            if mean > share:
                relative, share = [fit for fit, _ in fits], mean
    use_relative = kind == "relative" or (kind == "auto" and share > metric + BETTER)
    if (share if use_relative else metric) < AGREES:
        how = "with scale and shift fitted to each" if use_relative else "with one scale for all"
        what = f"The depth maps agree with {max(share, metric):.0%} of the points, {how}"
        warn(f"{what}: depth is not used. They may be of other photographs, or not of camera z.")
        return None
    if use_relative:
        usable = [fit for fit in relative if fit is not None]
        how = "relative and inverse" if any(fit.inverse for fit in usable) else "relative"
        say(f"Depth of {len(usable)} of {len(seen)} photographs is {how}: scale and shift are fitted to the points.")
        return relative
    ratio = scale / unit
    other = "" if abs(ratio - 1.0) < 2 * TOLERANCE else f", times {ratio:.4g} by the points"
    say(f"Depth of {len(seen)} photographs is used as metric{other}.")
    return [DepthFit(scale)] * len(seen)


def _pairs(view: _Seen, xyz: Floats) -> tuple[Floats, Floats]:
    """Pair a map's values with camera z of the points in its picture."""
    pixels, z, inside = _project(xyz, view)
    values = view.values.ravel()[pixels]
    kept = inside & (values > 0.0)
    return values[kept].astype(np.float64), z[kept]


def _mode(ratios: Floats) -> float:
    """Find the most frequent ratio; occluded points have larger ones."""
    logs = np.sort(np.log(ratios))
    width = np.searchsorted(logs, logs + 2 * TOLERANCE) - np.arange(len(logs))
    start = int(width.argmax())
    return float(np.exp(np.median(logs[start : start + width[start]])))


def _affine(values: Floats, z: Floats, inverse: bool) -> tuple[DepthFit | None, float]:
    """Fit scale and shift of a map by the largest set of agreeing points; return it with their share."""
    if len(z) < FEW_PAIRS:
        return None, 0.0
    target = 1.0 / z if inverse else z
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(z), size=(2, TRIALS))
    step = values[second] - values[first]
    usable = np.abs(step) > 1e-3 * np.abs(values).max()
    if not usable.any():
        return None, 0.0
    scales = ((target[second] - target[first])[usable]) / step[usable]
    shifts = target[first][usable] - scales * values[first][usable]

    def agree(scale: npt.ArrayLike, shift: npt.ArrayLike) -> npt.NDArray[np.bool_]:
        fitted = np.multiply.outer(scale, values) + np.asarray(shift)[..., None]
        return np.abs(fitted / target - 1.0) < TOLERANCE

    best = int(agree(scales, shifts).sum(1).argmax())
    scale, shift = float(scales[best]), float(shifts[best])
    for _ in range(2):
        near = agree(scale, shift)
        if near.sum() < FEW_PAIRS // 2 or np.ptp(values[near]) == 0.0:
            break
        relative = 1.0 / target[near]  # the error counts as a share of the depth
        rows = np.stack([values[near] * relative, relative], 1)
        scale, shift = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0].tolist()
    share = float(agree(scale, shift).mean())
    return (DepthFit(scale, shift, inverse), share) if share >= AGREES else (None, share)


def _agreement(seen: Sequence[_Seen]) -> float | None:
    """Compute agreeing / (agreeing + seen through) votes of other views on sampled pixels; None = too few."""
    rng = np.random.default_rng(0)
    counts = np.zeros(3, np.int64)
    for i in spread(len(seen), SEEN_BY):
        known = np.flatnonzero(seen[i].values)
        pixels = rng.choice(known, min(len(known), 500), replace=False)
        counts += _votes(_unproject(pixels, seen[i]), i, seen).sum(1)
    agree, through, _ = counts.tolist()
    return agree / max(1, agree + through) if counts.sum() >= 50 else None


def _votes(xyz: Floats, own: int, seen: Sequence[_Seen]) -> npt.NDArray[np.int64]:
    """Count other fitted views that agree with, see through and occlude points [N, 3]: [3, N]."""
    votes = np.zeros((3, len(xyz)), np.int64)
    views = [j for j in range(len(seen)) if j != own]
    for j in (views[k] for k in spread(len(views), SEEN_BY)):
        pixels, z, inside = _project(xyz, seen[j])
        depth = seen[j].values.ravel()[pixels]
        known = inside & (depth > 0.0)
        behind = z / np.where(known, depth, 1.0) - 1.0
        votes += known & np.stack([np.abs(behind) < TOLERANCE, behind <= -TOLERANCE, behind >= TOLERANCE])
    return votes


def _new_points(seen: Sequence[_Seen], files: Sequence[Path], count: int) -> tuple[Floats, npt.NDArray[np.uint8]]:
    """Sample at most `count` points [N, 3] with colors [N, 3] from the maps, weighted by 1 / (number of views that show
    a point), without those that more views see through than agree with."""
    if count < 1 or not seen:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    rng = np.random.default_rng(0)
    known = [np.flatnonzero(view.values) for view in seen]
    total = sum(map(len, known))
    draws = [rng.choice(row, min(len(row), -(-4 * count * len(row) // total)), replace=False) for row in known]

    def of_view(i: int) -> tuple[Floats, npt.NDArray[np.uint8], Floats]:
        xyz = _unproject(draws[i], seen[i])
        agree, through, _ = _votes(xyz, i, seen)
        kept = agree >= through
        lens = seen[i].lens
        image = lens.undistort(read_image(files[i], lens.stored, lens.camera.size).convert("RGB"))
        return xyz[kept], np.asarray(image).reshape(-1, 3)[draws[i][kept]], 1.0 / (1.0 + agree[kept])

    xyz, rgb, weight = map(np.concatenate, zip(*in_threads(of_view, range(len(seen))), strict=True))
    if len(xyz) <= count:
        return xyz, rgb
    order = np.sort(np.argsort(rng.exponential(size=len(xyz)) / weight, kind="stable")[:count])
    return xyz[order], rgb[order]
