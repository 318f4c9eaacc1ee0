"""View colours, full or reduced, against the float64 references."""

import pytest
import torch
from torch import Tensor

from bitymi_ns import ops
from bitymi_ns.ops.reference import view_color as reference_view_color
from bitymi_ns.ops.view_color import check_reduced
from bitymi_ns.ops.view_kinds import VIEW_COLORS


def parameters(kind: str, terms: int, n: int) -> dict[str, Tensor]:
    """Make view colours with all terms."""
    g, entry = torch.Generator().manual_seed(5), VIEW_COLORS[kind]
    shapes = zip(entry.names, entry.shapes(terms), strict=True)
    return {name: torch.randn(n, *shape, generator=g, dtype=torch.float64) for name, shape in shapes}


@pytest.mark.parametrize("kind, terms", [("sv", 7), ("sh", 16), ("sb", 2), ("sg", 2)])
def test_view_colors_against_the_reference_and_gradcheck(kind: str, terms: int) -> None:
    params, g = parameters(kind, terms, 7), torch.Generator().manual_seed(4)
    means, center = (torch.randn(*shape, generator=g, dtype=torch.float64) for shape in ((7, 3), (3,)))
    directions = torch.nn.functional.normalize(means - center, dim=-1)
    want = getattr(reference_view_color, kind)(*params.values(), directions)
    torch.testing.assert_close(ops.view_color(kind, params, means, center), want, rtol=1e-10, atol=1e-12)
    leaves = [value.clone().requires_grad_() for value in (means, *params.values())]

    def function(x: Tensor, *values: Tensor) -> Tensor:
        return ops.view_color(kind, dict(zip(params, values, strict=True)), x, center)

    assert torch.autograd.gradcheck(function, leaves, eps=1e-6, atol=1e-6, rtol=1e-4)


def reduced_parameters(kind: str, n: int, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    """Make reduced colours with 0, 1, 2, ... terms, or whole degrees; the last surfel's terms come first."""
    g = torch.Generator().manual_seed(6)
    counts = torch.tensor([(0, 3, 8, 15)[i % 4] if kind == "sh" else i % 7 for i in range(n)])
    ends = counts.flip(0).cumsum(0).flip(0)
    total = int(counts.sum())
    return {
        "view_base": torch.randn(n, 3, generator=g, dtype=torch.float64).to(dtype),
        "view_span": torch.stack([ends - counts, counts], dim=1).int(),
        "view_terms": torch.randn(total, VIEW_COLORS[kind].reduced_width, generator=g, dtype=torch.float64).to(dtype),
    }


@pytest.mark.parametrize("kind", VIEW_COLORS)
def test_reduced_view_colors_against_the_reference(kind: str) -> None:
    n = 15
    g = torch.Generator().manual_seed(7)
    means, center = torch.randn(n, 3, generator=g, dtype=torch.float64), torch.randn(3, generator=g).double()
    directions = torch.nn.functional.normalize(means - center, dim=-1)
    params = reduced_parameters(kind, n)
    check_reduced(kind, params, n)
    want = reference_view_color.reduced(kind, *params.values(), directions)
    torch.testing.assert_close(ops.view_color(kind, params, means, center), want, rtol=1e-10, atol=1e-12)
    got = ops.view_color(kind, reduced_parameters(kind, n, torch.float32), means.float(), center.float())
    torch.testing.assert_close(got.double(), want, rtol=2e-5, atol=2e-5)


def test_reduced_spherical_voronoi_is_the_same_colour_relative_to_its_first_site() -> None:
    g = torch.Generator().manual_seed(8)
    n = 9
    sites, log_tau, rgb = (torch.randn(n, 7, *s, generator=g, dtype=torch.float64) for s in ((3,), (), (3,)))
    log_tau[0] = 9.0  # one site dominates
    vectors = torch.nn.functional.normalize(sites, dim=-1) * log_tau.exp()[..., None]
    terms = torch.cat([vectors[:, 1:] - vectors[:, :1], rgb[:, 1:]], dim=-1)
    span = torch.stack([6 * torch.arange(n), torch.full((n,), 6)], dim=1).int()
    reduced = {"view_base": rgb[:, 0].contiguous(), "view_span": span, "view_terms": terms.flatten(0, 1)}
    means, center = torch.randn(n, 3, generator=g, dtype=torch.float64), torch.zeros(3)
    full = {"sv_sites": sites, "sv_log_tau": log_tau, "sv_rgb": rgb}
    want = ops.view_color("sv", full, means, center)
    torch.testing.assert_close(ops.view_color("sv", reduced, means, center), want, rtol=1e-9, atol=1e-9)
    active = torch.arange(n) % 2 == 0
    assert not ops.view_color("sv", reduced, means, center, active)[~active].any()


def test_reduced_view_colors_whose_terms_are_not_there_are_refused() -> None:
    good = reduced_parameters("sv", 5)
    for row, value in ((0, -1), (0, 100), (1, -1), (1, 33)):
        bad = {**good, "view_span": good["view_span"].clone()}
        bad["view_span"][4, row] = value
        with pytest.raises(ValueError, match="surfel 4"):
            check_reduced("sv", bad, 5)
        with pytest.raises(ValueError, match="surfel 4"):
            ops.view_color("sv", bad, torch.rand(5, 3).double(), torch.zeros(3))
    with pytest.raises(ValueError, match="view_terms must be"):
        check_reduced("sg", good, 5)
    with pytest.raises(ValueError, match="surfel 1"):
        check_reduced("sh", reduced_parameters("sh", 2) | {"view_span": torch.tensor([[0, 0], [0, 2]]).int()}, 2)


def test_view_colors_of_inactive_surfels_are_zero() -> None:
    params = {"sh_dc": torch.ones(3, 3, requires_grad=True), "sh_rest": torch.ones(3, 15, 3)}
    active = torch.tensor([True, False, True])
    color = ops.view_color("sh", params, torch.rand(3, 3), torch.tensor([0.0, 0.0, -2.0]), active)
    color.sum().backward()
    assert not color[1].any() and not params["sh_dc"].grad[1].any() and params["sh_dc"].grad[0].all()
