"""Reduced view colours: within the tolerance, and for compact bundles by rate-distortion."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import Kept, Percentiles, ViewColorError
from bitymi_ns.codec.limits import beyond
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.ops import backend, view_color
from bitymi_ns.ops.constants import COLOR_BIAS
from bitymi_ns.ops.view_color import REDUCED, view_base
from bitymi_ns.ops.view_kinds import VIEW_COLORS, fibonacci_sphere, kind_of
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.tile_sizes import kernel_parameters
from .directions import Directions, view_directions
from .inputs import BakeInput

BITS_PER_NUMBER = 5.5  # approximate bits per number of a term in a compact bundle
LEAST_WEIGHT = 1e-12  # added to the weight of every direction: surfels which no view shows have a mean, too
VIEW_SHARE = 0.5  # weight of the training views; the rest is of directions between and around them
BLIND = 4  # number of nearest views without the surfel whose directions count as well
BLIND_SHARE = 0.1  # weight of these, as a share of what a view from there would show


@dataclass(frozen=True)
class ColorChoices:
    """View colours of N surfels, from the terms that a tolerance needs down to one colour."""

    # [N, most + 1] squared error in the views by number of terms, summed over pixels and channels; infinite: no choice
    error: Tensor
    largest: Tensor  # [N] largest error with the most terms, over all directions, times blending weight, 8-bit steps
    width: int  # numbers of a term
    # rows [n] int64 of surfels, their base colours [n, 3] and terms [n, number, width]
    choices: Sequence[tuple[Tensor, Tensor, Tensor]]

    def at(self, lmbda: float | None = None) -> dict[str, Tensor]:
        """Choose the reduced view colours of the least error + lambda x bits. `lmbda`: squared error per bit, colours
        in [0, 1]; None = those within the tolerance."""
        numbers = torch.arange(self.error.shape[1])
        if lmbda is None:
            count = torch.where(self.error.isfinite(), numbers, 0).amax(1)
        else:
            count = (self.error + lmbda * BITS_PER_NUMBER * self.width * numbers).argmin(1)
        first = count.cumsum(0) - count
        base = self.error.new_zeros(len(count), 3)
        listed = self.error.new_zeros(int(count.sum()), self.width)
        for rows, bases, terms in self.choices:
            chosen = count[rows] == terms.shape[1]
            base[rows[chosen]] = bases[chosen]
            listed[first[rows[chosen], None] + torch.arange(terms.shape[1])] = terms[chosen]
        return dict(zip(REDUCED, (base, torch.stack([first, count], dim=1).int(), listed), strict=True))


def choice_bytes(kind: str, surfels: int, views: int, most: int) -> int:
    """Estimate the memory of `color_choices`, bytes. `most`: terms of a surfel."""
    entry = VIEW_COLORS[kind]
    numbers = range(most + 1) if entry.sites is not None else sorted({0, most})
    of_surfel = 4 * (most + 1) + sum(8 + 4 * (3 + entry.reduced_width * number) for number in numbers)
    return surfels * (of_surfel + views)  # a bool per view: whether it shows the surfel


def shown_at(kind: str, params: Mapping[str, Tensor], directions: Tensor) -> Tensor:
    """Evaluate the blended colour max(f_view + 0.5, 0) [n, D, 3] of n surfels by the renderers' kernels, in directions
    [n, D, 3], unit vectors."""
    origin = directions.new_zeros(3)
    columns = [view_color(kind, params, d.contiguous(), origin) for d in directions.unbind(1)]
    return view_base(torch.stack(columns, dim=1))


def centers_of(cameras: Sequence[Camera], like: Tensor) -> Tensor:
    """Stack the camera centres [V, 3] float64 on the device of `like`."""
    centers = [camera.exact_center.double().cpu() for camera in cameras]
    return torch.stack(centers).to(like.device) if centers else torch.zeros(0, 3, dtype=torch.float64)


@torch.no_grad()
def color_choices(
    surfels: Mapping[str, Tensor],
    kind: str,
    squares: Tensor,
    centers: Tensor,
    opacity: Tensor,
    tolerance: float,
    near: float = 0.0,
    progress: Progress = no_progress,
) -> ColorChoices:
    """Fit view colours from one colour up to the fewest terms within a tolerance (docs/baking.md); returned on the CPU.

    The tolerance bounds the error of max(f_view + 0.5, 0), the largest over directions (`view_directions`) and
    channels, times the largest blending weight. Kinds without sites have one colour, or all terms. Every choice has its
    squared error in the pictures, weighted by what the views show of the surfel (`squares`) in their directions,
    between and around them (`_weights`), and from the nearest other views (`_unseen`).

    Args:
        surfels: parameters, N rows; their device does the work.
        squares: [V, N], `Visibility.squares`; V may be 0.
        centers: [V, 3] float64 camera centres.
        opacity: [N] largest blending weight.
        tolerance: 8-bit steps.
        near: near plane, the least distance of a view."""
    means, entry = surfels["means"], VIEW_COLORS[kind]
    most = entry.terms(surfels) - entry.base_terms
    error = means.new_full((len(means), most + 1), torch.inf)
    largest = means.new_zeros(len(means))
    choices = []
    done = 0
    for chunk in view_directions(means, squares > 0, centers):
        own = [surfels[name][chunk.rows] for name in entry.names]
        shown = squares[:, chunk.rows].float()
        unseen, of_unseen = _unseen(means[chunk.rows], shown, centers, near)
        weight = torch.cat([_weights(chunk, shown), of_unseen], dim=1)
        unit = torch.cat([chunk.unit, unseen], dim=1)
        valid = F.pad(chunk.valid, (0, unseen.shape[1]))
        chunk = replace(chunk, unit=unit, valid=valid)
        target = shown_at(kind, dict(zip(entry.names, own, strict=True)), chunk.unit)

        def rest_of(rows: Tensor, base: Tensor, terms: Tensor, shown: Tensor) -> Tensor:
            """Record a choice; return the rows whose error exceeds the tolerance."""
            away = shown - target[rows]  # noqa: B023 - called in this round alone
            square = (away.square().sum(2) * weight[rows]).sum(1)  # noqa: B023
            bad = beyond("view_base", kind, base).any(1) | beyond("view_terms", kind, terms).flatten(1).any(1)
            held, of_scene = ~bad & square.isfinite(), chunk.rows[rows]  # noqa: B023
            worst = opacity[of_scene] * STEPS * (away.abs().amax(2) * chunk.valid[rows]).amax(1)  # noqa: B023
            fits = held & (worst <= tolerance)
            kept = held if len(squares) else fits  # without views nothing is known of the pictures
            error[of_scene, terms.shape[1]] = square.masked_fill(~kept, torch.inf)
            largest[of_scene] = worst
            choices.append(tuple(value[kept].cpu() for value in (of_scene, base, terms)))
            return rows[~fits]

        rest = torch.arange(len(chunk.rows), device=means.device)
        color = _one_color(target, chunk.valid, weight, tolerance / opacity[chunk.rows])
        base = (color - COLOR_BIAS) / entry.base_unit
        rest = rest_of(rest, base, base.new_zeros(len(base), 0, entry.reduced_width), color[:, None])
        if entry.sites is not None:
            vectors, colors = entry.sites(*own)
            counts = chunk.subset(weight, FIT_VIEWS)
            fit = fewer_sites(chunk, counts / counts.mean(1, keepdim=True).clamp(min=1e-20), vectors, colors)
            for number in range(2, vectors.shape[1]):
                if len(rest):
                    base, terms = fit(number, rest)
                    vectors_of = F.pad(terms[..., :3], (0, 0, 1, 0))
                    color = site_colors(vectors_of, torch.cat([base[:, None], terms[..., 3:]], dim=1), chunk.unit[rest])
                    rest = rest_of(rest, base, terms, view_base(color))
            own = colors[:, 0], torch.cat([vectors[:, 1:] - vectors[:, :1], colors[:, 1:]], dim=2)
        rows = chunk.rows[rest]
        error[rows, most], largest[rows] = 0.0, 0.0
        choices.append((rows.cpu(), *(value[rest].cpu() for value in own)))
        done += len(chunk.rows)
        progress("reducing the view colours", done, len(means))
    return ColorChoices(error.cpu(), largest.cpu(), entry.reduced_width, choices)


def _weights(chunk: Directions, weights: Tensor) -> Tensor:
    """Compute the weights [n, D] of directions from those of views [V, n]: `VIEW_SHARE` for their own, the rest spread
    evenly over the directions of no view."""
    of_views = weights.T.gather(1, chunk.view) * chunk.valid[:, : chunk.views]
    rest = chunk.valid.shape[1] - chunk.views
    between = (1 - VIEW_SHARE) * of_views.sum(1, keepdim=True) / max(1, rest)
    return torch.cat([VIEW_SHARE * of_views, between.expand(-1, rest)], dim=1)


def _unseen(means: Tensor, weights: Tensor, centers: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Find the directions [n, BLIND, 3] from the nearest views that do not show a surfel, as a new view near there may,
    and their weights [n, BLIND]: a share of the mean weight of the views that show it, scaled by the inverse square of
    the distance; 0 without such a view."""
    offset = means.double()[:, None] - centers.to(means.device)  # [n, V, 3]
    square = offset.square().sum(2).clamp(min=near * near)
    shows = weights.T > 0
    from_unit = (weights.T * square).sum(1) / shows.sum(1).clamp(min=1)
    nearest = square.masked_fill(shows, torch.inf).topk(min(BLIND, len(centers)), largest=False)
    unit = F.normalize(offset.gather(1, nearest.indices[..., None].expand(-1, -1, 3)), dim=2)
    return unit.to(means), (BLIND_SHARE * from_unit[:, None] / nearest.values).to(means)


