"""The bake: a trained scene in, surfels and an encoded atlas out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from bitymi_ns.bake.errors import tile_errors
from bitymi_ns.bake.field.plan import Field, paper_texels
from bitymi_ns.bake.inputs import BakeInput, device_of, drawable
from bitymi_ns.bake.methods import BakeMethod, FineBake, Tiles, bake_method, reduced_tiles
from bitymi_ns.bake.photo_resolution import photographed
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import AtlasCost, KeptSurfels, Statistics
from bitymi_ns.codec.packing import Packing, pack
from bitymi_ns.codec.pages import moved_texels, paged_texels, tile_means
from bitymi_ns.codec.quantise import EncodedAtlas, Range, choose_range, decode_pages, encode
from bitymi_ns.codec.texel_codes import SceneCodes, TexelCodes
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera


class BakeableScene(Protocol):
    """The part of a scene that the bake uses."""

    surfels: Mapping[str, Tensor]
    field: Field | None
    near: float
    config: Any  # weight_bound, prefilter, through_pixel


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
        uncoded: [T, 3] the texels of which the codes were made, in the order of `ops.TexelTiles`; None = `texels`.
        in_front: [N] transmittance in front of the surfels, by which errors of their tiles count; None = 1.
        codes: the integers that the surfels, and once they are coded the texels, stand for; None = they are stored as
            they are.
        statistics: what was left out, what it cost, and the error of the quantisation.
    """

    scene: BakedScene
    rows: Tensor
    packing: Packing
    texels: Tensor | None
    atlas: EncodedAtlas | None
    options: BakeOptions
    statistics: Statistics = field(default_factory=Statistics)
    codes: SceneCodes | None = None
    uncoded: Tensor | None = None
    in_front: Tensor | None = None

    def with_statistics(self, **changes: Any) -> Baked:
        """The same bake with other statistics."""
        return replace(self, statistics=self.statistics.but(**changes))

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

    @property
    def tiles(self) -> Tiles:
        """Of every surfel."""
        return Tiles(self.packing, self.texels, self.extent, self.mean_residual)

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

    def with_surfels(self, surfels: Mapping[str, Tensor]) -> Baked:
        """The same bake with other parameters of its N surfels; tiles and texels are as they are."""
        given = {name: value.detach().cpu().contiguous() for name, value in surfels.items()}
        return replace(self, scene=replace(self.scene, surfels=given))

    def with_tiles(self, tiles: Tiles) -> Baked:
        """The same bake with other tiles of its N surfels. The atlas is to be `encoded`."""
        scene = replace(
            self.scene,
            tiles=torch.from_numpy(tiles.packing.tiles),
            extent=tiles.extent,
            mean_residual=tiles.mean_residual,
        )
        return replace(self, scene=scene, packing=tiles.packing, texels=tiles.texels, atlas=None)

    def only(self, kept: Tensor) -> Baked:
        """The bake of some of its surfels, `kept` [N] bool: their tiles, packed anew, with their texels. The atlas is
        to be `encoded`."""
        if bool(kept.all()):
            return self
        surfels = {name: value[kept] for name, value in self.scene.surfels.items()}
        packing = pack(torch.from_numpy(self.packing.tiles)[kept, 3:], self.options.page_width, self.options.page_rows)
        texels = None
        if self.texels is not None and packing.texels:
            texels = moved_texels(self.texels, torch.from_numpy(self.packing.tiles)[kept], packing)
        in_front = None if self.in_front is None else self.in_front[kept]
        some = replace(self, scene=replace(self.scene, surfels=surfels), rows=self.rows[kept], in_front=in_front)
        return some.with_tiles(Tiles(packing, texels, self.extent[kept], self.mean_residual[kept]))

    def with_texels(self, texels: Tensor) -> Baked:
        """The same bake with other residual colours (fine-tuned ones, say), to be `encoded`."""
        if self.texels is None or texels.shape != self.texels.shape:
            raise ValueError(f"texels of shape {tuple(texels.shape)} do not fit the bake")
        texels = texels.detach().float().cpu().contiguous()
        means = tile_means(texels, self.packing, self.mean_residual)
        # no error: the field is no longer what the texels are meant to hold
        statistics = self.statistics.but(atlas=None, error=None, certificate=None)
        return replace(self.with_mean_residual(means), texels=texels, atlas=None, statistics=statistics)

    def encoded(self, progress: Progress = no_progress) -> Baked:
        """The same bake with its texels quantised and encoded, where that is not done."""
        if self.texels is None or self.atlas is not None:
            return self
        return self.with_atlas(encoded_pages(self.texels, self.packing, self.options, progress))

    def with_atlas(self, atlas: EncodedAtlas) -> Baked:
        """The same bake with its texels as they are encoded."""
        return replace(self, atlas=atlas, statistics=self.statistics.but(atlas=_cost(self.packing, atlas)))

    def with_texel_codes(self, codes: TexelCodes, uncoded: Tensor) -> Baked:
        """The same bake with the residual colours of codes, which are those of its tiles, and were made of `uncoded`
        [T, 3]."""
        assert self.codes is not None
        texels = paged_texels(codes.texels(), self.packing)
        value_range = choose_range(
            texels.numpy(), self.packing, self.options.range, self.options.range_samples, self.options.seed
        )
        atlas = replace(encode(texels.numpy(), self.packing, "uint8", value_range), encoder="cosine transform")
        return replace(
            self.with_mean_residual(codes.constants),
            texels=texels,
            atlas=atlas,
            statistics=self.statistics.but(atlas=_cost(self.packing, atlas), error=None, certificate=None),
            uncoded=uncoded,
            codes=replace(self.codes, texels=codes, residual=codes.residual, residual_step=codes.residual_step),
        )


