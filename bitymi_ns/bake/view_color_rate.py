"""Rate-distortion choice of the view-colour terms: the error that every number of terms makes in the views."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from bitymi_ns.bake.directions import Directions, view_directions
from bitymi_ns.bake.inputs import device_of
from bitymi_ns.bake.lean_color import centers_of, lean, shown_at
from bitymi_ns.bake.voronoi_fit import FIT_VIEWS, fewer_sites
from bitymi_ns.codec.limits import beyond
from bitymi_ns.codec.pages import texel_alpha
from bitymi_ns.ops import fitting_lists, project
from bitymi_ns.ops.constants import COLOR_BIAS
from bitymi_ns.ops.project import GEOMETRY
from bitymi_ns.ops.view_kinds import VIEW_COLORS, ViewColor
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.camera import Camera

BITS_PER_NUMBER = 5.5  # bits of a number of a term in a compact bundle, about
LEAST_WEIGHT = 1e-12  # weight of any direction: a surfel that no view shows has a colour, too
VIEW_SHARE = 0.5  # weight of the training views; the rest are directions between and around them

BLIND = 4  # directions from so many of the nearest views that do not show the surfel count, too
BLIND_SHARE = 0.1
"""Weight of these as a share of what a view would show of the surfel from there: a new view may show it."""


@dataclass(frozen=True)
class ColorChoices:
    """Errors and parameters of the colours of N surfels for every number of terms."""

    # [N, most + 1] squared error in the views, summed over pixels and channels; infinite where that number is no choice
    error: Tensor
    base: Tensor  # [N, most + 1, 3]
    terms: Mapping[int, Tensor]  # [N, number, width] for every number that is a choice for any surfel

    def at(self, lmbda: float) -> dict[str, Tensor]:
        """Lean view colours of the least error + lambda bits.

        Args:
            lmbda: squared error per bit, colours from 0 to 1.
        """
        width = self.terms[0].shape[2]
        bits = BITS_PER_NUMBER * width * torch.arange(self.error.shape[1])
        count = (self.error + lmbda * bits).argmin(dim=1)
        rows = {number: torch.nonzero(count == number).squeeze(1) for number in self.terms}
        parts = ((rows[number], values[rows[number]]) for number, values in self.terms.items())
        return lean(self.base[torch.arange(len(count)), count], count, width, parts)


@torch.no_grad()
def shown_weights(scene: BakedScene, cameras: Sequence[Camera], progress: Progress = no_progress) -> Tensor:
    """[V, N] sum over a view's pixels of the squared blending weight of each surfel: an error e of its colour adds e^2
    times as much to the picture. On the device of the cameras."""
    device = device_of(cameras)
    found = torch.zeros(len(cameras), len(scene), device=device)
    geometry, alpha = [scene.surfels[name].to(device) for name in GEOMETRY], texel_alpha(scene)
    alpha = None if alpha is None else alpha.to(device)
    for done, camera in enumerate(cameras):
        for fragments in fitting_lists(project(*geometry, camera, scene.near, scene.prefilter, alpha=alpha)):
            found[done].index_add_(0, fragments.surfel, fragments.weight.square())
            del fragments  # before the next list is made
        progress("tracing the training views", done + 1, len(cameras))
    return found


def choice_bytes(kind: str, surfels: int, views: int, most: int) -> int:
    """Memory of `color_choices`, bytes.

    Args:
        most: lean terms of a surfel.
    """
    entry = VIEW_COLORS[kind]
    numbers = range(most + 1) if entry.sites is not None else sorted({0, most})
    of_surfel = 4 * (4 * (most + 1) + entry.lean_width * sum(numbers))  # errors, bases and terms of every number
    of_view = 4 + 1 + 1  # weights, whether they are above 0, and the same of the surfels of a number of terms
    return surfels * (of_surfel + of_view * views)


@torch.no_grad()
def color_choices(scene: BakedScene, cameras: Sequence[Camera], progress: Progress = no_progress) -> ColorChoices:
    """Errors of lean view colours with fewer terms, from all of a surfel's down to one colour.

    Terms are left out and the others fitted as in `lean_color`, but the error is that of the pictures: squared, of
    max(f_view + 0.5, 0), in every view times what it shows of the surfel. Half of it is that in the training views,
    half the mean of directions between and around them. Beside these, views that pass close by a surfel without looking
    at it count by what they would show of it: the next view does look, and has nothing else to go by.

    Args:
        scene: with lean view colours.
        cameras: training views; their device does the work.

    Returns:
        on the CPU.
    """
    weights, kind = shown_weights(scene, cameras, progress), scene.view_color
    entry, surfels = VIEW_COLORS[kind], {name: value.to(weights.device) for name, value in scene.surfels.items()}
    counts = surfels["view_span"][:, 1].long()
    most, width = int(counts.max()) if len(counts) else 0, entry.lean_width
    error = weights.new_full((len(counts), most + 1), torch.inf)
    base = weights.new_zeros(len(counts), most + 1, 3)
    numbers = range(most + 1) if entry.sites is not None else sorted({0, *counts.tolist()})
    terms = {number: weights.new_zeros(len(counts), number, width) for number in numbers}
    for count in numbers:
        group = torch.nonzero(counts == count).squeeze(1)
        error[group, count], base[group, count] = 0.0, surfels["view_base"][group]
        first = surfels["view_span"][group, 0].long()
        terms[count][group] = surfels["view_terms"][first[:, None] + torch.arange(count, device=first.device)]
        if count == 0 or len(group) == 0:
            continue
        done = 0
        centers = centers_of(cameras, error)
        for at in view_directions(surfels["means"][group], (weights > 0)[:, group], centers):
            rows = group[at.rows]
            own = {name: surfels[name][rows] for name in ("view_base", "view_span")}
            blind, counts_blind = _blind(surfels["means"][rows], weights[:, rows], centers, scene.near)
            weight = torch.cat([_weights(at, weights[:, rows]), counts_blind], dim=1)
            at = replace(at, unit=torch.cat([at.unit, blind], dim=1))
            target = shown_at(kind, {**own, "view_terms": surfels["view_terms"]}, at.unit)
            fewer = range(1, count) if entry.sites is not None else range(0)
            sites = (base[rows, count], terms[count][rows])
            for number, b, t in [_one_color(target, weight, entry), *_fewer(at, weight, sites, fewer)]:
                shown = shown_at(kind, _lean(b, t), at.unit)
                found = ((shown - target).square().sum(2) * weight).sum(1)
                bad = beyond("view_base", kind, b).any(1) | beyond("view_terms", kind, t).flatten(1).any(1)
                error[rows, number] = found.masked_fill(bad | ~found.isfinite(), torch.inf)
                base[rows, number] = b
                if number:
                    terms[number][rows] = t
            done += len(rows)
            progress("choosing the view colours", done, len(group))
    return ColorChoices(error.cpu(), base.cpu(), {number: values.cpu() for number, values in terms.items()})


def _weights(at: Directions, weights: Tensor) -> Tensor:
    """[n, D] how much an error at each direction counts, of the weights [V, n] of the views."""
    of_views = weights.T.gather(1, at.view) * at.valid[:, : at.views]
    rest = at.valid.shape[1] - at.views
    between = (1 - VIEW_SHARE) * of_views.sum(1, keepdim=True) / max(1, rest)
    return torch.cat([VIEW_SHARE * of_views, between.expand(-1, rest)], dim=1)


def _blind(means: Tensor, weights: Tensor, centers: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Directions [n, BLIND, 3] from the nearest views that do not show a surfel, and how much each counts: by what the
    views that do show would show from there, by the square of the distance; none from where there is no such view.
    `means` [n, 3], `weights` [V, n] of the views, `centers` [V, 3] float64."""
    offset = means.double()[:, None] - centers.to(means.device)  # [n, V, 3]
    square, shows = offset.square().sum(2).clamp(min=near * near), weights.T > 0
    from_unit = (weights.T * square).sum(1) / shows.sum(1).clamp(min=1)
    nearest = square.masked_fill(shows, torch.inf).topk(min(BLIND, len(centers)), largest=False)
    unit = F.normalize(offset.gather(1, nearest.indices[..., None].expand(-1, -1, 3)), dim=2)
    return unit.to(means), (BLIND_SHARE * from_unit[:, None] / nearest.values).to(means)


