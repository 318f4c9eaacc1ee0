"""The bake of a residual field (paper, section Texture Baking), exact or within a tolerance."""

import time
from collections.abc import Sequence
from dataclasses import replace

import torch

from bitymi_ns.bake.field.errors import tile_errors
from bitymi_ns.bake.field.lean_field import lean_field
from bitymi_ns.bake.field.plan import Field, Plan, make_plan, paper_texels, references
from bitymi_ns.bake.inputs import BakeInput, drawable, photo_resolution, visible
from bitymi_ns.bake.state import BakeableScene, BakeState, atlas_cost, encoded_texels
from bitymi_ns.bake.tiles import Reduced, Tiles, reduce_tiles
from bitymi_ns.bake.view_colors import reduce_view_colors
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import KeptSurfels, Statistics
from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.pages import first_texels, listed_texels
from bitymi_ns.codec.quantise import EncodedAtlas
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.tile_sizes import coarsened


@torch.no_grad()
def bake_field(
    scene: BakeableScene,
    cameras: Sequence[Camera] = (),
    options: BakeOptions | None = None,
    progress: Progress | None = None,
    pixels_per_texel: float | None = None,
) -> BakeState:
    """Bake a scene's residual field into an atlas (paper, section Texture Baking).

    Left out and counted are surfels that can never be drawn (opacity below 1/255), rows that are not finite or beyond
    what a bundle holds (`limits.LIMITS`), rotations of length zero, and surfels that no training view blends. A scene
    without a field has no atlas. There is none, either, where all tiles are constant within the tolerance.

    Args:
        cameras: training views, for the cap on tile sizes and for what they see; with none nothing is left out for it.
        pixels_per_texel: for a bake that is polished next: a tile gets at most a texel for so many pixels that its
            surfel makes up of the view that shows most of it, and is not encoded; view colours stay whole. `reduced`
            then does what the options say. None = as the options say at once.

    Raises:
        ValueError: no surfel is left, an option is out of range, or the atlas would be too large.
    """
    options, progress = options or BakeOptions(), progress or no_progress
    options.check()
    started = time.perf_counter()
    rows, left_out = drawable(scene.surfels)
    surfels = {name: value.detach()[rows].float() for name, value in scene.surfels.items()}
    candidates = BakeInput(surfels, cameras, scene.near, scene.config.weight_bound, scene.config.prefilter)
    inputs, seen = visible(candidates, options, progress)
    if seen is not None:
        left_out, rows = left_out.replace(unseen=int((~seen).sum())), rows[seen]
    trained = len(scene.surfels["means"])
    if len(rows) == 0:
        raise ValueError(f"no surfel is left to bake of {trained}: left out {left_out.model_dump()}")
    statistics = Statistics(surfels=KeptSurfels(trained=trained, kept=len(rows), left_out=left_out))
    field = scene.field
    atlas = None
    if field is None:
        extent = torch.full((len(rows),), options.extent)
        tiles = Tiles(torch.zeros(len(rows), 2, dtype=torch.int32), extent, torch.zeros(len(rows), 3))
    else:
        paper = paper_texels(candidates.surfels, field, options)
        tiles, atlas, statistics = _textured(field, inputs, paper, statistics, options, pixels_per_texel, progress)
    if pixels_per_texel is None:
        surfels, colors, view_color = reduce_view_colors(inputs, options, progress)
    else:
        surfels, colors, view_color = dict(inputs.surfels), None, None
    baked = BakeState.of(scene, surfels, rows, tiles, options)
    baked.scene.photographed = photo_resolution(inputs)
    statistics = statistics.replace(view_color=view_color, seconds=round(time.perf_counter() - started, 3))
    in_front = None if inputs.transmittance is None else inputs.transmittance.cpu()
    return replace(baked, atlas=atlas, statistics=statistics, in_front=in_front, colors=colors)


def _textured(
    field: Field,
    inputs: BakeInput,
    paper: int,
    statistics: Statistics,
    options: BakeOptions,
    pixels_per_texel: float | None,
    progress: Progress,
) -> tuple[Tiles, EncodedAtlas | None, Statistics]:
    """Make the tiles of a scene with a field, the atlas if any surfel needs one, and the statistics of both."""
    levels, atlas, errors = None, None, None
    reduces = pixels_per_texel is None and options.tolerance > 0
    if reduces and isinstance(field, HashField):
        at = (inputs.surfels, inputs.transmittance, inputs.weight_bound)
        field, levels = lean_field(field, *at, options.tolerance)
    plan = make_plan(inputs, field, options, whole=pixels_per_texel is None and not reduces)
    if pixels_per_texel is not None and inputs.views is not None:
        plan = replace(plan, limit=coarsened(plan.limit, inputs.views.pixels / pixels_per_texel, options.r_min))
    if reduces:
        parts = references(field, plan, options.chunk)
        tiles = reduce_tiles(parts, plan, options.tolerance, options.r_min, progress).tiles(plan, options.extent)
    else:
        tiles = _fine_tiles(field, plan, options, progress)
    packing, counts = pack(tiles.sizes, options.page_width, options.page_rows), plan.texels
    if pixels_per_texel is not None:
        counts = counts.replace(polished=packing.texels)
    else:
        stored = tiles.texels
        if packing.texels:
            atlas = encoded_texels(tiles.texels, packing, options, progress)
            stored = listed_texels(torch.from_numpy(atlas.decoded()), packing, tiles.texels[first_texels(tiles.sizes)])
        errors = tile_errors(field, plan, tiles.sizes, stored, options.chunk, progress)
    assert statistics.surfels is not None
    return (
        tiles,
        atlas,
        statistics.replace(
            surfels=statistics.surfels.replace(without_tile=int((packing.tiles[:, 3] == 0).sum())),
            texels=counts.replace(paper=paper, kept=packing.texels, not_finite=tiles.nonfinite),
            field=levels,
            atlas=None if atlas is None else atlas_cost(packing, atlas),
            error=errors and errors.summary(options.tolerance),
            certificate=errors and errors.certificate(options.tolerance),
        ),
    )


def _fine_tiles(field: Field, plan: Plan, options: BakeOptions, progress: Progress) -> Tiles:
    """Make tiles of the plan's limits for every surfel whose residual is visible."""
    reduced, done = Reduced(torch.zeros(len(plan), 2, dtype=torch.int32), torch.zeros(len(plan), 3)), 0
    for part in references(field, plan, options.chunk):
        reduced.sizes[part.rows.cpu()] = torch.tensor(part.size, dtype=torch.int32)
        reduced.parts.append((part.rows.cpu(), part.values.cpu()))
        reduced.nonfinite += part.nonfinite
        done += len(part.rows)
        progress("evaluating texels", done, len(plan))
    return reduced.tiles(plan, options.extent)
