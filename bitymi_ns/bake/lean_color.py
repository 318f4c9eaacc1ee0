"""Lean view colours: a surfel keeps the fewest sites that hold its colour, or one colour."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from bitymi_ns.bake.directions import Directions, view_directions
from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bake.voronoi_fit import FIT_VIEWS, fewer_sites, site_weights
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import Kept, Percentiles, ViewColorError
from bitymi_ns.codec.limits import beyond
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.ops import view_color
from bitymi_ns.ops.constants import COLOR_BIAS
from bitymi_ns.ops.view_color import LEAN, view_base
from bitymi_ns.ops.view_kinds import VIEW_COLORS, kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.tile_sizes import kernel_parameters


def centers_of(cameras: Sequence[Any], like: Tensor) -> Tensor:
    """[V, 3] float64 centres of the cameras on the device of `like`."""
    centers = [camera.exact_center.double().cpu() for camera in cameras]
    return torch.stack(centers).to(like.device) if centers else torch.zeros(0, 3, dtype=torch.float64)


def shown_at(kind: str, params: Mapping[str, Tensor], directions: Tensor) -> Tensor:
    """max(f_view + 0.5, 0), the colour that is blended, by the renderers' own kernels: [n, D, 3].

    Args:
        kind: a name of `ops.VIEW_COLORS`.
        params: parameters of n surfels, all or lean.
        directions: [n, D, 3] unit vectors.
    """
    origin = directions.new_zeros(3)
    columns = [view_color(kind, params, d.contiguous(), origin) for d in directions.unbind(1)]
    return view_base(torch.stack(columns, dim=1))


def largest_error(a: Tensor, b: Tensor, valid: Tensor) -> Tensor:
    """Largest |a - b| of colours [n, D, 3] over the valid directions and the channels, in 8-bit steps: [n]."""
    return STEPS * ((a - b).abs().amax(2) * valid).amax(1)


@torch.no_grad()
def reduce_view_color(
    surfels: Mapping[str, Tensor],
    kind: str,
    seen: Tensor,
    centers: Tensor,
    opacity: Tensor,
    tolerance: float,
    progress: Progress = no_progress,
) -> dict[str, Tensor]:
    """Lean view colours (`ops.view_color.LEAN`): the fewest sites, down to one constant colour, that keep a surfel's
    colour within a tolerance.

    The error is the largest one over all directions of `view_directions` and the channels, of max(f_view + 0.5, 0),
    times the largest blending weight that the surfel can have. One colour is tried first, the middle between the
    extremes; then 2, 3, ... sites: those that are hardest to do without, fitted together by least squares. A surfel for
    which none is good enough keeps all sites. Surfels of a kind without sites (`ViewColor.sites`) keep one colour, or
    all terms.

    Args:
        surfels: the per-surfel parameters, N rows.
        kind: a name of `ops.VIEW_COLORS`.
        seen: [V, N] bool, the training views that see each surfel; V may be 0.
        centers: [V, 3] float64 camera centres.
        opacity: [N] largest blending weight.
        tolerance: 8-bit steps.
    """
    means, entry = surfels["means"], VIEW_COLORS[kind]
    full = {name: surfels[name] for name in entry.names}
    count, base = means.new_zeros(len(means), dtype=torch.int64), means.new_zeros(len(means), 3)
    parts: list[tuple[Tensor, Tensor]] = []  # rows [n], terms [n, number, width]
    done = 0
    for at in view_directions(means, seen, centers):
        own = {name: value[at.rows] for name, value in full.items()}
        target = shown_at(kind, own, at.unit)
        allowed = tolerance / opacity[at.rows]
        low = target.masked_fill(~at.valid[..., None], torch.inf).amin(1)
        high = target.masked_fill(~at.valid[..., None], -torch.inf).amax(1)
        base[at.rows] = (0.5 * (low + high) - COLOR_BIAS) / entry.base_unit
        needs_more = STEPS * 0.5 * (high - low).amax(1) > allowed
        needs_more |= beyond("view_base", kind, base[at.rows]).any(1)  # a bundle cannot hold this colour
        rest = torch.nonzero(needs_more).squeeze(1)
        if entry.sites is not None:
            fitted = _fewer_sites(at, rest, kind, entry.sites(*own.values()), target, allowed)
        else:
            color, terms = own.values()
            fitted = [(rest, color[rest], terms[rest])]
        for rows, color, terms in fitted:
            where = at.rows[rows]
            base[where], count[where] = color, terms.shape[1]
            parts.append((where, terms))
        done += len(at.rows)
        progress("reducing the view colours", done, len(means))
    return lean(base, count, entry.lean_width, parts)


def lean(base: Tensor, count: Tensor, width: int, parts: Iterable[tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
    """Lean view colours as a bundle holds them: the terms of all surfels in one list.

    Args:
        base: [N, 3].
        count: [N] int64, terms of each surfel.
        width: numbers of a term.
        parts: rows [n] of surfels, and their terms [n, number, width].
    """
    first = count.cumsum(0) - count
    terms = base.new_zeros(int(count.sum()), width)
    for rows, values in parts:
        terms[first[rows, None] + torch.arange(values.shape[1], device=base.device)] = values
    return dict(zip(LEAN, (base, torch.stack([first, count], dim=1).int(), terms), strict=True))


def _fewer_sites(
    at: Directions, rest: Tensor, kind: str, own: tuple[Tensor, Tensor], target: Tensor, allowed: Tensor
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Sites for the surfels `rest` of a chunk: (rows [m], base [m, 3], terms [m, number, 6]) for every number.

    `own` are vectors and colours [n, K, 3] of all its surfels' sites.
    """
    vectors, rgb = own
    fit, result = fewer_sites(at, at.subset(at.valid, FIT_VIEWS).float(), vectors, rgb), []
    for number in range(2, vectors.shape[1]):
        if len(rest) == 0:
            break
        color, terms = fit(number, rest)
        weights = site_weights(F.pad(terms[..., :3], (0, 0, 1, 0)), at.unit[rest])
        shown = view_base(weights @ torch.cat([color[:, None], terms[..., 3:]], dim=1))
        good = largest_error(shown, target[rest], at.valid[rest]) <= allowed[rest]
        good &= ~beyond("view_terms", kind, terms).flatten(1).any(1) & ~beyond("view_base", kind, color).any(1)
        result.append((rest[good], color[good], terms[good]))
        rest = rest[~good]
    v = vectors[rest].double()
    relative = (v[:, 1:] - v[:, :1]).to(rgb)
    return [*result, (rest, rgb[rest, 0], torch.cat([relative, rgb[rest, 1:]], dim=2))]


