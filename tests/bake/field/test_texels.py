import numpy as np
import pytest
import torch

from bitymi_ns.bake.field.texels import evaluate_tiles
from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.pages import tile_means
from bitymi_ns.train.init import tangents


@pytest.fixture
def tiles(surfels):
    params = surfels(40)
    sizes = 2 ** np.random.default_rng(1).integers(2, 5, (40, 2))
    sizes[7] = 0
    return params, params["log_scales"].exp(), pack(sizes)


def test_every_texel_holds_the_field_at_its_centre(tiles):
    params, scales, packing = tiles
    texels, nonfinite = evaluate_tiles(lambda x: x, params["means"], params["quats"], scales, packing, chunk=100)
    assert texels.shape == (packing.layers, packing.height, packing.width, 3) and nonfinite == 0
    axes = tangents(params["quats"])
    means = tile_means(texels, packing)
    for i, (x, y, layer, r_u, r_v) in enumerate(packing.tiles.tolist()):
        u = (torch.arange(r_u) + 0.5) / max(r_u, 1) * 6 - 3
        v = (torch.arange(r_v) + 0.5) / max(r_v, 1) * 6 - 3
        step_u = u[:, None] * scales[i, 0] * axes[i, :, 0]
        step_v = v[:, None] * scales[i, 1] * axes[i, :, 1]
        expected = params["means"][i] + step_u[None] + step_v[:, None]
        torch.testing.assert_close(texels[layer, y : y + r_v, x : x + r_u], expected)
        torch.testing.assert_close(means[i], expected.mean((0, 1)) if r_u else torch.zeros(3))


def test_chunks_do_not_change_the_result_and_progress_ends_at_the_total(tiles):
    params, scales, packing = tiles
    seen = []
    arguments = (torch.sin, params["means"], params["quats"], scales, packing)
    fine, _ = evaluate_tiles(*arguments, chunk=1, progress=lambda step, done, total: seen.append((done, total)))
    coarse, _ = evaluate_tiles(*arguments)
    torch.testing.assert_close(fine, coarse)
    assert seen[-1][0] == seen[-1][1] == int(packing.tiles[:, 3:].prod(1).sum())


def test_values_that_are_not_finite_become_no_residual_and_are_counted(tiles):
    params, scales, packing = tiles

    def field(x):
        value = torch.ones_like(x)
        value[::10, 1] = float("nan")
        return value

    texels, nonfinite = evaluate_tiles(field, params["means"], params["quats"], scales, packing)
    assert torch.isfinite(texels).all()
    area = int(packing.tiles[:, 3:].prod(1).sum())
    assert texels.sum() == 3 * (area - nonfinite) and nonfinite > 0


def test_room_between_tiles_holds_no_residual():
    packing = pack([[16, 8], [4, 4]])
    texels, _ = evaluate_tiles(torch.ones_like, torch.zeros(2, 3), torch.ones(2, 4), torch.ones(2, 2), packing)
    assert texels.sum() == 3 * (16 * 8 + 4 * 4) < texels.numel()
