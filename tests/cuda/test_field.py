"""The residual field on CUDA: at points, fragments and texels."""

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.scene import HashField
from tests.cuda.conftest import HERE, in_orders
from tests.ops.golden import random_scene, traced, values_of
from tests.ops.test_kernels import make_field, relative


def points(count: int, device: torch.device, dtype: torch.dtype, close: bool = False) -> Tensor:
    """Draw points [count, 3]; close: neighbours in the list share cells of coarse levels."""
    g = torch.Generator().manual_seed(count)
    x = torch.randn(count, 3, generator=g, dtype=torch.float64) * 2
    if close:
        x = x[:1] + 0.3 * torch.arange(count)[:, None] / count
    return x.to(device, dtype)


def value_and_gradients(field: HashField, x: Tensor) -> list[Tensor]:
    """Compute rho, and the gradients of x, table and weights for a fixed direction, on the CPU in double."""
    x = x.clone().requires_grad_()
    field.zero_grad()
    rho = field(x)
    (rho * torch.cos(torch.arange(rho.numel(), device=rho.device).double()).view_as(rho).to(rho)).sum().backward()
    return [t.detach().cpu().double() for t in (rho, x.grad, *(p.grad for p in field.parameters()))]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
@pytest.mark.parametrize("contract", [True, False])
@pytest.mark.parametrize(("count", "close"), [(1, False), (31, False), (33, False), (300, False), (300, True)])
def test_values_and_gradients_against_the_cpu(
    count: int, close: bool, contract: bool, dtype: torch.dtype, both
) -> None:
    """Against the CPU, which tests/ops checks against the reference and finite differences."""
    field = make_field(contract, dtype)
    got, want = both(lambda where: value_and_gradients(field.to(where), points(count, where, dtype, close)))
    for a, b in zip(got, want, strict=True):
        assert relative(a, b) < (1e-11 if dtype == torch.float64 else 2e-4)


def test_no_points_and_points_far_away(device: torch.device) -> None:
    field = make_field(True, torch.float32).to(device)
    none = torch.zeros(0, 3, device=device, requires_grad=True)
    field(none).sum().backward()
    assert none.grad.shape == (0, 3) and all(not p.grad.any() for p in field.parameters())
    far = torch.tensor([[1e30, -1e30, 1e30], [3e38, 0, 0], [1e6, 1e6, 1e6]], device=device, requires_grad=True)
    field(far).sum().backward()
    assert far.grad.isfinite().all() and all(p.grad.isfinite().all() for p in field.parameters())


class Shading:
    """A random view of surfels with a field; its image and gradients by either backend."""

    def __init__(self, dtype: torch.dtype, case=None) -> None:
        self.case, self.dtype = case or random_scene(25, 11, width=20, height=18, scale=0.4), dtype
        self.base = torch.linspace(-0.8, 0.8, 3 * len(self.case.params["means"]), dtype=dtype).view(-1, 3)
        self.field = make_field(True, dtype, log2=6)

    def run(self, device: torch.device, mode: str, bound: float = 0.05) -> list[Tensor]:
        """Compute the image, and the gradients of base colours, frames, uv, table and weights that the mode has."""
        case = self.case
        with torch.no_grad():
            fragments, projection = traced(case, values_of(case, self.dtype, device))
        leaves = [t.to(device).clone().requires_grad_() for t in (self.base, projection.frames)]
        fragments.uv.requires_grad_()
        params = [w.detach().to(device).requires_grad_(mode in ("learn", "move")) for w in self.field.weights]
        rho = ops.fragment_residual(fragments, leaves[1], self.field.geometry, params, bound, mode == "move")
        image = ops.blended_image(fragments, projection, leaves[0], residual=rho)
        along = torch.cos(torch.arange(image.numel(), device=device).double()).view_as(image).to(image)
        (image * along).sum().backward()
        order = torch.argsort(fragments.pixel.long() * len(self.base) + fragments.surfel)  # independent of the backend
        duv = None if fragments.uv.grad is None else fragments.uv.grad[:, order]
        grads = [*(t.grad for t in leaves), duv, *(t.grad for t in params)]
        return [t.detach().cpu().double() for t in (image, *grads) if t is not None]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["double", "single"])
@pytest.mark.parametrize("mode", ["frozen", "learn", "move"])
def test_shading_against_the_cpu(mode: str, dtype: torch.dtype, both) -> None:
    shading = Shading(dtype)
    got, want = both(lambda where: shading.run(where, mode))
    assert len(got) == len(want) == {"frozen": 2, "learn": 6, "move": 8}[mode]
    for a, b in zip(got, want, strict=True):
        assert b.abs().max() > 0
        assert relative(a, b) < (1e-11 if dtype == torch.float64 else 2e-4)


def test_without_fragments(device: torch.device, cpu) -> None:
    case = random_scene(3, 0, width=8, height=8)
    case.params["opacity_logits"].fill_(-20.0)
    shading = Shading(torch.float32, case)
    image, *grads = shading.run(device, "move")
    assert not image.any() and not any(g.any() for g in grads)


def test_deterministic_sums_do_not_depend_on_the_order_of_threads(device: torch.device, cpu, exactly) -> None:
    shading = Shading(torch.float32)
    first, *others = in_orders(device, lambda: shading.run(device, "move"))
    assert all(torch.equal(a, b) for other in others for a, b in zip(first, other, strict=True))
    with cpu():
        want = shading.run(HERE, "move")
    for a, b in zip(first, want, strict=True):
        assert relative(a, b) < 2e-4


def test_deterministic_sums_at_points_and_frozen(both, exactly) -> None:
    shading = Shading(torch.float64)

    def sums(where: torch.device) -> list[Tensor]:
        at_points = value_and_gradients(shading.field.to(where), points(99, where, torch.float64))
        return [*shading.run(where, "frozen"), *at_points]

    for a, b in zip(*both(sums), strict=True):
        assert relative(a, b) < 1e-9


def test_a_gradient_that_is_not_finite_is_not_hidden_by_deterministic_sums(device: torch.device, exactly) -> None:
    field = make_field(True, torch.float32).to(device)
    rho = field(points(40, device, torch.float32))
    rho.backward(torch.full_like(rho, float("nan")))
    assert field.field_table.grad.isnan().any()
