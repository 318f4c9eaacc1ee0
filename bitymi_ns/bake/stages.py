"""Stages of a bake: Trained, Reduced, for compact bundles Rounded, and Coded, which `export` writes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.poster import draw_poster
from bitymi_ns.bundle.read import Bundle
from bitymi_ns.bundle.statistics import AtlasCost, Statistics
from bitymi_ns.bundle.write import write_bundle
from bitymi_ns.codec.limits import RESIDUAL_LIMIT
from bitymi_ns.codec.packing import Packing, pack
from bitymi_ns.codec.pages import joined, listed_texels, paged_texels, tile_means
from bitymi_ns.codec.quantise import Atlas, EncodedAtlas, Range, choose_range, dequantised, encode, round_to_bytes
from bitymi_ns.codec.surfel_codes import Codes, SurfelCodes
from bitymi_ns.codec.texel_codes import RESIDUAL_STEP, SceneCodes, TexelCoder, TexelCodes, residual_codes
from bitymi_ns.ops import TexelAlpha, TexelTiles
from bitymi_ns.ops.parameters import Tensors
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera
from .tiles import Tiles
from .view_colors import ColorChoices

S = TypeVar("S", bound="Stage")


class BakeableScene(Protocol):
    """Provide what the bake uses of a scene."""

    @property
    def surfels(self) -> Tensors: ...

    field: Any  # a residual field, a `TexelField`, or None
    near: float
    config: Any  # weight_bound


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Surfels with tiles, on the CPU."""

    scene: BakedScene  # the N surfels; only a `Coded` one has an atlas
    rows: Tensor  # [N] int64, their rows in the trained scene
    packing: Packing  # shares memory with `scene.tiles`
    extent: Tensor  # [N] half sides of the tiles, scale units
    # [T, C] float32 before coding, in the order of `ops.TexelTiles`: residual colours and, where C = 4, alpha; one, its
    # constant, for a surfel without a tile
    texels: Tensor
    options: BakeOptions
    device: torch.device  # of the trained scene: does the work
    trained: int  # surfels of the scene
    left_out: Counter[str]  # those that are not here, by field of `LeftOut`
    texel_counts: Mapping[str, int]  # by field of `KeptTexels`; empty without texture
    statistics: Statistics = field(default_factory=Statistics)

    @property
    def sizes(self) -> Tensor:
        """[N, 2] int32 sides of the tiles; (0, 0) = none."""
        return torch.from_numpy(self.packing.tiles[:, 3:])

    @property
    def textured(self) -> bool:
        return self.packing.texels > 0

    @cached_property
    def alpha(self) -> TexelAlpha | None:
        """Opacities of the texels; None = opaque texels."""
        if self.texels.shape[1] == 3:
            return None
        tiles = TexelTiles.of_sizes(self.sizes.clamp(min=1), self.extent.float())
        return TexelAlpha(tiles, self.texels[:, 3].contiguous(), self.scene.weight_bound)

    def with_alpha(self, colors: Tensor) -> Tensor:
        """Append the alphas, if any, to residual colours [T, 3]: [T, C]."""
        return joined(colors, None if self.alpha is None else self.alpha.values)

    def unquantised(self) -> BakedScene:
        """Make a renderable scene with texels before coding."""
        if not self.textured:
            return self.scene
        pages = paged_texels(self.texels, self.packing)
        opaque = pages.shape[3] == 3
        pages = torch.cat([pages, torch.ones_like(pages[..., :1])], -1) if opaque else pages
        return replace(self.scene, atlas=pages, offset=0.0, scale=1.0, alpha_scale=0.0 if opaque else 1.0)

    def stating(self: S, **parts: Any) -> S:
        return replace(self, statistics=self.statistics.replace(**parts))

    def become(self, stage: type[S], **own: Any) -> S:
        """Go on to another stage; `own`: what differs, and what that stage adds."""
        return stage(**{part.name: getattr(self, part.name) for part in fields(Stage)} | own)


