"""The ways to bake: the paper's rule, which keeps everything; the least that a tolerance allows; and as fine as the
views see, which a polish starts from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from bitymi_ns.bake.field.lean_field import lean_field
from bitymi_ns.bake.field.plan import Field, Plan, Shown, make_plan
from bitymi_ns.bake.field.reference import held, references
from bitymi_ns.bake.field.texels import evaluate_tiles
from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bake.lean_color import centers_of, describe, reduce_view_color, view_color_errors
from bitymi_ns.bake.reduce import Reduced, reduce_tiles
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import FieldLevels, ViewColorError
from bitymi_ns.codec.packing import Packing, pack
from bitymi_ns.codec.pages import tile_means
from bitymi_ns.ops.view_kinds import VIEW_COLORS, kind_of
from bitymi_ns.progress import Progress
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.tile_sizes import coarsened, kernel_parameters


@dataclass(frozen=True)
class Tiles:
    """The tiles of N surfels and what they hold, on the CPU.

    Attributes:
        packing: where they lie.
        texels: [layers, height, width, 3] float32 residual colours, None where there is no tile.
        extent: [N] half side in scale units.
        mean_residual: [N, 3] mean of every tile; the residual of a surfel without one.
        nonfinite: points at which the field was not finite.
    """

    packing: Packing
    texels: Tensor | None
    extent: Tensor
    mean_residual: Tensor
    nonfinite: int = 0

    @classmethod
    def none(cls, count: int, extent: float) -> Tiles:
        """Those of surfels that all go without."""
        return cls(pack(torch.zeros(count, 2)), None, torch.full((count,), extent), torch.zeros(count, 3))


class BakeMethod(Protocol):
    """How a scene is baked, step by step.

    Attributes:
        final: what it gives is encoded and its error stated; else it is to learn yet.
    """

    final: ClassVar[bool]

    def field(self, field: Field, inputs: BakeInput) -> tuple[Field, FieldLevels | None]:
        """The field that the bake evaluates, and what was left out of it; None = nothing is looked for."""

    def plan(self, field: Field, inputs: BakeInput) -> Plan:
        """What the tiles have to hold."""

    def tiles(self, field: Field, plan: Plan, inputs: BakeInput, progress: Progress) -> Tiles:
        """The tiles, packed, with their texels."""

    def view_color(self, inputs: BakeInput, progress: Progress) -> tuple[dict[str, Tensor], ViewColorError | None]:
        """The surfels with the view colours that are kept, and what that costs; None = all are."""


@dataclass(frozen=True)
class PaperBake:
    """The paper's bake: sizes by the Nyquist rule, the field at the texel centres, all of the view colours."""

    final: ClassVar[bool] = True
    options: BakeOptions

    def field(self, field: Field, inputs: BakeInput) -> tuple[Field, None]:
        """The field as it is."""
        return field, None

    def plan(self, field: Field, inputs: BakeInput) -> Plan:
        """Tiles of the extent and the texels that the options give."""
        return _plan(field, inputs, self.options, whole=True)

    def tiles(self, field: Field, plan: Plan, inputs: BakeInput, progress: Progress) -> Tiles:
        """One for every surfel."""
        o, p = self.options, inputs.surfels
        packing = pack(plan.limit.cpu(), o.page_width, o.page_rows)
        geometry = (p["means"], p["quats"], p["log_scales"].exp())
        texels, nonfinite = evaluate_tiles(field, *geometry, packing, o.extent, o.chunk, progress)
        extent = torch.full((len(plan),), o.extent)
        return Tiles(packing, texels, extent, tile_means(texels, packing), nonfinite)

    def view_color(self, inputs: BakeInput, progress: Progress) -> tuple[dict[str, Tensor], None]:
        """All of it."""
        return dict(inputs.surfels), None