def _one_color(target: Tensor, valid: Tensor, weight: Tensor, allowed: Tensor) -> Tensor:
    """Choose the middle [n, 3] of the extremes of colours [n, D, 3] if within `allowed` [n], 8-bit steps, else the
    mean."""
    low = target.masked_fill(~valid[..., None], torch.inf).amin(1)
    high = target.masked_fill(~valid[..., None], -torch.inf).amax(1)
    weight = weight + LEAST_WEIGHT
    mean = (target * weight[..., None]).sum(1) / weight.sum(1, keepdim=True)
    return torch.where((STEPS * 0.5 * (high - low).amax(1) <= allowed)[:, None], 0.5 * (low + high), mean)


@torch.no_grad()
def view_color_errors(
    kind: str,
    full: Mapping[str, Tensor],
    reduced: Mapping[str, Tensor],
    means: Tensor,
    seen: Tensor,
    centers: Tensor,
    opacity: Tensor,
) -> Tensor:
    """Measure the largest error of every view colour over the directions, times the largest blending weight, [N] 8-bit
    steps. `full`, `reduced`: parameters before and after. `seen`: [V, N] bool, training views that see each surfel; V
    may be 0. `centers`, `opacity`: as in `color_choices`."""
    error = means.new_zeros(len(means))
    for chunk in view_directions(means, seen, centers):
        exact = shown_at(kind, {name: full[name][chunk.rows] for name in VIEW_COLORS[kind].names}, chunk.unit)
        rows = {name: reduced[name][chunk.rows] for name in ("view_base", "view_span")}
        kept = shown_at(kind, {**rows, "view_terms": reduced["view_terms"]}, chunk.unit)
        error[chunk.rows] = STEPS * ((exact - kept).abs().amax(2) * chunk.valid).amax(1) * opacity[chunk.rows]
    return error


