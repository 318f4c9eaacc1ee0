"""The field's float64 reference against nerfstudio's hash encoding and closed forms."""

import pytest
import torch

from bitymi_ns.ops.reference.field import contract, encode, field, hash_index


def rand(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_encoding_agrees_with_nerfstudio() -> None:
    """nerfstudio's levels have floor(min_res growth^l) cells; with growth 2 both agree."""
    encodings = pytest.importorskip("nerfstudio.field_components.encodings")
    levels, size, features = 4, 12, 4
    other = encodings.HashEncoding(levels, 16, 128, size, features, implementation="torch")
    other.scalings = 16.0 * 2.0 ** torch.arange(levels)  # avoids its floor of inexact powers
    other.hash_table.data = other.hash_table.data.double()
    c = torch.cat([rand(200, 3), torch.tensor([[0.0, 0.5, 1.0], [0.25, 0.25, 0.75]], dtype=torch.float64)])
    mine = c.clone().requires_grad_()
    theirs = c.clone().requires_grad_()
    table = other.hash_table.detach().reshape(levels, 2**size, features).clone().requires_grad_()
    weight = rand(len(c), levels * features, seed=1)
    (encode(mine, table, 16) * weight).sum().backward()
    (other(theirs) * weight).sum().backward()
    assert torch.allclose(encode(c, table, 16), other(c), atol=1e-12)
    assert torch.allclose(table.grad, other.hash_table.grad.reshape(table.shape), atol=1e-12)
    assert torch.allclose(mine.grad[:200], theirs.grad[:200], atol=1e-9)  # slopes on a cell's face are one-sided


def test_hash_is_uint32_arithmetic() -> None:
    corners = [(0, 0, 0), (1, 2, 3), (2047, 2048, 1999), (2048, 0, 2048)]
    for size in (2**4, 2**19, 2**21):
        for x, y, z in corners:
            expected = (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % size
            assert int(hash_index(torch.tensor([[x, y, z]]), size)) == expected


def test_contraction() -> None:
    mid, half = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64), 3.0
    direction = torch.nn.functional.normalize(rand(20, 3) - 0.5, dim=-1)
    for radius, expected in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0), (2.0, 1.5), (10.0, 1.9), (1e9, 2 - 1e-9)):
        c = contract(mid + half * radius * direction, mid, half)
        assert torch.allclose(4 * c - 2, expected * direction, atol=1e-12)
    far = contract(mid + 1e6 * torch.eye(3, dtype=torch.float64), mid, half)
    assert far.max() <= 1 and far.min() >= 0
    box = contract(mid + half * torch.tensor([[-1.0, 0.0, 1.0], [-9.0, 0.5, 9.0]]).double(), mid, half, False)
    assert torch.allclose(box, torch.tensor([[0.0, 0.5, 1.0], [0.0, 0.75, 1.0]], dtype=torch.float64))


def test_gradients() -> None:
    """Finite differences inside and outside the unit ball."""
    table, mid = 0.5 * rand(2, 2**6, 4), torch.zeros(3, dtype=torch.float64)
    w1, w2, w3 = rand(8, 16, seed=1) - 0.5, rand(16, 16, seed=2) - 0.5, rand(16, 3, seed=3) - 0.5
    x = torch.cat([rand(4, 3, seed=4), 3 * rand(4, 3, seed=5) + 1])
    inputs = [t.requires_grad_() for t in (x, table, w1, w2, w3)]
    assert torch.autograd.gradcheck(lambda *a: field(*a, mid, 1.5, 4), inputs, atol=1e-6)
