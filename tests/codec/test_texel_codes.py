"""Texels as integers: fine steps lose nothing, unseen texels cost little, and weights decide where errors are."""

import torch

from bitymi_ns.codec.texel_codes import BLOCK, TexelCodeOptions, TexelCoder, blocks_of

SIZES = torch.tensor([[8, 4], [0, 0], [64, 16], [4, 4], [4, 32], [0, 0], [8, 8]])
COUNT = int(SIZES.clamp(min=1).prod(1).sum())


def noise() -> torch.Tensor:
    return torch.rand(COUNT, 3, generator=torch.Generator().manual_seed(0)) - 0.5


def test_every_texel_of_a_tile_is_in_one_block() -> None:
    blocks = blocks_of(SIZES)
    assert [each.size for each in blocks] == sorted({(min(u, BLOCK), min(v, BLOCK)) for u, v in SIZES.tolist() if u})
    every = torch.cat([each.texels.reshape(-1) for each in blocks])
    area = SIZES.clamp(min=1).prod(1)
    bare = (area.cumsum(0) - area)[SIZES[:, 0] == 0]
    assert sorted([*every.tolist(), *bare.tolist()]) == list(range(COUNT))
    for each in blocks:
        assert bool((each.tile.diff() >= 0).all())
        assert sorted(each.order) == [(v, u) for v in range(each.size[1]) for u in range(each.size[0])]


def test_fine_steps_keep_the_texels() -> None:
    texels = noise()
    coder = TexelCoder(SIZES, torch.ones(COUNT), TexelCodeOptions(step=0.05))
    got = coder.code(texels, rounds=0).texels()
    assert float((got - texels)[_tiled()].abs().max()) < 1e-3
    constants = ~_tiled()
    assert float((got - texels)[constants].abs().max()) <= 2.001 / 255


def test_tiles_that_are_seen_more_are_kept_more_precisely() -> None:
    texels, weights = noise(), torch.full((COUNT,), 0.01)
    first = torch.arange(COUNT) < 32
    weights[first] = 10.0
    coder = TexelCoder(SIZES, weights, TexelCodeOptions(step=7.5))
    error = (coder.code(texels, rounds=0).texels() - texels).square().mean(1)
    assert coder.grades[0] < coder.grades[1:].min()
    assert float(error[first].mean()) < 0.01 * float(error[_tiled() & ~first].mean())


def test_texels_that_nobody_sees_cost_little() -> None:
    texels, weights = noise(), torch.ones(COUNT)
    smooth = torch.full((COUNT, 3), 0.2)
    hidden = torch.arange(COUNT) % 2 == 1
    weights[hidden] = 0.0
    mixed = torch.where(hidden[:, None], texels, smooth)
    options = TexelCodeOptions(step=7.5)
    plain = TexelCoder(SIZES, torch.ones(COUNT), options).code(mixed, rounds=0)
    sparse = TexelCoder(SIZES, weights, options).code(mixed)
    many, few = (sum(int((c != 0).sum()) for c in codes.coefficients) for codes in (plain, sparse))
    assert few < 0.75 * many
    assert float((sparse.texels() - mixed)[~hidden & _tiled()].abs().mean()) < 0.04


def _tiled() -> torch.Tensor:
    area = SIZES.clamp(min=1).prod(1)
    return torch.repeat_interleave(SIZES[:, 0] > 0, area)