def reduce_view_colors(
    inputs: BakeInput, options: BakeOptions, progress: Progress = no_progress
) -> tuple[dict[str, Tensor], ColorChoices | None, ViewColorError | None]:
    """Reduce the view colours within the tolerance; 0 keeps all terms. Returns surfels, choices and error."""
    surfels, tolerance = dict(inputs.surfels), options.tolerance
    if tolerance == 0:
        return surfels, None, None
    kind, means = kind_of(surfels), surfels["means"]
    opacity, _ = kernel_parameters(surfels, inputs.transmittance)
    squares = means.new_zeros(0, len(means)) if inputs.views is None else inputs.views.squares
    views = (squares, centers_of(inputs.cameras, means), opacity)
    choices = color_choices(surfels, kind, *views, tolerance, inputs.near, progress)
    reduced, entry = choices.at(), VIEW_COLORS[kind]
    before = sum(parameter[0].numel() for parameter in entry.of(surfels)) if len(means) else 0
    sites = 1 + entry.terms(surfels) - entry.base_terms  # the base of a reduced colour, and its terms
    stated = ViewColorError(
        kind=kind,
        tolerance=tolerance,
        unit="8-bit steps, largest over the directions and channels, weighted by the blending weight",
        sites=Kept(before=sites * len(means), after=len(means) + len(reduced["view_terms"])),
        one_color=int((reduced["view_span"][:, 1] == 0).sum()),
        bytes=Kept(before=4 * before * len(means), after=4 * (4 * len(means) + reduced["view_terms"].numel())),
        error=Percentiles.of(choices.largest),
    )
    kept = {name: value for name, value in surfels.items() if name not in entry.names}
    return kept | reduced, choices, stated


