"""The bake: a trained scene in, surfels and an encoded atlas out, and the bundle they are written to."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.bake.bundle import World, write_bundle
from bitymi_ns.bake.evaluate import evaluate_tiles, tile_means
from bitymi_ns.bake.geometry import tangent_vectors
from bitymi_ns.bake.ktx2 import Format
from bitymi_ns.bake.packing import Packing, pack
from bitymi_ns.bake.progress import Progress, no_progress
from bitymi_ns.bake.quantise import BYTES_PER_TEXEL, EncodedAtlas, Profile, RangeRule, bc7_encoder, choose_range, encode
from bitymi_ns.bake.resolution import max_projected_extent, nyquist_resolution, voxel_along_axes
from bitymi_ns.scene.camera import Camera

OPACITY_FLOOR = 1.0 / 255.0  # below it a surfel is skipped at every pixel


class Field(Protocol):
    """The part of the residual field that the bake uses.

    A field that also has `geometry.mid`, the centre of its contraction, gets tiles that follow the direction in which
    its voxels are stretched; without it the smaller voxel edge holds for both axes.
    """

    def __call__(self, x: Tensor) -> Tensor:
        """[M, 3] world positions to [M, 3] residual colours."""

    def voxel_size(self, x: Tensor) -> Tensor:
        """[M, 3] world positions to [M, 2] finest voxel edges (radial, tangential), world units."""


class BakeableScene(Protocol):
    """The part of a scene that the bake uses."""

    surfels: Mapping[str, Tensor]
    field: Field | None
    config: Any  # near, weight_bound, prefilter


@dataclass
class BakeOptions:
    """How the trained field becomes an atlas."""

    format: Format = "bc7"
    """Texel format: bc7 = 1 byte a texel, uint8 = RGBA, 4 bytes, fp16 = RGBA half floats, 8 bytes."""
    bc7_profile: Profile = "veryfast"
    """Effort of the BC7 encoder; basic and slow gain about 0.3 dB at a quarter and a twelfth of the speed."""
    r_min: int = 4
    """Smallest tile side in texels, a power of two of at least 4."""
    r_max: int = 64
    """Largest tile side in texels, a power of two."""
    extent: float = 3.0
    """Half side of a tile in scale units (the paper's e); 3 covers exactly the kernel's support, the paper uses 4."""
    cap_by_views: bool = True
    """Give no tile more texels than pixels it covers in the training view that sees it largest."""
    drop_unseen: bool = False
    """Leave out surfels that no training view sees (where views are given); off: they get the smallest tile."""
    range: RangeRule = "sigma6"
    """Quantisation range: sigma6 = mean +- 6 standard deviations, minmax = no clipping, auto = the smaller error."""
    range_samples: int = 1 << 18
    """Texels in the bootstrap sample that the range is chosen from."""
    seed: int = 0
    """Seed of that sample."""
    page_width: int = 4096
    """Width of an atlas page in texels, a power of two; small atlases get a narrower page."""
    page_rows: int = 8192
    """Largest height of an atlas page; phones and WebGPU stop at 8192."""
    chunk: int = 1 << 18
    """Texels evaluated at once."""

    def check(self) -> None:
        """Refuses values that the bake would stumble over later."""
        if not self.extent > 0:
            raise ValueError(f"the extent must be positive, not {self.extent}")
        if self.format not in BYTES_PER_TEXEL:
            raise ValueError(f"the atlas format must be bc7, uint8 or fp16, not {self.format!r}")
        if self.format == "bc7":
            bc7_encoder(self.bc7_profile)


@dataclass
class Baked:
    """A baked scene, before it is written.

    Attributes:
        surfels: parameters of the surfels that are kept, N rows, CPU.
        rows: [N] int64, their rows in the scene.
        packing: where the tiles lie.
        texels: [layers, height, width, 3] float32 residual colours before quantisation, None without texture.
        extent: [N] half side of every tile in scale units.
        mean_residual: [N, 3] mean of every tile; the residual of a surfel without a tile.
        atlas: the encoded atlas, None without texture.
        near: nearest drawn depth.
        weight_bound: fragments of smaller blending weight get no residual.
        options: what it was baked with.
        statistics: what was left out, what it cost, and the error of the quantisation.
        prefilter: as the scene was drawn.
    """

    surfels: dict[str, Tensor]
    rows: Tensor
    packing: Packing
    extent: Tensor
    texels: Tensor | None
    mean_residual: Tensor
    atlas: EncodedAtlas | None
    near: float
    weight_bound: float
    options: BakeOptions
    statistics: dict[str, Any] = field(default_factory=dict)
    prefilter: str = "low_pass"

    def with_texels(self, texels: Tensor, progress: Progress = no_progress) -> Baked:
        """The same bake with other residual colours (fine-tuned ones, say), quantised and encoded anew."""
        if self.texels is None or texels.shape != self.texels.shape:
            raise ValueError(f"texels of shape {tuple(texels.shape)} do not fit the bake")
        texels = texels.detach().float().cpu().contiguous()
        atlas = _encode(texels.numpy(), self.packing, self.options, progress)
        statistics = {**self.statistics, "atlas": _atlas_statistics(self.packing, atlas)}
        tiled = torch.from_numpy(self.packing.tiles[:, 3:4] > 0)
        means = torch.where(tiled, tile_means(texels, self.packing), self.mean_residual)
        return replace(self, texels=texels, mean_residual=means, atlas=atlas, statistics=statistics)


@torch.no_grad()
def bake(
    scene: BakeableScene,
    cameras: Sequence[Camera] = (),
    options: BakeOptions | None = None,
    progress: Progress | None = None,
) -> Baked:
    """Bakes a scene's residual field into an atlas (paper, section Texture Baking).

    Surfels that can never be drawn (opacity below 1/255), rows that are not finite and rotations of length zero are
    left out and counted. A scene without a field has no atlas and its tiles are zeros.

    Args:
        scene: a trained scene.
        cameras: training views, for the cap on tile sizes; with none there is no cap.
        options: see `BakeOptions`.
        progress: called after every chunk of work.

    Raises:
        ValueError: no surfel is left, an option is out of range, or the atlas would be too large.
    """
    options, progress = options or BakeOptions(), progress or no_progress
    options.check()
    started = time.perf_counter()
    kept, left_out = _drawable(scene.surfels)
    near = float(getattr(scene.config, "near", 0.2))
    weight_bound = float(getattr(scene.config, "weight_bound", 0.0))
    surfels = {name: value.detach()[kept].float() for name, value in scene.surfels.items()}
    axes, scales = tangent_vectors(surfels["quats"]), surfels["log_scales"].exp()

    pixels = None
    if cameras and (options.cap_by_views or options.drop_unseen):
        pixels, views = max_projected_extent(surfels["means"], axes, scales, cameras, options.extent, near)
        seen = views > 0
        left_out["unseen"] = int((~seen).sum()) if options.drop_unseen else 0
        if options.drop_unseen:
            kept, pixels, axes, scales = kept[seen], pixels[seen], axes[seen], scales[seen]
            surfels = {name: value[seen] for name, value in surfels.items()}
    if len(kept) == 0:
        raise ValueError(f"no surfel is left to bake of {len(scene.surfels['means'])}: left out {left_out}")
    statistics: dict[str, Any] = {"surfels": {"trained": len(scene.surfels["means"]), "kept": len(kept)}}
    statistics["surfels"]["left_out"] = left_out

    if scene.field is None:
        sizes = np.zeros((len(kept), 2), dtype=np.int32)
        packing, texels, atlas = pack(sizes), None, None
        mean_residual = torch.zeros(len(kept), 3)
    else:
        means = surfels["means"]
        voxel = torch.cat([scene.field.voxel_size(part) for part in means.split(options.chunk)])
        delta = voxel_along_axes(voxel, axes, means, _center(scene.field))
        bounds = (options.extent, options.r_min, options.r_max)
        uncapped = nyquist_resolution(scales, delta, *bounds)
        capped = nyquist_resolution(scales, delta, *bounds, pixels) if options.cap_by_views else uncapped
        packing = pack(capped.cpu().numpy(), options.page_width, options.page_rows)
        texels, nonfinite = evaluate_tiles(
            scene.field, means, surfels["quats"], scales, packing, options.extent, options.chunk, progress
        )
        mean_residual = tile_means(texels, packing)
        atlas = _encode(texels.numpy(), packing, options, progress)
        statistics["atlas"] = _atlas_statistics(packing, atlas)
        statistics["texels"] = {
            "nyquist": int(uncapped.long().prod(1).sum()),
            "after_cap_by_views": int(capped.long().prod(1).sum()),
            "not_finite": nonfinite,
        }
    statistics["seconds"] = round(time.perf_counter() - started, 3)
    surfels = {name: value.cpu() for name, value in surfels.items()}
    extent = torch.full((len(kept),), options.extent)
    return Baked(
        surfels,
        kept.cpu(),
        packing,
        extent,
        texels,
        mean_residual,
        atlas,
        near,
        weight_bound,
        options,
        statistics,
        str(getattr(scene.config, "prefilter", "low_pass")),
    )


def export(
    baked: Baked,
    folder: str | Path,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    world: World | None = None,
    statistics: Mapping[str, Any] | None = None,
    extra_files: Mapping[str, bytes] | None = None,
    loose_files: Mapping[str, bytes] | None = None,
    overwrite: bool = False,
) -> Path:
    """Writes a baked scene as a bundle; see `write_bundle` for the arguments and errors.

    `statistics` is added to those of the bake.
    """
    return write_bundle(
        folder,
        baked.surfels,
        baked.packing.tiles,
        baked.atlas,
        extent=baked.extent,
        mean_residual=baked.mean_residual,
        near=baked.near,
        weight_bound=baked.weight_bound,
        prefilter=baked.prefilter,
        background=background,
        world=world,
        statistics={**baked.statistics, **(statistics or {})},
        extra_files=extra_files,
        loose_files=loose_files,
        overwrite=overwrite,
    )


def _center(field: Field) -> Tensor | None:
    """[3] centre of the field's contraction, world frame, if it tells."""
    geometry = getattr(field, "geometry", None)
    return None if geometry is None else torch.tensor(geometry.mid, dtype=torch.float32)


def _drawable(surfels: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, int]]:
    """Rows that can be drawn, [N] int64, and how many were left out for which reason."""
    finite = torch.stack([torch.isfinite(value).flatten(1).all(1) for value in _as_rows(surfels)]).all(0)
    scales = surfels["log_scales"].exp()
    finite &= torch.isfinite(scales).all(1) & (scales > 0).all(1)
    turned = surfels["quats"].norm(dim=1)
    finite &= torch.isfinite(turned) & (turned > 1e-12)
    transparent = finite & (surfels["opacity_logits"].sigmoid() < OPACITY_FLOOR)
    kept = torch.nonzero(finite & ~transparent).squeeze(1)
    return kept, {"not_finite": int((~finite).sum()), "transparent": int(transparent.sum())}


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
