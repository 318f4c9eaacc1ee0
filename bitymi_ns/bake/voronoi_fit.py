"""Spherical Voronoi colours with fewer sites: which sites may go, and the least-squares fit of those that are left."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from bitymi_ns.bake.directions import Directions
from bitymi_ns.ops.view_kinds import fibonacci_sphere

FIT_STEPS = 6
FIT_VIEWS = 16  # views of a surfel in the fit; the error is measured in all of them
OUTSIDE, OUTSIDE_WEIGHT = 12, 0.05
"""Directions over the whole sphere, and their weight, in the fit: where no view is, the colour follows the trained one
loosely instead of diverging."""


def site_weights(vectors: Tensor, directions: Tensor) -> Tensor:
    """softmax_k(v_k . d): [n, D, K] from [n, K, 3] and [n, D, 3]."""
    return torch.softmax(directions @ vectors.transpose(1, 2), dim=2)


def least_needed(vectors: Tensor, rgb: Tensor, directions: Tensor, weight: Tensor) -> list[Tensor]:
    """Sites in the order in which they can be done without.

    Without site k the colour changes by w_k / (1 - w_k) (c - rgb_k); the site goes for which the weighted sum of its
    squares is least.

    Args:
        vectors, rgb: [n, K, 3].
        directions: [n, D, 3].
        weight: [n, D] how much a direction counts.

    Returns:
        for every number of sites from 1 to K - 1 the sites that are left, [n, number] int64.
    """
    n, count = vectors.shape[:2]
    alive = torch.ones(n, count, dtype=torch.bool, device=vectors.device)
    logits = directions @ vectors.transpose(1, 2)
    left: list[Tensor] = []
    for size in range(count - 1, 0, -1):
        w = torch.softmax(logits.masked_fill(~alive[:, None], -torch.inf), dim=2)  # [n, D, K]
        c = w @ rgb
        square = (rgb[:, None] - c[:, :, None]).square().sum(3)  # [n, D, K]
        cost = ((w / (1 - w).clamp(min=1e-6)).square() * square * weight[..., None]).sum(1)
        gone = cost.masked_fill(~alive, torch.inf).argmin(1, keepdim=True)
        alive = alive.scatter(1, gone, False)
        left.insert(0, alive.to(torch.uint8).topk(size, dim=1).indices)
    return left


def fit_sites(
    vectors: Tensor, rgb: Tensor, directions: Tensor, target: Tensor, weight: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Levenberg-Marquardt on sum over the directions of weight |c(d) - target(d)|^2; site 0 has the vector 0.

    Args:
        vectors: [n, K, 3] start, of the sites from the second on, relative to the first.
        rgb: [n, K + 1, 3] start.
        directions, target: [n, D, 3].
        weight: [n, D].
        steps: steps; one that makes a surfel's sum larger is not taken, and its next is shorter.

    Returns:
        vectors and rgb of the same shapes.
    """
    n, terms = vectors.shape[:2]
    sites, linear = terms + 1, 3 * terms
    damping = vectors.new_full((n,), 1e-3)
    pairs = (directions[..., :, None] * directions[..., None, :]).flatten(2)  # [n, D, 9]
    eye = torch.eye(3, device=vectors.device)

    def evaluate(vectors: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        w = site_weights(F.pad(vectors, (0, 0, 1, 0)), directions)
        error = w @ rgb - target
        return w, error, (error.square().sum(2) * weight).sum(1)

    w, error, cost = evaluate(vectors, rgb)
    for _ in range(steps):
        c = error + target
        a = w[..., 1:, None] * (rgb[:, None, 1:] - c[:, :, None])  # d c / d logit: [n, D, K, 3]
        qa = weight[..., None, None] * a
        bb = (qa @ a.transpose(2, 3)).flatten(2).transpose(1, 2) @ pairs  # [n, K K, 9]
        bb = bb.view(n, terms, terms, 3, 3).transpose(2, 3).reshape(n, linear, linear)
        cross = (directions[..., :, None] * w[..., None, :]).flatten(2)  # [n, D, 3 (K + 1)]
        br = (qa.flatten(2).transpose(1, 2) @ cross).view(n, terms, 3, 3, sites)  # terms, channel, axis, site
        br = br.permute(0, 1, 3, 4, 2).reshape(n, linear, 3 * sites)
        wq = (weight[..., None] * w).transpose(1, 2)
        rr = ((wq @ w)[:, :, None, :, None] * eye[:, None, :]).reshape(n, 3 * sites, 3 * sites)
        normal = torch.cat([torch.cat([bb, br], 2), torch.cat([br.transpose(1, 2), rr], 2)], 1)
        right = torch.cat(
            [((qa @ error[..., None])[..., 0].transpose(1, 2) @ directions).flatten(1), (wq @ error).flatten(1)], 1
        )
        diagonal = normal.diagonal(dim1=1, dim2=2)
        floor = 1e-4 * diagonal.mean(1, keepdim=True) + 1e-8
        factor, _ = torch.linalg.cholesky_ex(normal + torch.diag_embed(damping[:, None] * (diagonal + floor)))
        step = torch.cholesky_solve(right[..., None], factor)[..., 0]
        tried = (vectors - step[:, :linear].view_as(vectors), rgb - step[:, linear:].view_as(rgb))
        new_w, new_error, new_cost = evaluate(*tried)
        better = new_cost < cost  # false where it is not finite

        def take(new: Tensor, old: Tensor, better: Tensor = better) -> Tensor:
            return torch.where(better.view(-1, *[1] * (old.dim() - 1)), new, old)

        vectors, rgb = take(tried[0], vectors), take(tried[1], rgb)
        w, error, cost = take(new_w, w), take(new_error, error), take(new_cost, cost)
        damping = torch.where(better, 0.3 * damping, 8.0 * damping)
    return vectors, rgb


def fewer_sites(
    at: Directions, weight: Tensor, vectors: Tensor, rgb: Tensor
) -> Callable[[int, Tensor | slice], tuple[Tensor, Tensor]]:
    """Fits of the sites that are hardest to do without.

    Args:
        weight: [n, D'] of those that `Directions.subset` leaves.
        vectors, rgb: [n, K, 3] of all sites.

    Returns:
        a function of a number of sites below K, and of rows, to base [m, 3] and terms [m, number - 1, 6].
    """
    outside = fibonacci_sphere(OUTSIDE).to(vectors).expand(len(vectors), -1, -1)
    samples = torch.cat([at.subset(at.unit, FIT_VIEWS), outside], dim=1)
    weight = F.pad(weight, (0, OUTSIDE), value=OUTSIDE_WEIGHT)
    colors = site_weights(vectors, samples) @ rgb
    left = least_needed(vectors, rgb, samples, weight)

    def fit(number: int, rows: Tensor | slice) -> tuple[Tensor, Tensor]:
        kept = left[number - 1][rows, :, None].expand(-1, -1, 3)
        v, r = vectors[rows].gather(1, kept), rgb[rows].gather(1, kept)
        b, r = fit_sites(v[:, 1:] - v[:, :1], r, samples[rows], colors[rows], weight[rows], FIT_STEPS)
        return r[:, 0], torch.cat([b, r[:, 1:]], dim=2)

    return fit
