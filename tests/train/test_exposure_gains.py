"""Agreement of photographs at points: gains are found, and occlusion, masks and clipping are not mistaken for them."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.gains import estimate_gains
from bitymi_ns.train.views import View
from tests.train.test_step_sizes import fine

SIZE = 64


def plane_views(gains: torch.Tensor, noise: float = 0.0) -> tuple[torch.Tensor, list[View]]:
    """Make points [1500, 3] of a coloured plane, and photographs [V] of it by shifted cameras.

    Args:
        gains: [V, 3] gain of each photograph.
        noise: standard deviation of the pixels.
    """
    g = torch.Generator().manual_seed(0)
    points = torch.cat([torch.rand(1500, 2, generator=g) * 2 - 1, torch.zeros(1500, 1)], -1)
    views = []
    for i, gain in enumerate(gains):
        viewmat = torch.eye(4)
        viewmat[:3, 3] = torch.tensor([0.1 * math.cos(i), 0.1 * math.sin(i), 3.0])
        K = torch.tensor([[SIZE * 1.2, 0, SIZE / 2], [0, SIZE * 1.2, SIZE / 2], [0, 0, 1.0]])
        x, y = (torch.arange(SIZE) + 0.5 - SIZE / 2) / (SIZE * 1.2) * 3.0, None
        x, y = x - viewmat[0, 3], x - viewmat[1, 3]
        image = torch.stack(
            [0.4 + 0.15 * torch.sin((2 + c) * x)[None] * torch.cos((3 - c) * y)[:, None] for c in range(3)], -1
        )
        image = image * gain + noise * torch.randn(image.shape, generator=g)
        views.append(View(Camera(viewmat, K, SIZE, SIZE), image.clamp(0.0, 1.0)))
    return points, views


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.floats(0.03, 0.4))
def test_gains_are_found(seed: int, spread: float) -> None:
    logs = spread * (2 * torch.rand(8, 3, generator=torch.Generator().manual_seed(seed)) - 1)
    points, views = plane_views(logs.exp(), noise=0.003)
    found = estimate_gains(points, views, 0.02)
    torch.testing.assert_close(found.log_gains, logs - logs.mean(0), rtol=0, atol=0.02)
    torch.testing.assert_close(found.log_gains.mean(0), torch.zeros(3), rtol=0, atol=1e-6)
    assert found.explained > 0.2


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
def test_photographs_that_agree_are_left_alone(noise: float) -> None:
    points, views = plane_views(torch.ones(8, 3), noise)
    found = estimate_gains(points, views, 0.02)
    assert found.explained < 0.02 and found.log_gains.abs().max() < 0.05


def test_masks_transparency_bytes_and_reduced_pictures(ball) -> None:
    logs = torch.linspace(-0.2, 0.2, 8)[:, None].expand(-1, 3)
    points, views = plane_views(logs.exp())
    wrong = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    wrong[:, : SIZE // 2] = True
    other = [v.image.where(~wrong[..., None], torch.full((), 0.1 * (i % 3 + 1))) for i, v in enumerate(views)]
    alpha = (~wrong).float()[..., None]
    kinds = {
        "mask": [View(v.camera, torch.where(wrong[..., None], math.nan, v.image), ~wrong) for v in views],
        "alpha": [View(v.camera, torch.cat([image, alpha], -1)) for v, image in zip(views, other, strict=True)],
        "bytes": [v._replace(image=(255 * v.image).round().to(torch.uint8)) for v in views],
        "half": [v._replace(image=v.image[::2, ::2].contiguous()) for v in views],
    }
    for kind, made in kinds.items():
        torch.testing.assert_close(estimate_gains(points, made, 0.02).log_gains, logs, rtol=0, atol=0.03, msg=kind)


def test_clipped_and_black_pixels_do_not_count() -> None:
    points, views = plane_views(torch.ones(6, 3))
    clipped = [v._replace(image=torch.ones_like(v.image) if i % 2 else torch.zeros_like(v.image))
               for i, v in enumerate(views)]  # fmt: skip
    found = estimate_gains(points, clipped, 0.02)
    assert found.points.tolist() == [0] * 6 and math.isnan(found.explained) and not found.log_gains.any()


@pytest.mark.parametrize(("by", "count"), [(1.0, 600), (30.0, 600), (1.0, 6000)])
def test_points_on_the_far_side_are_not_taken_for_exposure(views, by: float, count: int) -> None:
    """The ball's colours differ by side: points seen through it, also through long lenses, would give views gains."""
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    found = estimate_gains(points, fine(views, by), 0.01)
    assert math.isnan(found.explained) or found.explained < 0.05
    assert float(found.log_gains.abs().max()) < 0.05


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.full((5, 3), math.nan), torch.tensor([[0.0, 0.0, -9.0]])])
def test_points_that_no_photograph_shows(points) -> None:
    found = estimate_gains(points, plane_views(torch.ones(4, 3))[1], 0.02)
    assert math.isnan(found.explained) and not found.log_gains.any()