@torch.no_grad()
def bake(
    scene: BakeableScene,
    cameras: Sequence[Camera] = (),
    options: BakeOptions | None = None,
    progress: Progress | None = None,
    pixels_per_texel: float | None = None,
) -> Baked:
    """Bakes a scene's residual field into an atlas (paper, section Texture Baking).

    Left out and counted are surfels that can never be drawn (opacity below 1/255), rows that are not finite or beyond
    what a bundle holds (`limits.LIMITS`), rotations of length zero, and surfels that no training view blends. A scene
    without a field has no atlas. There is none, either, where all tiles are constant within the tolerance.

    Args:
        scene: a trained scene.
        cameras: training views, for the cap on tile sizes and for what they see; with none nothing is left out for it.
        options: see `BakeOptions`.
        progress: called after every chunk of work.
        pixels_per_texel: for a bake of which texels and surfels are going to learn: tiles get as many texels as the
            views can tell apart (`methods.FineBake`), and are not encoded; view colours stay whole. `reduced` does then
            what the options say. None = as the options say at once.

    Raises:
        ValueError: no surfel is left, an option is out of range, or the atlas would be too large.
    """
    options, progress = options or BakeOptions(), progress or no_progress
    options.check()
    started = time.perf_counter()
    method = bake_method(options) if pixels_per_texel is None else FineBake(options, pixels_per_texel)
    rows, left_out = drawable(scene.surfels)
    candidates = _inputs(scene, rows, cameras)
    inputs, seen = _looked_at(candidates, options, progress)
    if seen is not None:
        left_out, rows = left_out.but(unseen=int((~seen).sum())), rows[seen]
    trained = len(scene.surfels["means"])
    if len(rows) == 0:
        raise ValueError(f"no surfel is left to bake of {trained}: left out {left_out.model_dump()}")
    statistics = Statistics(surfels=KeptSurfels(trained=trained, kept=len(rows), left_out=left_out))
    field = scene.field
    if field is None:
        tiles, atlas = Tiles.none(len(rows), options.extent), None
    else:
        paper = paper_texels(candidates.surfels, field, options)
        tiles, atlas, statistics = _textured(method, field, inputs, paper, statistics, options, progress)
    surfels, view_color = method.view_color(inputs, progress)
    baked = BakedScene(
        {name: value.cpu() for name, value in surfels.items()},
        kind_of(scene.surfels),
        torch.from_numpy(tiles.packing.tiles),
        extent=tiles.extent,
        mean_residual=tiles.mean_residual,
        near=inputs.near,
        weight_bound=inputs.weight_bound,
        prefilter=getattr(scene.config, "prefilter", "low_pass"),
        photographed=photographed(inputs),
    )
    statistics = statistics.but(view_color=view_color, seconds=round(time.perf_counter() - started, 3))
    in_front = None if inputs.transmittance is None else inputs.transmittance.cpu()
    return Baked(baked, rows.cpu(), tiles.packing, tiles.texels, atlas, options, statistics, in_front=in_front)


