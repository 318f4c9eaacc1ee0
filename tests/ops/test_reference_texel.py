"""The float64 reference of the bilinear texel fetch."""

import torch

from bitymi_ns.ops.reference.render import texel, texel_centers


def test_at_a_texel_centre_the_texel_itself() -> None:
    tile = torch.rand(4, 8, 3, dtype=torch.float64)
    v, u = torch.meshgrid(texel_centers(4), texel_centers(8), indexing="ij")
    out = texel(tile, torch.stack([u, v], dim=-1).reshape(-1, 2))
    assert torch.allclose(out, tile.reshape(-1, 3), atol=1e-14)
    one = torch.tensor([[[0.5]]], dtype=torch.float64)
    assert torch.equal(texel(one, torch.tensor([[-3.0, 3.0]], dtype=torch.float64)), one[0])
    tile = torch.rand(4, 4, 2, dtype=torch.float64, requires_grad=True)
    uv = torch.tensor([[0.3, -0.7], [1.4, 1.9]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(texel, (tile, uv))


def test_linear_between_texel_centres_and_constant_beyond() -> None:
    u, v = texel_centers(8), texel_centers(4)
    tile = (2 * u[None, :] - v[:, None])[..., None]  # [4, 8, 1], linear in (u, v)
    uv = torch.tensor([[0.3, -0.7], [2.1, 1.9], [-3.0, 0.0], [3.0, 3.0], [99.0, -99.0]], dtype=torch.float64)
    inside = torch.stack([uv[:, 0].clamp(u[0], u[-1]), uv[:, 1].clamp(v[0], v[-1])], dim=-1)
    assert torch.allclose(texel(tile, uv)[:, 0], 2 * inside[:, 0] - inside[:, 1], atol=1e-14)
