"""The float64 references of view colours against other implementations and closed forms."""

import math

import pytest
import torch
from torch import Tensor

from bitymi_ns.ops.reference.project import unit
from bitymi_ns.ops.reference.view_color import sb, sg, sh, sh_basis, sv


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("degree", range(4))
def test_sh_agrees_with_gsplat(degree: int) -> None:
    impl = pytest.importorskip("gsplat.cuda._torch_impl")
    dirs, dc, rest = unit(normal(40, 3)), normal(40, 3, seed=1), normal(40, 15, 3, seed=2)
    expected = impl._spherical_harmonics(degree, dirs, torch.cat([dc[:, None], rest], dim=1))
    assert torch.allclose(sh(dc, rest[:, : (degree + 1) ** 2 - 1], dirs), expected, atol=1e-13)


def test_sh_basis_is_orthonormal() -> None:
    """Integrates over the sphere by Gauss-Legendre in z and the trapezoidal rule in longitude, exact for degree 6."""
    z = torch.tensor([-0.932469514203152, -0.661209386466265, -0.238619186083197], dtype=torch.float64)
    weight = torch.tensor([0.171324492379170, 0.360761573048139, 0.467913934572691], dtype=torch.float64)
    z, weight = torch.cat([z, -z]), torch.cat([weight, weight])
    phi = torch.arange(8, dtype=torch.float64) * (2 * math.pi / 8)
    zz, pp = torch.meshgrid(z, phi, indexing="ij")
    r = (1 - zz**2).sqrt()
    dirs = torch.stack([r * pp.cos(), r * pp.sin(), zz], dim=-1).reshape(-1, 3)
    w = (weight[:, None] * (2 * math.pi / 8)).expand(6, 8).reshape(-1)
    Y = sh_basis(3, dirs)
    assert torch.allclose((Y * w[:, None]).T @ Y, torch.eye(16, dtype=torch.float64), atol=1e-12)


def test_sv_at_a_high_temperature_is_the_nearest_sites_colour() -> None:
    dirs, sites, rgb = unit(normal(20, 3)), normal(20, 7, 3, seed=1), normal(20, 7, 3, seed=2)
    out = sv(sites, torch.full((20, 7), math.log(1e6), dtype=torch.float64), rgb, dirs)
    nearest = (unit(sites) * dirs[:, None]).sum(-1).argmax(-1)
    assert torch.allclose(out, rgb[torch.arange(20), nearest], atol=1e-6)
    equal = sv(sites, normal(20, 7, seed=3), rgb[:, :1].expand(20, 7, 3), dirs)
    assert torch.allclose(equal, rgb[:, 0], atol=1e-14)


def test_sv_ignores_the_length_of_a_site_and_takes_length_zero() -> None:
    dirs, sites, log_tau, rgb = unit(normal(6, 3)), normal(6, 7, 3, seed=1), normal(6, 7, seed=2), normal(6, 7, 3)
    assert torch.allclose(sv(sites, log_tau, rgb, dirs), sv(100 * sites, log_tau, rgb, dirs), atol=1e-13)
    sites = sites.clone()
    sites[:, 0] = 0
    sites.requires_grad_()
    out = sv(sites, log_tau, rgb, dirs)
    out.sum().backward()
    assert out.isfinite().all() and sites.grad.isfinite().all()


def test_sb_on_the_lobe_axis_behind_it_and_beside_it() -> None:
    """At d = mu the lobe adds softplus(rgb), 0.1 for rgb = 0; behind it, nothing."""
    theta, phi = 0.7, 2.1
    mu = torch.tensor([[math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]]).double()
    lobes = torch.tensor([[[0.0, 0.0, 0.0, theta, phi, 0.3]]], dtype=torch.float64, requires_grad=True)
    base = torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64)
    front = sb(base, lobes, unit(mu))
    assert torch.allclose(front, base + 0.1, atol=1e-6)
    back = sb(base, lobes, -unit(mu))
    assert torch.equal(back, base)
    (front.sum() + back.sum()).backward()
    assert lobes.grad.isfinite().all()
    lobes = torch.tensor([[[0.4, 0.5, 0.6, 0.0, 0.0, -0.2]]], dtype=torch.float64)  # mu = z
    dirs = torch.tensor([[math.sin(0.9), 0.0, math.cos(0.9)]], dtype=torch.float64)
    a = 10 * math.log(2)
    expected = torch.log1p(torch.exp(a * lobes[0, 0, :3])) / a * math.cos(0.9) ** (4 * math.exp(-0.2))
    assert torch.allclose(sb(torch.zeros(1, 3).double(), lobes, dirs)[0], expected, atol=1e-12)


def test_sg_closed_form_and_gradients() -> None:
    lobes = torch.tensor([[[0.0, 0.0, 5.0, math.log(3.0), 0.2, -0.1, 0.4]]], dtype=torch.float64)
    dirs = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    expected = torch.tensor([0.2, -0.1, 0.4]).double() * math.exp(3.0 * (0.8 - 1))
    assert torch.allclose(sg(torch.zeros(1, 3).double(), lobes, dirs)[0], expected, atol=1e-7)
    lobes = normal(4, 2, 7).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: sg(torch.zeros(4, 3).double(), x, unit(normal(4, 3, seed=1))), lobes)