FIT_STEPS = 6
FIT_VIEWS = 16  # views of a surfel in the fit; the error is measured in all
OUTSIDE, OUTSIDE_WEIGHT = 12, 0.05
"""Directions over the sphere, and their weight, in the fit: away from views, the colour follows the trained one
loosely."""


def site_colors(vectors: Tensor, rgb: Tensor, directions: Tensor) -> Tensor:
    """Compute sum_k softmax_k(v_k . d) rgb_k, [n, D, 3], from v and rgb [n, K, 3] and directions d [n, D, 3]."""
    weights = torch.softmax(vectors @ directions.transpose(1, 2), dim=1)  # far slower along a short last axis
    return weights.transpose(1, 2) @ rgb


def fewer_sites(
    chunk: Directions, weight: Tensor, vectors: Tensor, rgb: Tensor
) -> Callable[[int, Tensor], tuple[Tensor, Tensor]]:
    """Rank the sites by how much they are needed, and return a fit of the first ones to the colour of all, by
    Levenberg-Marquardt, from a number of sites below K, and rows, to base [m, 3] and terms [m, number - 1, 6].
    `weight`: [n, D'] of `Directions.subset`. `vectors`, `rgb`: [n, K, 3]."""
    outside = fibonacci_sphere(OUTSIDE).to(vectors).expand(len(vectors), -1, -1)
    unit = torch.cat([chunk.subset(chunk.unit, FIT_VIEWS), outside], dim=1)
    weight = F.pad(weight, (0, OUTSIDE), value=OUTSIDE_WEIGHT)
    cpu, order = backend.load("_cpu"), torch.empty(vectors.shape[:2], dtype=torch.int64)  # whatever the device is
    given = {"vectors": vectors.cpu().contiguous(), "colors": rgb.cpu().contiguous(), "order": order}
    counts = {"sites": vectors.shape[1], "directions": unit.shape[1]}
    cpu.rank_sites_f32(**given, **counts, samples=torch.cat([unit, weight[..., None]], dim=2).cpu())
    order = order.to(vectors.device)
    samples = torch.cat([unit, site_colors(vectors, rgb, unit), weight[..., None]], dim=2)

    def fit(number: int, rows: Tensor) -> tuple[Tensor, Tensor]:
        kept = order[rows, :number, None].expand(-1, -1, 3)
        v, r = vectors[rows].gather(1, kept), rgb[rows].gather(1, kept)
        sites = {"vectors": (v[:, 1:] - v[:, :1]).cpu().contiguous(), "colors": r.cpu()}
        counts = {"sites": number, "directions": samples.shape[1], "rounds": FIT_STEPS}
        cpu.fit_sites_f32(**sites, **counts, samples=samples[rows].cpu())
        v, r = (value.to(rgb.device) for value in sites.values())
        return r[:, 0], torch.cat([v, r[:, 1:]], dim=2)

    return fit
