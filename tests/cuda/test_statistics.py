"""Densification statistics of a view on CUDA equal those of the CPU."""

import math

import pytest
import torch

from bitymi_ns.ops.project import Projection
from bitymi_ns.scene import Camera, Scene, SceneConfig
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.strategy import STATISTICS, Strategy
from tests.ops.golden import random_scene


def accumulated(device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    """Accumulate a view, and one without any fragment, onto earlier statistics."""
    n, g = 300, torch.Generator().manual_seed(2)
    radii = (torch.rand(n, 2, generator=g) * 9).to(dtype)
    radii[::3] = 0
    grad, absgrad = torch.randn(n, 2, generator=g).to(dtype), torch.rand(n, 2, generator=g).to(dtype)
    grad[1, 0], grad[2, 1], absgrad[4, 0] = math.nan, math.inf, -math.inf
    camera = Camera(torch.eye(4), torch.eye(3), 40, 30)
    broken = torch.zeros(1, dtype=torch.int32)
    projection = Projection(grad, grad, radii.to(device), camera, 0.1, broken)
    projection.mean2d_grad, projection.mean2d_absgrad = grad.to(device), absgrad.to(device)
    scene = Scene(SceneConfig(), random_scene(2, 5).params, None)
    strategy = Strategy(scene, {}, Schedule(TrainConfig(), 30_000))
    strategy.statistics = (torch.rand(len(STATISTICS), n, generator=g) * 5).to(device)
    strategy.accumulate(projection)
    projection.mean2d_grad = projection.mean2d_absgrad = None
    strategy.accumulate(projection)
    return strategy.statistics.cpu()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
def test_statistics(dtype: torch.dtype, both) -> None:
    found, want = both(lambda where: accumulated(where, dtype))
    torch.testing.assert_close(found, want, rtol=1e-6, atol=1e-6)
    assert found.isfinite().all()