@dataclass(frozen=True)
class ToleranceBake:
    """The least that keeps the tolerance: levels of the field, extents and grids of tiles, sites of view colours."""

    final: ClassVar[bool] = True
    options: BakeOptions

    def field(self, field: Field, inputs: BakeInput) -> tuple[Field, FieldLevels | None]:
        """The levels that some surfel needs."""
        if not isinstance(field, HashField):
            return field, None
        at = (inputs.surfels, inputs.transmittance, inputs.weight_bound)
        return lean_field(field, *at, self.options.tolerance)

    def plan(self, field: Field, inputs: BakeInput) -> Plan:
        """Tiles of what can be seen."""
        return _plan(field, inputs, self.options, whole=False)

    def tiles(self, field: Field, plan: Plan, inputs: BakeInput, progress: Progress) -> Tiles:
        """Of the smallest grid that holds the field, or none."""
        o = self.options
        reduced = reduce_tiles(references(field, plan, o.chunk), plan, o.tolerance, o.r_min, progress)
        return _packed(reduced, plan, o)

    def view_color(self, inputs: BakeInput, progress: Progress) -> tuple[dict[str, Tensor], ViewColorError]:
        """As few sites as hold every surfel's colour; see `lean_color.reduce_view_color`."""
        surfels, tolerance = inputs.surfels, self.options.tolerance
        kind, means = kind_of(surfels), surfels["means"]
        opacity, _ = kernel_parameters(surfels, inputs.transmittance)
        at = (inputs.seen, centers_of(inputs.cameras, means), opacity)
        lean = reduce_view_color(surfels, kind, *at, tolerance, progress)
        error = view_color_errors(kind, surfels, lean.parameters(), means, *at)
        kept = {name: value for name, value in surfels.items() if name not in VIEW_COLORS[kind].names}
        return kept | lean.parameters(), describe(kind, surfels, lean, error, tolerance)


@dataclass(frozen=True)
class FineBake:
    """What a polish starts from: as many texels as the views can tell apart, whatever the field has learned, and all of
    the view colours. A tile has at most a texel for every `pixels_per_texel` pixels that its surfel makes up of the
    view that shows most of it.
    """

    final: ClassVar[bool] = False
    options: BakeOptions
    pixels_per_texel: float

    def field(self, field: Field, inputs: BakeInput) -> tuple[Field, None]:
        """The field as it is."""
        return field, None

    def plan(self, field: Field, inputs: BakeInput) -> Plan:
        """Tiles of what can be seen, as fine as it is seen."""
        plan = _plan(field, inputs, self.options, whole=False)
        if inputs.views is None:
            return plan
        limit = coarsened(plan.limit, inputs.views.pixels / self.pixels_per_texel, self.options.r_min)
        return replace(plan, limit=limit)

    def tiles(self, field: Field, plan: Plan, inputs: BakeInput, progress: Progress) -> Tiles:
        """One for every surfel of which any view shows a residual."""
        o = self.options
        reduced, done = Reduced(torch.zeros(len(plan), 2, dtype=torch.int32), torch.zeros(len(plan), 3)), 0
        for part in references(field, plan, o.chunk):
            reduced.sizes[part.rows.cpu()] = torch.tensor(part.size, dtype=torch.int32)
            reduced.parts.append((part.rows.cpu(), part.values.cpu()))
            reduced.nonfinite += part.nonfinite
            done += len(part.rows)
            progress("evaluating texels", done, len(plan))
        return _packed(reduced, plan, o)

    def view_color(self, inputs: BakeInput, progress: Progress) -> tuple[dict[str, Tensor], None]:
        """All of it."""
        return dict(inputs.surfels), None


def bake_method(options: BakeOptions) -> PaperBake | ToleranceBake:
    """The way that the options ask for: nothing after this asks whether there is a tolerance."""
    return ToleranceBake(options) if options.tolerance > 0 else PaperBake(options)


def reduced_tiles(tiles: Tiles, inputs: BakeInput, options: BakeOptions, progress: Progress) -> Tiles:
    """Tiles of the smallest grids that hold, within the tolerance, what these have learned; none where one colour does.

    Args:
        tiles: of N surfels, with texels.
        inputs: the surfels, and what the views see of them; their device does the work.
    """
    assert tiles.texels is not None
    opacity, beta = kernel_parameters(inputs.surfels, inputs.transmittance)
    shown = Shown(opacity, beta, tiles.extent.to(opacity.device), inputs.weight_bound)
    parts = held(tiles.texels.to(opacity.device), tiles.packing, shown, options.chunk)
    smaller = reduce_tiles(parts, shown, options.tolerance, options.r_min, progress)
    bare = torch.from_numpy(tiles.packing.tiles)[:, 3] == 0
    smaller.constant[bare] = tiles.mean_residual[bare]
    return _packed(smaller, shown, options)


def _packed(reduced: Reduced, shown: Shown, options: BakeOptions) -> Tiles:
    packing = pack(reduced.sizes, options.page_width, options.page_rows)
    texels = reduced.pages(packing)
    extent = torch.where(shown.extent > 0, shown.extent, options.extent).cpu()
    means = tile_means(texels, packing, reduced.constant)
    return Tiles(packing, texels if packing.texels else None, extent, means, reduced.nonfinite)


def _plan(field: Field, inputs: BakeInput, options: BakeOptions, whole: bool) -> Plan:
    at = (inputs.cameras, inputs.transmittance, inputs.near, inputs.weight_bound)
    return make_plan(inputs.surfels, field, options, *at, whole)
