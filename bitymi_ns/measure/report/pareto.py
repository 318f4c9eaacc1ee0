"""Pareto fronts: the points that no other point beats in both cost and quality."""

from __future__ import annotations

from collections.abc import Sequence


def front(points: Sequence[tuple[float, float]], up: bool) -> list[tuple[float, float]]:
    """The Pareto front of (cost, quality) points, cheapest first.

    Args:
        points: costs, of which less is better, and qualities.
        up: whether more quality is better (PSNR), else less (FLIP).

    Returns:
        The points of which none other is at least as good in both and better in one; equal points once.
    """
    best: list[tuple[float, float]] = []
    for cost, quality in sorted(set(points), key=lambda p: (p[0], -p[1] if up else p[1])):
        if not best or (quality > best[-1][1] if up else quality < best[-1][1]):
            best.append((cost, quality))
    return best
