"""Families of scenes that grow stiffer along one number each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from bitymi_ns.measure.stability.scenes import SceneCase, front_scene, quaternions, random_scene, with_params


@dataclass(frozen=True)
class Sweep:
    """One kind of stiffness.

    Attributes:
        name: short, for tables.
        axis: what the number is, with its unit.
        values: from easy to hard.
        make: the scene of a value; all scenes of a sweep differ in what the number says only.
        near: nearest depth that is drawn, of a value.
    """

    name: str
    axis: str
    values: tuple[float, ...]
    make: Callable[[float], SceneCase]
    near: Callable[[float], float] = lambda value: 0.2


def decades(first: int, last: int) -> tuple[float, ...]:
    """Powers of ten."""
    step = 1 if last > first else -1
    return tuple(10.0**k for k in range(first, last + step, step))


N, WIDTH, HEIGHT = 16, 24, 16


def _edge_on(angle: float) -> SceneCase:
    """Every disc's plane makes this angle with the ray through its centre."""
    base = front_scene(N, 0, WIDTH, HEIGHT, scale=0.5)
    ray = torch.nn.functional.normalize(base.params["means"], dim=-1)
    helper = torch.tensor([[0.3, 1.0, 0.2]], dtype=torch.float64).expand(N, 3)
    side = torch.nn.functional.normalize(torch.linalg.cross(ray, helper), dim=-1)
    up = torch.linalg.cross(side, ray)
    along = math.cos(angle) * ray + math.sin(angle) * up
    rotation = torch.stack([along, side, torch.linalg.cross(along, side)], dim=-1)
    return with_params(base, f"edge_on_{angle:g}", quats=quaternions(rotation))


def _near_plane(depth: float) -> SceneCase:
    """Discs of scale 0.5 whose centres lie about this deep, half to one and a half times."""
    base = front_scene(N, 1, WIDTH, HEIGHT, scale=0.5)
    means = base.params["means"]
    return with_params(base, f"near_{depth:g}", means=means * (depth / 4.0))


def _beta(beta: float) -> SceneCase:
    base = front_scene(N, 2, WIDTH, HEIGHT)
    return with_params(base, f"beta_{beta:g}", beta_raw=math.log(beta) - math.log(4 - beta))


def _temperature(tau: float) -> SceneCase:
    return with_params(front_scene(N, 3, WIDTH, HEIGHT), f"tau_{tau:g}", sv_log_tau=math.log(tau))


def _axis_ratio(ratio: float) -> SceneCase:
    base = front_scene(N, 4, WIDTH, HEIGHT, scale=0.8)
    logs = base.params["log_scales"].clone()
    logs[:, 1] = logs[:, 0] - math.log(ratio)
    return with_params(base, f"ratio_{ratio:g}", log_scales=logs)


def _world(size: float) -> SceneCase:
    """The scene and its camera, oblique, moved away from the origin; positions are rounded to float32 there."""
    base = random_scene(N, 5, WIDTH, HEIGHT)
    shift = size * torch.tensor([0.6, -0.7, 0.39], dtype=torch.float64)
    viewmat = base.viewmat.clone()
    viewmat[:3, 3] -= viewmat[:3, :3] @ shift
    moved = with_params(base, f"world_{size:g}", means=base.params["means"] + shift)
    return replace(moved, viewmat=viewmat)


def _opacity(transparency: float) -> SceneCase:
    base = front_scene(N, 6, WIDTH, HEIGHT)
    logit = math.log1p(-transparency) - math.log(transparency)
    return with_params(base, f"opacity_{transparency:g}", opacity_logits=logit)


def _layers(count: float) -> SceneCase:
    """Large discs, all over one another, so faint that all of them are seen."""
    n = int(count)
    base = front_scene(n, 7, 8, 6, scale=2.0)
    opacity = min(0.5, max(0.006, 6.0 / n))
    return with_params(base, f"layers_{n}", opacity_logits=math.log(opacity / (1 - opacity)))


SWEEPS: tuple[Sweep, ...] = (
    Sweep("edge-on", "angle between ray and disc [rad]", decades(0, -7), _edge_on),
    Sweep(
        "camera plane",
        "depth of the centres / scale",
        decades(1, -6),
        lambda d: _near_plane(0.5 * d),
        near=lambda d: 0.05 * d,
    ),
    Sweep("beta", "beta", (3.9, 1.0, *decades(-1, -7)), _beta),
    Sweep("temperature", "temperature", (*decades(0, 6),), _temperature),
    Sweep("axis ratio", "axis ratio", decades(0, 6), _axis_ratio),
    Sweep("world size", "distance from the origin / size of the scene", decades(0, 6), _world),
    Sweep("opacity", "1 - opacity", (0.5, *decades(-1, -7)), _opacity),
    Sweep("layers", "layers", (1, 4, 16, 64, 256, 1024), _layers),
)
