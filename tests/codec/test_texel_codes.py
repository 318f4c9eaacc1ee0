"""Integer codes of texels: fine steps are lossless, unseen texels are cheap, weights decide where errors are."""

import torch

from bitymi_ns.codec.texel_codes import BLOCK, TexelCoder, blocks_of

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
    coder = TexelCoder(SIZES, torch.ones(COUNT), 0.05)
    got = coder.code(texels, rounds=0).texels()
    assert float((got - texels)[_tiled()].abs().max()) < 1e-3
    constants = ~_tiled()
    assert float((got - texels)[constants].abs().max()) <= 2.001 / 255


def test_tiles_that_are_seen_more_are_kept_more_precisely() -> None:
    texels, weights = noise(), torch.full((COUNT,), 0.01)
    first = torch.arange(COUNT) < 32
    weights[first] = 10.0
    coder = TexelCoder(SIZES, weights, 7.5)
    error = (coder.code(texels, rounds=0).texels() - texels).square().mean(1)
    assert coder.grades[0] < coder.grades[1:].min()
    assert float(error[first].mean()) < 0.01 * float(error[_tiled() & ~first].mean())


def test_texels_that_nobody_sees_cost_little() -> None:
    texels, weights = noise(), torch.ones(COUNT)
    smooth = torch.full((COUNT, 3), 0.2)
    hidden = torch.arange(COUNT) % 2 == 1
    weights[hidden] = 0.0
    mixed = torch.where(hidden[:, None], texels, smooth)
    plain = TexelCoder(SIZES, torch.ones(COUNT), 7.5).code(mixed, rounds=0)
    sparse = TexelCoder(SIZES, weights, 7.5).code(mixed)
    many, few = (sum(int((c != 0).sum()) for c in codes.coefficients) for codes in (plain, sparse))
    assert few < 0.75 * many
    assert float((sparse.texels() - mixed)[~hidden & _tiled()].abs().mean()) < 0.04


def test_alphas_are_coded_before_the_colours_and_stay() -> None:
    texels, alpha = noise(), 2 * noise()[:, 0] + 1
    coder = TexelCoder(SIZES, torch.ones(COUNT), 0.05)
    drawn = coder.code_alpha(alpha, rounds=0)
    assert torch.equal(drawn * 128, (drawn * 128).round()) and float((drawn - alpha).abs().max()) < 1 / 128
    codes = coder.code(texels, rounds=0)
    opaque = TexelCoder(SIZES, torch.ones(COUNT), 0.05).code(texels, rounds=0)
    assert opaque.alphas() is None and torch.equal(codes.texels(), opaque.texels())
    assert list(codes.columns) == [*opaque.columns, *(f"alpha_{each.name}" for each in blocks_of(SIZES))]
    coarse = coder.fit(texels, codes.nbytes() - 0.5 * opaque.nbytes())
    for each in (codes, coarse):
        assert torch.equal(each.alphas(), drawn)
    bare = SIZES[:, 0] == 0
    area = SIZES.clamp(min=1).prod(1)
    assert torch.equal(codes.alpha.means[bare], drawn[(area.cumsum(0) - area)[bare]])


def test_alphas_are_bytes_within_their_range() -> None:
    alpha = torch.where(noise()[:, 0] > 0, 2.0, 0.0)
    coder = TexelCoder(SIZES, torch.ones(COUNT), 30.0)
    drawn = coder.code_alpha(alpha)
    assert float(drawn.min()) == 0 and float(drawn.max()) == 255 / 128
    assert coder.alpha.mean.min() >= 0 and coder.alpha.mean.max() <= 255


def test_alphas_of_one_cost_next_to_nothing() -> None:
    sizes = SIZES.repeat(100, 1)
    texels = noise().repeat(100, 1)
    coder = TexelCoder(sizes, torch.ones(len(texels)))
    opaque = coder.code(texels).nbytes()
    assert bool((coder.code_alpha(torch.ones(len(texels))) == 1).all())
    assert coder.code(texels).nbytes() < opaque + 100  # a dozen bytes per constant column


def _tiled() -> torch.Tensor:
    area = SIZES.clamp(min=1).prod(1)
    return torch.repeat_interleave(SIZES[:, 0] > 0, area)