@torch.no_grad()
def view_color_errors(
    kind: str,
    full: Mapping[str, Tensor],
    lean: Mapping[str, Tensor],
    means: Tensor,
    seen: Tensor,
    centers: Tensor,
    opacity: Tensor,
) -> Tensor:
    """Largest error of every surfel's view colour over the directions of `view_directions`, times its largest blending
    weight, in 8-bit steps: [N].

    Args:
        kind: a name of `ops.VIEW_COLORS`.
        full: parameters of N surfels as they were trained.
        lean: the same surfels' lean parameters.
        means, seen, centers, opacity: as in `reduce_view_color`.
    """
    error = means.new_zeros(len(means))
    for at in view_directions(means, seen, centers):
        exact = shown_at(kind, {name: full[name][at.rows] for name in VIEW_COLORS[kind].names}, at.unit)
        rows = {name: lean[name][at.rows] for name in ("view_base", "view_span")}
        found = shown_at(kind, {**rows, "view_terms": lean["view_terms"]}, at.unit)
        error[at.rows] = largest_error(exact, found, at.valid) * opacity[at.rows]
    return error


def describe(
    kind: str, surfels: Mapping[str, Tensor], lean: Mapping[str, Tensor], error: Tensor, tolerance: float
) -> ViewColorError:
    """Statistics of a reduction."""
    (base, span, terms), entry = (lean[name] for name in LEAN), VIEW_COLORS[kind]
    before = sum(each[0].numel() for each in entry.of(surfels)) if len(base) else 0
    sites = 1 + entry.terms(surfels) - entry.base_terms  # the base of a lean colour, and its terms
    return ViewColorError(
        kind=kind,
        tolerance=tolerance,
        unit="8-bit steps, largest over the directions and channels, weighted by the blending weight",
        sites=Kept(before=sites * len(base), after=len(base) + len(terms)),
        one_color=int((span[:, 1] == 0).sum()),
        bytes=Kept(before=4 * before * len(base), after=4 * (4 * len(base) + terms.numel())),
        error=Percentiles.of(error),
    )


def kept_view_colors(
    inputs: BakeInput, options: BakeOptions, progress: Progress = no_progress
) -> tuple[dict[str, Tensor], ViewColorError | None]:
    """Surfels with the view colours that the tolerance keeps, and their error; all of them without a tolerance."""
    surfels = inputs.surfels
    if options.tolerance == 0:
        return dict(surfels), None
    kind, means = kind_of(surfels), surfels["means"]
    opacity, _ = kernel_parameters(surfels, inputs.transmittance)
    at = (inputs.seen, centers_of(inputs.cameras, means), opacity)
    lean = reduce_view_color(surfels, kind, *at, options.tolerance, progress)
    error = view_color_errors(kind, surfels, lean, means, *at)
    kept = {name: value for name, value in surfels.items() if name not in VIEW_COLORS[kind].names}
    return kept | lean, describe(kind, surfels, lean, error, options.tolerance)