def _one_color(target: Tensor, weight: Tensor, entry: ViewColor) -> tuple[int, Tensor, Tensor]:
    """The mean colour."""
    weight = weight + LEAST_WEIGHT
    mean = (target * weight[..., None]).sum(1) / weight.sum(1, keepdim=True)
    return 0, (mean - COLOR_BIAS) / entry.base_unit, target.new_zeros(len(target), 0, entry.lean_width)


def _fewer(
    at: Directions, weight: Tensor, own: tuple[Tensor, Tensor], numbers: range
) -> list[tuple[int, Tensor, Tensor]]:
    """(number of terms, base [n, 3], terms [n, number, 6]) of fitted sites, of the base and the terms there are."""
    if not numbers:
        return []
    base, terms = own
    vectors, rgb = F.pad(terms[..., :3], (0, 0, 1, 0)), torch.cat([base[:, None], terms[..., 3:]], dim=1)
    counts = at.subset(weight, FIT_VIEWS)
    fit = fewer_sites(at, counts / counts.mean(1, keepdim=True).clamp(min=1e-20), vectors, rgb)
    return [(number, *fit(number + 1, slice(None))) for number in numbers]


def _lean(base: Tensor, terms: Tensor) -> dict[str, Tensor]:
    n, number = terms.shape[:2]
    first = number * torch.arange(n, device=base.device)
    span = torch.stack([first, torch.full_like(first, number)], dim=1).int()
    return {"view_base": base, "view_span": span, "view_terms": terms.flatten(0, 1)}
