"""Real spherical harmonics up to degree 3, in the order and with the signs of 3DGS."""

import functools

import torch
from torch import Tensor

from bitymi_ns.ops import view_color
from bitymi_ns.ops.view_kinds import entry_of, fibonacci_sphere

TERMS = 16  # harmonics of degrees 0 to 3
_POWERS = [(i, j, n - i - j) for n in (2, 3) for i in range(n + 1) for j in range(n + 1 - i)]  # 6 + 10 = TERMS


def basis(directions: Tensor) -> Tensor:
    """Evaluate the harmonics, [..., 16], in directions [..., 3], unit vectors. On the sphere they are linear
    combinations of the monomials of degrees 2 and 3; their coefficients are solved for from the compiled kernel, so
    that the formula exists once."""
    return _monomials(directions) @ _from_monomials().to(directions)


def rotation_of(matrix: Tensor) -> Tensor:
    """Compute the matrix [16, 16] float64 that rotates coefficients to another frame. `matrix`: [3, 3] float64,
    orthogonal, also a reflection: a direction d of the new frame is matrix @ d in the old one."""
    directions = fibonacci_sphere(_SAMPLES).double()
    old = basis(torch.nn.functional.normalize(directions @ matrix.T, dim=1))
    return torch.linalg.lstsq(basis(torch.nn.functional.normalize(directions, dim=1)), old).solution


def _monomials(directions: Tensor) -> Tensor:
    x, y, z = directions.unbind(-1)
    powers = [[torch.ones_like(c), c, c * c, c * c * c] for c in (x, y, z)]
    return torch.stack([powers[0][i] * powers[1][j] * powers[2][k] for i, j, k in _POWERS], dim=-1)


@functools.cache
def _from_monomials() -> Tensor:
    directions = torch.nn.functional.normalize(fibonacci_sphere(_SAMPLES).double(), dim=1)
    return torch.linalg.lstsq(_monomials(directions), _of_kernel(directions)).solution


def _of_kernel(directions: Tensor) -> Tensor:
    """Evaluate the compiled kernel for each harmonic in the directions, [D, 16] float64."""
    rows = directions.repeat_interleave(TERMS, 0)
    coefficients = torch.eye(TERMS).to(rows).repeat(len(directions), 1)[..., None].expand(-1, -1, 3)
    parts = coefficients[:, 0].contiguous(), coefficients[:, 1:].contiguous()
    parameters = dict(zip(entry_of("sh").names, parts, strict=True))
    return view_color("sh", parameters, rows, rows.new_zeros(3))[:, 0].view(-1, TERMS)


_SAMPLES = 64
