"""The kernels of the cosine transform of texels against float64 implementations."""

import numpy as np
import pytest
import torch

from bitymi_ns.codec import texel_codes as module
from bitymi_ns.codec.texel_codes import Blocks, TexelCoder, blocks_of
from bitymi_ns.ops import backend

SIZES = [[0, 0], [4, 4], [8, 16], [0, 0], [32, 8], [2, 1], [1, 8], [64, 64], [4, 2]]


def basis_of(blocks: Blocks) -> torch.Tensor:
    """Compute the basis [coefficients, texels] of a block, in coefficient order, in float64."""
    b_u, b_v = blocks.size
    v, u = module._cosines(b_v).double(), module._cosines(b_u).double()
    rows, columns = (list(each) for each in zip(*blocks.order, strict=True))
    return (v[rows][:, :, None] * u[columns][:, None, :]).reshape(len(rows), b_v * b_u)


def block_arguments(blocks: Blocks, dtype: torch.dtype) -> dict:
    found = module._block_arguments(blocks)
    return found | {name: found[name].to(dtype) for name in ("down", "across")}


def definition(blocks: Blocks, texels, weights, means, steps, rounds: int) -> torch.Tensor:
    """Compute [coefficients, B, C] in steps, unrounded: `rounds` iterations of ISTA by matrix products."""
    basis, mix = basis_of(blocks), module._CHANNELS[texels.shape[1]].double()
    flat = blocks.texels.reshape(len(blocks.tile), -1)
    target = (texels[flat] - means[blocks.tile, None]) @ mix.T  # [B, texels, C]
    weight, step = weights[flat][..., None], steps[blocks.tile, None, None]
    most = weight.amax(1, keepdim=True)
    threshold = module.SHRINK * step * weight.mean(1, keepdim=True) / most
    values = basis @ target
    for _ in range(rounds):
        values = values + basis @ (weight / most * (target - basis.T @ values))
        shrunk = torch.sign(values) * (values.abs() - threshold).clamp(min=0)
        values = torch.cat([values[:, :1], shrunk[:, 1:]], 1)  # the constant is not shrunk
    return (values / step).transpose(0, 1)


@pytest.mark.parametrize("rounds", [0, 1, 8])
@pytest.mark.parametrize("channels", [3, 1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_coefficients_are_those_of_the_definition(dtype, channels, rounds):
    generator = torch.Generator().manual_seed(channels)
    sizes = torch.tensor(SIZES)
    count = int(sizes.clamp(min=1).prod(1).sum())
    texels = (torch.rand(count, channels, generator=generator) - 0.5).to(dtype)
    weights = torch.rand(count, generator=generator).to(dtype) ** 4 + 1e-3
    means = torch.rand(7, channels, generator=generator).to(dtype)
    steps = torch.rand(7, generator=generator).to(dtype) * 0.05 + 0.01
    for blocks in blocks_of(sizes):
        codes = torch.full((len(blocks.order), len(blocks.tile), channels), 99, dtype=torch.int32)
        backend.kernel("sparse_cosines", texels)(
            values=texels, weights=weights, mean=means, step=steps, rounds=rounds, channels=channels,
            shrink=module.SHRINK, mix=module._CHANNELS[channels].to(dtype), codes=codes,
            **block_arguments(blocks, dtype),
        )  # fmt: skip
        exact = definition(blocks, *(x.double() for x in (texels, weights, means, steps)), rounds)
        away = (codes - exact).abs()
        assert away.max() <= 0.5 + 1e-3
        close = (exact - exact.floor() - 0.5).abs() > 1e-3  # except near rounding ties
        expected = torch.sign(exact) * torch.floor(exact.abs() + 0.5)
        assert torch.equal(codes[close].double(), expected[close]) and close.double().mean() > 0.9


@pytest.mark.parametrize("channels", [3, 1])
@pytest.mark.parametrize(("dtype", "digits"), [(torch.float32, 2e-6), (torch.float64, 1e-14)])
def test_decoded_texels_are_those_of_the_definition(dtype, digits, channels):
    generator = torch.Generator().manual_seed(channels)
    sizes = torch.tensor(SIZES)
    means, steps = (torch.rand(7, c, generator=generator).to(dtype) for c in (channels, 1))
    values = torch.full((int(sizes.clamp(min=1).prod(1).sum()), channels), 99.0, dtype=dtype)
    mix, want = module._CHANNELS[channels], values.double()
    for blocks in blocks_of(sizes):
        shape = len(blocks.order), len(blocks.tile), channels
        codes = (torch.randn(shape, generator=generator) * 3000).int()
        backend.kernel("decode_cosines", values)(
            mean=means, step=steps[:, 0].contiguous(), mix=mix.to(dtype), channels=channels, codes=codes, values=values,
            **block_arguments(blocks, dtype),
        )  # fmt: skip
        plane = torch.einsum("kbc,kt->btc", codes.double(), basis_of(blocks)) @ mix.double()
        found = plane * steps[blocks.tile, :, None].double() + means[blocks.tile, None].double()
        want[blocks.texels.flatten()] = found.flatten(0, 1)
    assert (values - want).abs().max() <= digits * want.abs().max()
    assert (values[0] == 99).all()  # a constant is in no block


def test_extreme_weights_and_steps_give_finite_coefficients():
    sizes = torch.tensor([[8, 8], [8, 8]])
    weights = torch.cat([torch.zeros(64), torch.logspace(-30, 30, 64)])
    texels = torch.full((128, 3), 40.0)
    texels[::3] = -40.0
    for step in (0.01, 1000.0):
        coder = TexelCoder(sizes, weights, step)
        found = coder.code(texels)
        assert np.isfinite(found.texels().numpy()).all()
    assert (found.texels() - texels).abs().mean() < 60


def test_a_block_that_is_too_large_is_refused():
    one = torch.zeros(1)
    with pytest.raises(ValueError, match="1 to 8 texels"):
        backend.kernel("sparse_cosines", one)(height=16, width=4, rounds=1, channels=1, shrink=0.5)
