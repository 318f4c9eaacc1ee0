"""A baked scene before it is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from bitymi_ns.bake.tiles import Tiles
from bitymi_ns.bake.view_colors import ColorChoices
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.poster import draw_poster
from bitymi_ns.bundle.read import Bundle
from bitymi_ns.bundle.statistics import AtlasCost, Statistics
from bitymi_ns.bundle.write import write_bundle
from bitymi_ns.codec.limits import RESIDUAL_LIMIT
from bitymi_ns.codec.packing import Packing, pack
from bitymi_ns.codec.pages import paged_texels, tile_means
from bitymi_ns.codec.quantise import EncodedAtlas, Range, choose_range, decode_pages, encode
from bitymi_ns.codec.texel_codes import SceneCodes, TexelCodes
from bitymi_ns.ops import TexelAlpha, TexelTiles
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera


class BakeableScene(Protocol):
    """The part of a scene that the bake uses."""

    surfels: Mapping[str, Tensor]
    field: Any  # a residual field, a `TexelField`, or None
    near: float
    config: Any  # weight_bound


@dataclass
class BakeState:
    """A baked scene, before it is written."""

    # the N kept surfels, on the CPU, without an atlas; view colours, where reduced, are lean
    # (`ops.view_color.LEAN`)
    scene: BakedScene
    rows: Tensor  # [N] int64, their rows in the scene
    packing: Packing  # layout of the tiles; shares memory with `scene.tiles`
    # [T, C] float32 before quantisation, in the order of `ops.TexelTiles`: residual colours and, where C = 4, alpha; a
    # surfel without a tile has one texel, its constant
    texels: Tensor
    atlas: EncodedAtlas | None  # the encoded atlas; None = no tiles, or not encoded yet
    options: BakeOptions  # options of the bake
    # surfels left out, sizes, and errors
    statistics: Statistics = field(default_factory=Statistics)
    codes: SceneCodes | None = None  # integer codes of the surfels, and of the texels once coded; None = not compact
    # [T, C] texels before coding; None = `texels`
    uncoded: Tensor | None = None
    alpha_codes: TexelCodes | None = None  # codes whose alphas and grades are reused; None = not coded, or opaque
    # [N] transmittance in front of the surfels, the weight of errors of their tiles; None = 1
    in_front: Tensor | None = None
    colors: ColorChoices | None = None  # view colours of fewer terms; None = they were not reduced
    # [T, 2] in pixels, the sums over views and fragments of w b and w^2 b, with blending weight w and bilinear weight
    # b; None = not measured yet
    coverage: Tensor | None = None

    @classmethod
    def of(
        cls, scene: BakeableScene, surfels: Mapping[str, Tensor], rows: Tensor, tiles: Tiles, options: BakeOptions
    ) -> BakeState:
        """Create from surfels (rows [N] of `scene`) and their tiles, not encoded. Raises ValueError: the atlas would be
        too large."""
        baked = BakedScene(
            {name: value.cpu() for name, value in surfels.items()},
            kind_of(scene.surfels),
            torch.zeros(0, 5, dtype=torch.int32),
            near=scene.near,
            weight_bound=scene.config.weight_bound,
        )
        return cls(baked, rows.cpu(), pack(()), tiles.texels, None, options).with_tiles(tiles)

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

    @property
    def sizes(self) -> Tensor:
        """[N, 2] int32 sides of the tiles; (0, 0) = none."""
        return torch.from_numpy(self.packing.tiles[:, 3:])

    @property
    def textured(self) -> bool:
        """True where any surfel has a tile."""
        return self.packing.texels > 0

    def with_constants(self, constants: Tensor) -> BakeState:
        """Replace tile means by [N, C], or by [N, 3] to keep mean alphas."""
        return replace(self, scene=with_means(self.scene, constants))

    @cached_property
    def alpha(self) -> TexelAlpha | None:
        """Opacities of the texels; None = opaque texels."""
        if self.texels.shape[1] == 3:
            return None
        tiles = TexelTiles.of_sizes(self.sizes.clamp(min=1), self.extent.float())
        return TexelAlpha(tiles, self.texels[:, 3].contiguous(), self.scene.weight_bound)

    def with_alpha(self, colors: Tensor) -> Tensor:
        """Append the alphas of the bake, if any, to residual colours [T, 3]: [T, C]."""
        return colors if self.alpha is None else joined(colors, self.alpha.values)

    def unquantised(self) -> BakedScene:
        """Make a renderable scene with texels as 32-bit floats."""
        if not self.textured:
            return self.scene
        pages = paged_texels(self.texels, self.packing)
        if pages.shape[3] == 4:
            return replace(self.scene, atlas=pages, alpha_scale=1.0)
        return replace(self.scene, atlas=torch.cat([pages, torch.ones_like(pages[..., :1])], -1))

    def stored(self) -> BakedScene:
        """Make a renderable scene with texels as stored in the bundle."""
        if self.atlas is None:
            return self.scene
        atlas = self.atlas
        pages = torch.from_numpy(decode_pages(atlas.payload, atlas.format, atlas.width, atlas.height))
        pages = pages if pages.dtype == torch.uint8 else pages.float()
        scaled = {"offset": atlas.range.offset, "scale": atlas.range.scale, "alpha_scale": atlas.alpha_scale}
        return replace(self.scene, atlas=pages, **scaled)

    def with_surfels(self, surfels: Mapping[str, Tensor]) -> BakeState:
        """Replace the parameters of the N surfels; their tiles stay."""
        given = {name: value.detach().cpu().contiguous() for name, value in surfels.items()}
        return replace(self, scene=replace(self.scene, surfels=given))

    def with_tiles(self, tiles: Tiles) -> BakeState:
        """Replace the tiles of the N surfels and lay them out; they are not encoded yet."""
        packing = pack(tiles.sizes, self.options.page_width, self.options.page_rows)
        scene = replace(self.scene, tiles=torch.from_numpy(packing.tiles), extent=tiles.extent)
        scene = with_means(scene, tile_means(tiles.texels, tiles.sizes))
        return replace(self, scene=scene, packing=packing, texels=tiles.texels, atlas=None, coverage=None)

    def only(self, kept: Tensor) -> BakeState:
        """Keep the surfels of a mask [N] and their tiles, laid out again, not encoded yet."""
        if bool(kept.all()):
            return self
        surfels = {name: value[kept] for name, value in self.scene.surfels.items()}
        listed = kept.repeat_interleave(self.sizes.long().clamp(min=1).prod(dim=1))
        in_front = None if self.in_front is None else self.in_front[kept]
        some = replace(self, scene=replace(self.scene, surfels=surfels), rows=self.rows[kept], in_front=in_front)
        return some.with_tiles(Tiles(self.sizes[kept], self.extent[kept], self.texels[listed]))

    def with_texels(self, texels: Tensor) -> BakeState:
        """Replace the texels by [T, C], or by [T, 3] to keep the alphas; they are not encoded yet."""
        texels = texels.detach().float().cpu()
        if texels.shape[-1] == 3:
            texels = self.with_alpha(texels)
        if not self.textured or texels.shape != self.texels.shape:
            raise ValueError(f"texels of shape {tuple(texels.shape)} do not fit the bake")
        statistics = self.statistics.replace(atlas=None, certificate=None)
        means = tile_means(texels, self.sizes)
        return replace(self.with_constants(means), texels=texels.contiguous(), atlas=None, statistics=statistics)

    def encoded(self, progress: Progress = no_progress) -> BakeState:
        """Quantise and encode the texels, unless encoded."""
        if not self.textured or self.atlas is not None:
            return self
        return self.with_atlas(encoded_texels(self.texels, self.packing, self.options, progress))

    def with_atlas(self, atlas: EncodedAtlas) -> BakeState:
        """Set the encoded atlas."""
        return replace(self, atlas=atlas, statistics=self.statistics.replace(atlas=atlas_cost(self.packing, atlas)))

    def with_texel_codes(self, codes: TexelCodes, uncoded: Tensor) -> BakeState:
        """Replace the residual colours by decoded `codes` of `uncoded` [T, 3]."""
        assert self.codes is not None
        alphas, options = codes.alphas(), replace(self.options, format="uint8")
        texels = codes.texels() if alphas is None else joined(codes.texels(), alphas)
        atlas = replace(encoded_texels(texels, self.packing, options), encoder="cosine transform")
        return replace(
            self.with_constants(codes.constants),
            texels=texels,
            atlas=atlas,
            statistics=self.statistics.replace(atlas=atlas_cost(self.packing, atlas), certificate=None),
            uncoded=uncoded,
            codes=replace(self.codes, texels=codes, residual=codes.residual, residual_step=codes.residual_step),
        )


def export(
    baked: BakeState,
    folder: str | Path,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    statistics: Mapping[str, Any] | None = None,
    first: Camera | None = None,
    **options: Any,
) -> Bundle:
    """Encode a baked scene, unless encoded, and write a bundle; returns and raises as `write_bundle`.

    Args:
        background: colour behind the surfels.
        statistics: added to those of the bake.
        first: camera of the poster, the one with which viewers start: the first held-out one of cameras.json, else its
            first; None = no poster.
    """
    baked = baked.encoded()
    return write_bundle(
        folder,
        with_means(baked.scene, baked.mean_residual.clamp(-RESIDUAL_LIMIT, RESIDUAL_LIMIT)),
        baked.atlas,
        baked.codes,
        background=background,
        statistics={**baked.statistics.model_dump(), **(statistics or {})},
        poster=None if first is None else draw_poster(baked.stored(), first, background),
        **options,
    )


def joined(colors: Tensor, alphas: Tensor) -> Tensor:
    """Join residual colours [n, 3] and alphas [n] to texels [n, 4]."""
    return torch.cat([colors, alphas[:, None]], 1)


def with_means(scene: BakedScene, constants: Tensor) -> BakedScene:
    """Replace the means of a scene's tiles by [N, 3] or, with alpha, [N, 4]."""
    if constants.shape[1] == 3:
        return replace(scene, mean_residual=constants)
    return replace(scene, mean_residual=constants[:, :3].contiguous(), mean_alpha=constants[:, 3].contiguous())


def encoded_texels(
    texels: Tensor,
    packing: Packing,
    options: BakeOptions,
    progress: Progress = no_progress,
    value_range: Range | None = None,
) -> EncodedAtlas:
    """Encode texels [T, C] in pages as the options say; the range of values is chosen if it is None."""
    if options.texel_format != "fp16" and value_range is None:
        sizes = torch.from_numpy(packing.tiles[:, 3:]).long()
        of_tiles = (sizes[:, 0] > 0).repeat_interleave(sizes.clamp(min=1).prod(dim=1))
        value_range = choose_range(texels[of_tiles].numpy(), options.range, options.range_samples, options.seed)
    pages = paged_texels(texels, packing).numpy()
    return encode(pages, packing, options.texel_format, value_range, options.bc7_profile, progress=progress)


def atlas_cost(packing: Packing, atlas: EncodedAtlas) -> AtlasCost:
    """Collect the bytes and the quantisation error of an encoded atlas."""
    return AtlasCost(
        bytes=atlas.nbytes,
        pages=(packing.layers, packing.height, packing.width),
        occupancy=packing.occupancy,
        psnr=atlas.psnr,
        clipped_fraction=atlas.clipped_fraction,
    )
