"""The bake: a trained scene in, surfels and an encoded atlas out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.bake.errors import tile_errors
from bitymi_ns.bake.evaluate import evaluate_tiles, tile_means
from bitymi_ns.bake.lean_color import centers_of, describe, reduce_view_color, view_color_errors
from bitymi_ns.bake.lean_field import lean_field
from bitymi_ns.bake.limits import within
from bitymi_ns.bake.options import BakeOptions
from bitymi_ns.bake.packing import Packing, pack
from bitymi_ns.bake.plan import Field, kernel_parameters, make_plan, paper_texels
from bitymi_ns.bake.quantise import EncodedAtlas, choose_range, decode_pages, encode
from bitymi_ns.bake.reduce import reduce_tiles
from bitymi_ns.bake.visibility import Visibility, visibility
from bitymi_ns.ops.constants import ALPHA_MIN
from bitymi_ns.ops.view_kinds import VIEW_COLORS, kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import HashField


class BakeableScene(Protocol):
    """The part of a scene that the bake uses."""

    surfels: Mapping[str, Tensor]
    field: Field | None
    near: float
    config: Any  # weight_bound, prefilter


@dataclass
class Baked:
    """A baked scene, before it is written.

    Attributes:
        scene: the surfels that are kept, N of them on the CPU, without an atlas; their view colours are lean
            (`ops.view_color.LEAN`) where they were reduced.
        rows: [N] int64, their rows in the scene.
        packing: where the tiles lie; `scene.tiles` are the same memory.
        texels: [layers, height, width, 3] float32 residual colours before quantisation, None without texture.
        atlas: the encoded atlas, None without texture.
        options: what it was baked with.
        statistics: what was left out, what it cost, and the error of the quantisation.
    """

    scene: BakedScene
    rows: Tensor
    packing: Packing
    texels: Tensor | None
    atlas: EncodedAtlas | None
    options: BakeOptions
    statistics: dict[str, Any] = field(default_factory=dict)

    @property
    def mean_residual(self) -> Tensor:
        """[N, 3] mean of every tile; the residual of a surfel without a tile."""
        assert self.scene.mean_residual is not None
        return self.scene.mean_residual

    @property
    def extent(self) -> Tensor:
        """[N] half side of every tile in scale units."""
        assert self.scene.extent is not None
        return self.scene.extent

    def with_mean_residual(self, mean_residual: Tensor) -> Baked:
        """The same bake with other means [N, 3]."""
        return replace(self, scene=replace(self.scene, mean_residual=mean_residual))

    def unquantised(self) -> BakedScene:
        """The scene with its texels as 32-bit floats."""
        if self.texels is None:
            return self.scene
        rgba = torch.cat([self.texels, torch.ones_like(self.texels[..., :1])], -1).contiguous()
        return replace(self.scene, atlas=rgba)

    def stored(self) -> BakedScene:
        """The scene with its texels as a bundle has them."""
        if self.atlas is None:
            return self.scene
        atlas = self.atlas
        pages = torch.from_numpy(decode_pages(atlas.payload, atlas.format, atlas.width, atlas.height))
        pages = pages if pages.dtype == torch.uint8 else pages.float()
        return replace(self.scene, atlas=pages, offset=atlas.range.offset, scale=atlas.range.scale)

    def with_texels(self, texels: Tensor, progress: Progress = no_progress) -> Baked:
        """The same bake with other residual colours (fine-tuned ones, say), quantised and encoded anew."""
        if self.texels is None or texels.shape != self.texels.shape:
            raise ValueError(f"texels of shape {tuple(texels.shape)} do not fit the bake")
        texels = texels.detach().float().cpu().contiguous()
        atlas = _encode(texels.numpy(), self.packing, self.options, progress)
        statistics = {**self.statistics, "atlas": _atlas_statistics(self.packing, atlas)}
        statistics.pop("error", None)  # the field is no longer what the texels are meant to hold
        tiled = torch.from_numpy(self.packing.tiles[:, 3:4] > 0)
        means = torch.where(tiled, tile_means(texels, self.packing), self.mean_residual)
        return replace(self.with_mean_residual(means), texels=texels, atlas=atlas, statistics=statistics)


@torch.no_grad()
def bake(
    scene: BakeableScene,
    cameras: Sequence[Camera] = (),
    options: BakeOptions | None = None,
    progress: Progress | None = None,
) -> Baked:
    """Bakes a scene's residual field into an atlas (paper, section Texture Baking).

    Surfels that can never be drawn (opacity below 1/255), rows that are not finite or beyond what a bundle holds
    (`limits.LIMITS`) and rotations of length zero are left out and counted; so are surfels that no training view
    blends. A scene without a field has no atlas and its tiles are zeros; nor has one whose tiles are all constant
    within the tolerance.

    Args:
        scene: a trained scene.
        cameras: training views, for the cap on tile sizes and for what they see; with none nothing is left out for it.
        options: see `BakeOptions`.
        progress: called after every chunk of work.

    Raises:
        ValueError: no surfel is left, an option is out of range, or the atlas would be too large.
    """
    options, progress = options or BakeOptions(), progress or no_progress
    options.check()
    started = time.perf_counter()
    kept, left_out = _drawable(scene.surfels)
    near = scene.near
    weight_bound = float(getattr(scene.config, "weight_bound", 0.0))
    prefilter = str(getattr(scene.config, "prefilter", "low_pass"))
    surfels = {name: value.detach()[kept].float() for name, value in scene.surfels.items()}
    drawable = surfels
    transmittance = views = None
    if cameras and options.looks_at_views:
        views = visibility(surfels, cameras, near, getattr(scene.config, "through_pixel", False), progress)
        if options.drop_unseen:
            seen = views.transmittance > 0
            left_out["unseen"] = int((~seen).sum())
            kept, views = kept[seen], views.of(seen)
            surfels = {name: value[seen] for name, value in surfels.items()}
        transmittance = views.in_front
    if len(kept) == 0:
        raise ValueError(f"no surfel is left to bake of {len(scene.surfels['means'])}: left out {left_out}")
    statistics: dict[str, Any] = {"surfels": {"trained": len(scene.surfels["means"]), "kept": len(kept)}}
    statistics["surfels"]["left_out"] = left_out

    packing = pack(np.zeros((len(kept), 2), dtype=np.int32))
    extent = torch.full((len(kept),), options.extent)
    mean_residual = torch.zeros(len(kept), 3)
    texels = atlas = None
    if scene.field is not None:
        field = scene.field
        paper = paper_texels(drawable, field, options)
        if options.tolerance > 0 and isinstance(field, HashField):
            field, statistics["field"] = lean_field(field, surfels, transmittance, weight_bound, options.tolerance)
        plan = make_plan(surfels, field, options, cameras, transmittance, near, weight_bound)
        if options.tolerance > 0:
            reduced = reduce_tiles(field, plan, options.tolerance, options.r_min, options.chunk, progress)
            packing, nonfinite = pack(reduced.sizes, options.page_width, options.page_rows), reduced.nonfinite
            texels, mean_residual = reduced.pages(packing), reduced.constant
            extent = torch.where(plan.extent > 0, plan.extent, extent.to(plan.extent)).cpu()
        else:
            packing = pack(plan.limit.cpu(), options.page_width, options.page_rows)
            geometry = (surfels["means"], surfels["quats"], surfels["log_scales"].exp())
            texels, nonfinite = evaluate_tiles(field, *geometry, packing, options.extent, options.chunk, progress)
        tiled = torch.from_numpy(packing.tiles[:, 3] > 0)
        statistics["surfels"]["without_tile"] = int((~tiled).sum())
        statistics["texels"] = {"paper": paper, **plan.texels, "kept": packing.texels, "not_finite": nonfinite}
        if tiled.any():
            mean_residual = torch.where(tiled[:, None], tile_means(texels, packing), mean_residual)
            atlas = _encode(texels.numpy(), packing, options, progress)
            statistics["atlas"] = _atlas_statistics(packing, atlas)
        else:
            texels = None
        stored = None if atlas is None else atlas.decoded()
        errors = tile_errors(field, plan, packing.tiles, mean_residual, stored, options.chunk, progress)
        statistics["error"] = {"tolerance": options.tolerance, **errors.summary()}
    kind = kind_of(surfels)
    if options.tolerance > 0:
        surfels, statistics["view_color"] = _lean_surfels(surfels, views, cameras, options.tolerance, progress)
    statistics["seconds"] = round(time.perf_counter() - started, 3)
    surfels = {name: value.cpu() for name, value in surfels.items()}
    baked = BakedScene(
        surfels,
        kind,
        torch.from_numpy(packing.tiles),
        extent=extent,
        mean_residual=mean_residual,
        near=near,
        weight_bound=weight_bound,
        prefilter=prefilter,
    )
    return Baked(baked, kept.cpu(), packing, texels, atlas, options, statistics)


def _lean_surfels(
    surfels: Mapping[str, Tensor],
    views: Visibility | None,
    cameras: Sequence[Camera],
    tolerance: float,
    progress: Progress = no_progress,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Surfels with lean view colours, and what was left out; see `lean_color.reduce_view_color`.

    Args:
        surfels: N rows.
        views: what the cameras see of them; None without cameras.
        cameras: training views.
        tolerance: 8-bit steps.
        progress: called after every chunk of work.
    """
    kind, means = kind_of(surfels), surfels["means"]
    seen = means.new_zeros(0, len(means), dtype=torch.bool) if views is None else views.seen
    opacity, _ = kernel_parameters(surfels, None if views is None else views.in_front)
    at = (seen, centers_of(cameras, means), opacity)
    lean = reduce_view_color(surfels, kind, *at, tolerance, progress)
    error = view_color_errors(kind, surfels, lean.parameters(), means, *at)
    kept = {name: value for name, value in surfels.items() if name not in VIEW_COLORS[kind].names}
    return kept | lean.parameters(), {"kind": kind, **describe(kind, surfels, lean, error, tolerance)}


