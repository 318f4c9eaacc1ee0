"""Spherical harmonics for other programs: against the float64 reference, with exact rotation."""

import torch

from bitymi_ns.interchange import harmonics
from bitymi_ns.ops.reference.view_color import sh_basis
from tests.interchange.conftest import TURN


def directions(count: int) -> torch.Tensor:
    d = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return torch.nn.functional.normalize(d, dim=1)


def test_the_basis_is_that_of_the_reference() -> None:
    d = directions(200)
    assert torch.allclose(harmonics.basis(d), sh_basis(3, d), rtol=0, atol=1e-12)
    assert torch.allclose(harmonics.basis(d.float()), sh_basis(3, d).float(), rtol=0, atol=3e-6)


def test_coefficients_turn_exactly_also_into_a_mirrored_frame() -> None:
    c, d = torch.randn(harmonics.TERMS, 3, dtype=torch.float64), directions(200)
    for matrix in (TURN, -TURN, torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))):
        new = harmonics.rotation_of(matrix) @ c
        assert torch.allclose(sh_basis(3, d) @ new, sh_basis(3, d @ matrix.T) @ c, rtol=0, atol=1e-11)
        back = harmonics.rotation_of(matrix.T) @ new
        assert torch.allclose(back, c, rtol=0, atol=1e-11)
