from dataclasses import replace

import pytest
import torch

from bitymi_ns.ops import Fragments, soft_overdraw
from bitymi_ns.ops.fragment_list import Layout


def a_list(weight: torch.Tensor, width: int = 4, height: int = 3) -> Fragments:
    """Make fragments that cycle through the pixels."""
    n = len(weight)
    pixel = torch.arange(n, dtype=torch.int32) % (width * height)
    nothing = torch.zeros(n)
    layout = Layout(None, {}, lambda: {"surfel": pixel, "pixel": pixel})
    return Fragments(weight, nothing.expand(2, n), nothing, nothing, width, height, layout, n)


def test_soft_overdraw_is_the_sum_over_a_pixel():
    w = torch.rand(50, generator=torch.Generator().manual_seed(0))
    fragments = a_list(w)
    expected = torch.zeros(12, dtype=torch.float64)
    for pixel, weight in zip(fragments.pixel.tolist(), w.double().tolist(), strict=True):
        expected[pixel] += weight / (weight + 0.005)
    torch.testing.assert_close(soft_overdraw(fragments, 0.005).double(), expected, rtol=1e-6, atol=0)
    # a tiny half gives the count
    count = fragments.overdraw().flatten().float()
    torch.testing.assert_close(soft_overdraw(fragments, 1e-12), count, rtol=1e-6, atol=0)
    w = torch.linspace(1e-4, 1, 50, dtype=torch.float64, requires_grad=True)
    for half in (1e-9, 0.005, 10.0):
        torch.autograd.gradcheck(lambda w, half=half: soft_overdraw(replace(a_list(w.detach()), weight=w), half), w)


def test_soft_overdraw_of_extreme_weights_is_finite():
    w = torch.tensor([0.0, 1e-45, 1e-38, 1e-30, 1e-8, 1.0], requires_grad=True)
    count = soft_overdraw(a_list(w), 1e-9)
    count.sum().backward()
    assert torch.isfinite(count).all() and torch.isfinite(w.grad).all() and (w.grad >= 0).all()
    assert (soft_overdraw(a_list(w[:0]), 0.005) == 0).all()
    with pytest.raises(ValueError, match="must be above 0, not 0"):
        soft_overdraw(a_list(w), 0.0)