def _drawable(surfels: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, int]]:
    """Rows that can be drawn, [N] int64, and how many were left out for which reason."""
    finite = torch.stack([torch.isfinite(value).flatten(1).all(1) for value in _as_rows(surfels)]).all(0)
    scales = surfels["log_scales"].exp()
    finite &= torch.isfinite(scales).all(1) & (scales > 0).all(1)
    turned = surfels["quats"].norm(dim=1)
    finite &= torch.isfinite(turned) & (turned > 1e-12)
    storable = finite & within(surfels, kind_of(surfels))
    transparent = storable & (surfels["opacity_logits"].sigmoid() < ALPHA_MIN)
    kept = torch.nonzero(storable & ~transparent).squeeze(1)
    counts = {"not_finite": ~finite, "beyond_limits": finite & ~storable, "transparent": transparent}
    return kept, {name: int(rows.sum()) for name, rows in counts.items()}


def _as_rows(surfels: Mapping[str, Tensor]) -> list[Tensor]:
    """Every parameter with at least two dimensions."""
    return [value.detach() if value.dim() > 1 else value.detach()[:, None] for value in surfels.values()]


def _encode(
    texels: npt.NDArray[np.float32], packing: Packing, options: BakeOptions, progress: Callable[[str, int, int], None]
) -> EncodedAtlas:
    value_range = None
    if options.format != "fp16":
        value_range = choose_range(texels, packing, options.range, options.range_samples, options.seed)
    return encode(texels, packing, options.format, value_range, options.bc7_profile, progress=progress)


def _atlas_statistics(packing: Packing, atlas: EncodedAtlas) -> dict[str, Any]:
    return {
        "bytes": atlas.nbytes,
        "pages": [packing.layers, packing.height, packing.width],
        "occupancy": packing.occupancy,
        "psnr": atlas.psnr,
        "clipped_fraction": atlas.clipped_fraction,
    }