@torch.no_grad()
def reduced(baked: Baked, cameras: Sequence[Camera], progress: Progress = no_progress) -> Baked:
    """A bake whose texels and surfels have learned, with tiles and view colours reduced as its options say.

    Left out and counted are surfels that cannot be drawn any more, that a bundle cannot hold, or that no view blends.
    The atlas is to be `encoded`.

    Args:
        baked: made with `pixels_per_texel`, or `learned`.
        cameras: training views; their device does the work.

    Raises:
        ValueError: no surfel is left.
    """
    rows, gone = drawable(baked.scene.surfels)
    kept = torch.zeros(len(baked.rows), dtype=torch.bool)
    kept[rows] = True
    scene, options, device = baked.scene, baked.options, device_of(cameras)
    surfels = {name: value[rows].to(device) for name, value in scene.surfels.items()}
    inputs = BakeInput(surfels, cameras, scene.near, scene.weight_bound, scene.through_pixel)
    inputs, seen = _looked_at(inputs, options, progress)
    if seen is not None:
        gone = gone.but(unseen=int((~seen).sum()))
        kept[rows] = seen.cpu()
    if not bool(kept.any()):
        raise ValueError("no surfel is left to bake")
    lean, view_color = bake_method(options).view_color(inputs, progress)
    result = baked.only(kept)
    if options.tolerance > 0 and result.texels is not None:
        result = result.with_tiles(reduced_tiles(result.tiles, inputs, options, progress))
    in_front = None if inputs.transmittance is None else inputs.transmittance.cpu()
    result = replace(result.with_surfels(lean), in_front=in_front)
    result = replace(result, scene=replace(result.scene, photographed=photographed(inputs)))
    counts = baked.statistics.surfels
    assert counts is not None and counts.left_out is not None
    left_out = counts.left_out.but(**{name: (getattr(counts.left_out, name) or 0) + n for name, n in gone if n})
    statistics = baked.statistics.but(
        surfels=counts.but(
            kept=len(result.rows), left_out=left_out, without_tile=int((result.packing.tiles[:, 3] == 0).sum())
        ),
        view_color=view_color,
    )
    if statistics.texels is not None:
        statistics = statistics.but(texels=statistics.texels.but(kept=result.packing.texels))
    if result.texels is None:
        statistics = statistics.but(atlas=None)
    return replace(result, statistics=statistics)


def _looked_at(inputs: BakeInput, options: BakeOptions, progress: Progress) -> tuple[BakeInput, Tensor | None]:
    """The input with what the views see; and of which surfels [N] bool that is, None = of all, whether seen or not."""
    inputs = inputs.looked_at(options, progress)
    if inputs.views is None or not options.drop_unseen:
        return inputs, None
    seen = inputs.views.transmittance > 0
    return inputs.of(seen), seen


def _inputs(scene: BakeableScene, rows: Tensor, cameras: Sequence[Camera]) -> BakeInput:
    surfels = {name: value.detach()[rows].float() for name, value in scene.surfels.items()}
    weight_bound = float(getattr(scene.config, "weight_bound", 0.0))
    return BakeInput(surfels, cameras, scene.near, weight_bound, getattr(scene.config, "through_pixel", False))


def _textured(
    method: BakeMethod,
    field: Field,
    inputs: BakeInput,
    paper: int,
    statistics: Statistics,
    options: BakeOptions,
    progress: Progress,
) -> tuple[Tiles, EncodedAtlas | None, Statistics]:
    """The tiles of a scene with a field, their atlas where any surfel needs a tile, and what that saved and cost.

    Args:
        paper: texels that the paper's rule gives.
        statistics: with the numbers of surfels.
    """
    field, levels = method.field(field, inputs)
    plan = method.plan(field, inputs)
    tiles = method.tiles(field, plan, inputs, progress)
    packing = tiles.packing
    atlas = error = certificate = None
    counts = plan.texels if method.final else plan.texels.but(polished=packing.texels)
    if method.final:
        atlas = None if tiles.texels is None else encoded_pages(tiles.texels, packing, options, progress)
        stored = None if atlas is None else atlas.decoded()
        errors = tile_errors(field, plan, packing.tiles, tiles.mean_residual, stored, options.chunk, progress)
        error, certificate = errors.summary(options.tolerance), errors.certificate(options.tolerance)
    return (
        tiles,
        atlas,
        statistics.but(
            surfels=statistics.surfels.but(without_tile=int((packing.tiles[:, 3] == 0).sum())),
            texels=counts.but(paper=paper, kept=packing.texels, not_finite=tiles.nonfinite),
            field=levels,
            atlas=None if atlas is None else _cost(packing, atlas),
            error=error,
            certificate=certificate,
        ),
    )


def encoded_pages(
    texels: Tensor,
    packing: Packing,
    options: BakeOptions,
    progress: Progress = no_progress,
    value_range: Range | None = None,
) -> EncodedAtlas:
    """Pages [layers, height, width, 3] as the options say, in a range of values that is not theirs to choose where one
    is given."""
    if options.format != "fp16" and value_range is None:
        value_range = choose_range(texels.numpy(), packing, options.range, options.range_samples, options.seed)
    return encode(texels.numpy(), packing, options.format, value_range, options.bc7_profile, progress=progress)


def _cost(packing: Packing, atlas: EncodedAtlas) -> AtlasCost:
    return AtlasCost(
        bytes=atlas.nbytes,
        pages=(packing.layers, packing.height, packing.width),
        occupancy=packing.occupancy,
        psnr=atlas.psnr,
        clipped_fraction=atlas.clipped_fraction,
    )