@dataclass(frozen=True, kw_only=True)
class Trained(Stage):
    """Surfels with whole view colours, and tiles as trained or read from a field."""

    def with_surfels(self, surfels: Mapping[str, Tensor]) -> Trained:
        given = {name: value.detach().cpu().contiguous() for name, value in surfels.items()}
        return replace(self, scene=replace(self.scene, surfels=given))

    def with_tiles(self, tiles: Tiles) -> Trained:
        return replace(self, **laid_out(self.scene, tiles, self.options))

    def with_colors(self, colors: Tensor) -> Trained:
        """Replace the residual colours by [T, 3]."""
        texels = self.with_alpha(colors.detach().float().cpu()).contiguous()
        return replace(self, texels=texels, scene=with_means(self.scene, tile_means(texels, self.sizes)))

    def only(self, kept: Tensor) -> Trained:
        """Keep the surfels of a mask [N], with their tiles."""
        if bool(kept.all()):
            return self
        surfels = {name: value[kept] for name, value in self.scene.surfels.items()}
        listed = kept.repeat_interleave(self.sizes.long().clamp(min=1).prod(dim=1))
        some = replace(self, scene=replace(self.scene, surfels=surfels), rows=self.rows[kept])
        return some.with_tiles(Tiles(self.sizes[kept], self.extent[kept], self.texels[listed]))


@dataclass(frozen=True, kw_only=True)
class Reduced(Stage):
    """Surfels that views show, with the smallest tiles and view colours within the tolerance."""

    in_front: Tensor  # [N] transmittance in front of the surfels
    colors: ColorChoices | None  # None = whole view colours, of a tolerance of 0

    def encoded(self, progress: Progress = no_progress) -> Coded:
        means = tile_means(self.texels, self.sizes)
        if not self.textured:
            return _coded(self, means)
        atlas = encoded_texels(self.texels, self.packing, self.options, progress)
        return _coded(self, means, (atlas, atlas.pages()))

    def coded(self, atlas: EncodedAtlas, colors: Tensor) -> Coded:
        """Store residual colours [T, 3] in pages that were encoded from them."""
        texels = self.with_alpha(colors)
        return _coded(replace(self, texels=texels), tile_means(texels, self.sizes), (atlas, atlas.pages()))


@dataclass(frozen=True, kw_only=True)
class Rounded(Stage):
    """Surfels rounded for a compact bundle, in its order."""

    in_front: Tensor  # as of `Reduced`
    codes: SurfelCodes  # of the surfels
    step: float  # of the texels (`TexelCoder`)
    most_bytes: int | None = None  # of texels, residuals and mean alphas: the step grows until they fit
    fill: bool = False  # the step also shrinks in fine-tuning, until nearly `most_bytes` are used
    alpha_codes: TexelCodes | None  # codes whose alphas and grades are kept; None = opaque
    coverage: Tensor  # [T, 2], see `TexelList.coverage`

    def encoded(self, progress: Progress = no_progress) -> Coded:
        """Code the texels, all with the same weight."""
        colors = self.texels[:, :3].contiguous()
        if not self.textured:
            return _coded(self, colors, codes=self._codes(None, residual_codes(colors), RESIDUAL_STEP))
        coder = TexelCoder(self.sizes, torch.ones(len(colors)), self.step, self.alpha_codes)
        most = self.most_bytes
        return self.coded(coder.code(colors) if most is None else coder.fit(colors, most), colors)

    def coded(self, texels: TexelCodes, colors: Tensor) -> Coded:
        """Store residual colours [T, 3] as their codes `texels`."""
        decoded = texels.decoded()
        rounded = round_to_bytes(decoded, self.packing, _range_of(decoded, self.packing, self.options))
        codes = self._codes(texels, texels.residual, texels.residual_step)
        return _coded(replace(self, texels=self.with_alpha(colors)), texels.means, rounded, codes)

    def _codes(self, texels: TexelCodes | None, residual: Codes, step: float) -> SceneCodes:
        return SceneCodes(self.codes, texels, residual, step, self.options.page_width, self.options.page_rows)


