"""View colours and SSIM by the CUDA kernels."""

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from tests.cuda.conftest import in_orders
from tests.ops.golden import reference_ssim
from tests.ops.test_kernels import relative
from tests.ops.test_view_color import parameters, reduced_parameters

DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
TERMS = {"sv": (7, 3), "sh": (16, 4), "sb": (2, 5), "sg": (2, 3)}
"""Numbers of terms per view colour: one with unrolled kernels, one without."""


@DTYPES
@pytest.mark.parametrize(("kind", "terms"), [(kind, t) for kind, both in TERMS.items() for t in both])
def test_view_colors_and_gradients_against_the_cpu(kind: str, terms: int, dtype: torch.dtype, both) -> None:
    n = 150
    g = torch.Generator().manual_seed(1)
    means, center = torch.randn(n, 3, generator=g, dtype=torch.float64), torch.randn(3, generator=g)
    active = torch.rand(n, generator=g) > 0.3

    def run(device: torch.device) -> list[Tensor]:
        leaves = {k: v.to(device, dtype).requires_grad_() for k, v in parameters(kind, terms, n).items()}
        x = means.to(device, dtype).requires_grad_()
        color = ops.view_color(kind, leaves, x, center.to(device), active.to(device))
        (color * torch.cos(torch.arange(3 * n, device=device).double()).view(n, 3).to(dtype)).sum().backward()
        return [t.detach().cpu().double() for t in (color, x.grad, *(v.grad for v in leaves.values()))]

    got, want = both(run)
    for a, b in zip(got, want, strict=True):
        assert relative(a, b) < (1e-12 if dtype == torch.float64 else 2e-5)
        assert not a[~active].any()


@DTYPES
@pytest.mark.parametrize("kind", list(TERMS))
def test_reduced_view_colors_against_the_cpu(kind: str, dtype: torch.dtype, device: torch.device, cpu) -> None:
    n = 150
    g = torch.Generator().manual_seed(1)
    means, center = torch.randn(n, 3, generator=g, dtype=dtype), torch.randn(3, generator=g)
    active, reduced = torch.rand(n, generator=g) > 0.3, reduced_parameters(kind, n, dtype)
    there = {name: value.to(device) for name, value in reduced.items()}
    got = ops.view_color(kind, there, means.to(device), center.to(device), active.to(device)).cpu()
    with cpu():
        want = ops.view_color(kind, reduced, means, center, active)
    assert relative(got.double(), want.double()) < (1e-12 if dtype == torch.float64 else 2e-5)
    assert not got[~active].any()


def test_view_colors_of_no_surfels(device: torch.device) -> None:
    none = {k: v[:0].to(device).requires_grad_() for k, v in parameters("sv", 7, 1).items()}
    ops.view_color("sv", none, torch.zeros(0, 3, device=device).double(), torch.zeros(3)).sum().backward()


@DTYPES
@pytest.mark.parametrize("size", [(11, 11, 3), (27, 43, 3), (40, 17, 1), (10, 30, 3), (60, 75, 2), (1, 1, 3)])
def test_ssim_and_its_gradient(size: tuple[int, int, int], dtype: torch.dtype, device: torch.device) -> None:
    g = torch.Generator().manual_seed(1)
    a, b = (torch.rand(size, generator=g, dtype=torch.float64) for _ in range(2))
    p, q = a.to(device, dtype, copy=True).requires_grad_(), a.clone().requires_grad_()
    got = ops.ssim(p, b.to(device, dtype))
    (3 * got).backward()
    assert got.shape == () and got.device.type == device.type
    if min(size[:2]) < 11:
        assert got == 1.0 and not p.grad.any()
        return
    want = reference_ssim(q, b)
    (3 * want).backward()
    double = dtype == torch.float64
    assert abs(got.item() - want.item()) < (1e-13 if double else 1e-5)
    assert relative(p.grad.cpu(), q.grad) < (1e-10 if double else 1e-3)


def test_ssim_without_a_gradient_does_not_depend_on_the_order_of_threads(device: torch.device) -> None:
    a, b = torch.rand(50, 90, 3, device=device), torch.rand(50, 90, 3, device=device)
    assert len(set(in_orders(device, lambda: float(ops.ssim(a, b))))) == 1