@dataclass(frozen=True, kw_only=True)
class Coded(Stage):
    """Texels as stored: `scene` is what a reader draws."""

    in_front: Tensor  # as of `Reduced`
    shown: Tensor  # [T, C] the stored texels, decoded
    atlas: Atlas | None  # None = no tiles
    codes: SceneCodes | None  # None = not a compact bundle


def _coded(
    stage: Reduced | Rounded, means: Tensor, stored: tuple[Atlas, Tensor] | None = None, codes: SceneCodes | None = None
) -> Coded:
    """Go on to `Coded` with means [N, C] of the tiles. `stored`: atlas and pages; None = no tiles."""
    own = {"in_front": stage.in_front, "codes": codes}
    scene = with_means(stage.scene, means.clamp(-RESIDUAL_LIMIT, RESIDUAL_LIMIT))
    if stored is None:
        return stage.become(Coded, scene=scene, atlas=None, shown=stage.texels, **own)
    atlas, pages = stored
    values = torch.from_numpy(dequantised(pages.numpy(), atlas.range, atlas.alpha_scale))
    shown = listed_texels(values, stage.packing, means)
    drawn = {"atlas": pages if pages.dtype == torch.uint8 else pages.float(), "alpha_scale": atlas.alpha_scale}
    scene = replace(scene, offset=atlas.range.offset, scale=atlas.range.scale, **drawn)
    cost = AtlasCost(
        bytes=atlas.nbytes if isinstance(atlas, EncodedAtlas) else None,
        pages=(atlas.layers, atlas.height, atlas.width),
        occupancy=stage.packing.occupancy,
        psnr=atlas.psnr,
        clipped_fraction=atlas.clipped_fraction,
    )
    return stage.become(Coded, scene=scene, atlas=atlas, shown=shown, **own).stating(atlas=cost)


def export(
    baked: Coded,
    folder: str | Path,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    statistics: Mapping[str, Any] | None = None,
    first: Camera | None = None,
    **options: Any,
) -> Bundle:
    """Write a bundle, as `write_bundle`. `statistics`: added to those of the bake. `first`: first camera of viewers,
    for the poster; None = no poster."""
    return write_bundle(
        folder,
        baked.scene,
        baked.atlas,
        baked.codes,
        background=background,
        statistics={**baked.statistics.model_dump(), **(statistics or {})},
        poster=None if first is None else draw_poster(baked.scene, first, background),
        **options,
    )


def with_means(scene: BakedScene, means: Tensor) -> BakedScene:
    """Replace the means of a scene's tiles by [N, 3] or, with alpha, [N, 4]."""
    alpha = means[:, 3].contiguous() if means.shape[1] == 4 else None
    return replace(scene, mean_residual=means[:, :3].contiguous(), mean_alpha=alpha)


def laid_out(scene: BakedScene, tiles: Tiles, options: BakeOptions) -> dict[str, Any]:
    """Lay out tiles: the fields of a `Stage` that follow."""
    packing = pack(tiles.sizes, options.page_width, options.page_rows)
    scene = replace(scene, tiles=torch.from_numpy(packing.tiles), extent=tiles.extent)
    scene = with_means(scene, tile_means(tiles.texels, tiles.sizes))
    return {"scene": scene, "packing": packing, "extent": tiles.extent, "texels": tiles.texels}


def encoded_texels(
    texels: Tensor,
    packing: Packing,
    options: BakeOptions,
    progress: Progress = no_progress,
    value_range: Range | None = None,
) -> EncodedAtlas:
    """Encode texels [T, C] in pages; the range of values is chosen if it is None."""
    if options.texel_format != "fp16" and value_range is None:
        value_range = _range_of(texels, packing, options)
    pages = paged_texels(texels, packing).numpy()
    return encode(pages, packing, options.texel_format, value_range, options.bc7_profile, progress=progress)


def _range_of(texels: Tensor, packing: Packing, options: BakeOptions) -> Range:
    return choose_range(texels.numpy()[packing.of_tiles], options.range, options.range_samples, options.seed)
