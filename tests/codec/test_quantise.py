import numpy as np
import pytest

from bitymi_ns.codec.packing import pack
from bitymi_ns.codec.quantise import Range, choose_range, decode_pages, encode


def paint(packing, value):
    """Build an atlas with value(tile index, [r_v, r_u] rows and columns) in every tile and zeros elsewhere."""
    texels = np.zeros((packing.layers, packing.height, packing.width, 3), dtype=np.float32)
    for i, (x, y, layer, r_u, r_v) in enumerate(packing.tiles):
        texels[layer, y : y + r_v, x : x + r_u] = value(i, r_v, r_u)
    return texels


def listed(packing, texels):
    return np.concatenate([texels[la, y : y + h, x : x + w].reshape(-1, 3) for x, y, la, w, h in packing.tiles])


@pytest.fixture
def atlas():
    """Smooth tiles of many sizes around 0.5, on several pages."""
    packing = pack(2 ** np.random.default_rng(0).integers(2, 6, (300, 2)), page_width=256, max_rows=256)

    def smooth(i, r_v, r_u):
        v, u = np.mgrid[0:r_v, 0:r_u] / 16.0
        return np.stack([0.5 + 0.1 * np.sin(u + i), 0.5 + 0.1 * np.cos(v - i), 0.5 + 0.05 * np.sin(u + v)], axis=-1)

    assert packing.layers > 1
    return packing, paint(packing, smooth)


def test_the_range_depends_on_the_seed_and_no_tile_has_one():
    texels = np.random.default_rng(0).random((5000, 3)).astype(np.float32)
    found = [choose_range(texels, samples=500, seed=seed) for seed in (0, 0, 1)]
    assert found[0] == found[1] != found[2]
    assert choose_range(texels[:0]) == Range(0.0, 1.0, "sigma6")


def test_sigma6_is_six_standard_deviations_about_the_mean(atlas):
    inside = listed(*atlas)
    found = choose_range(inside, "sigma6")
    assert found.offset == pytest.approx(inside.mean() - 6 * inside.std(), abs=5e-3)
    assert found.scale == pytest.approx(12 * inside.std(), rel=0.01)
    exact = choose_range(inside, "minmax")
    assert (exact.offset, exact.offset + exact.scale) == pytest.approx((inside.min(), inside.max()))


def test_auto_takes_the_rule_with_the_smaller_error(atlas):
    inside = listed(*atlas)
    assert choose_range(inside, "auto").rule == "minmax"  # bounded values: six deviations waste codes
    inside[0] = 500.0
    assert choose_range(inside, "auto", samples=4096).rule == "sigma6"


def test_a_constant_atlas_survives_every_rule():
    packing = pack([[8, 8], [4, 4]])
    texels = paint(packing, lambda *_: 0.3)
    for rule in ("sigma6", "minmax", "auto"):
        encoded = encode(texels, packing, "uint8", choose_range(listed(packing, texels), rule))
        assert encoded.mse < 1e-10 and encoded.clipped_fraction == 0


def test_uint8_is_exact_to_half_a_code(atlas):
    packing, texels = atlas
    chosen = choose_range(listed(packing, texels), "minmax")
    encoded = encode(texels, packing, "uint8", chosen)
    decoded = encoded.decoded()
    mask = texels.any(axis=-1)
    assert np.abs(decoded - texels)[mask].max() <= chosen.scale / 255 * 0.501
    assert encoded.clipped_fraction == 0
    assert encoded.mse == pytest.approx(np.square(decoded - texels)[mask].mean(), rel=1e-3)
    assert (decode_pages(encoded.payload, "uint8", encoded.width, encoded.height)[..., 3] == 255).all()
    clipped = encode(texels, packing, "uint8", Range(0.5, 10.0, "test")).clipped_fraction
    assert clipped == pytest.approx((texels[mask] < 0.5 - 1e-5).mean(), abs=1e-3)


def test_fp16_stores_the_values_themselves(atlas):
    packing, texels = atlas
    encoded = encode(texels, packing, "fp16")
    assert (encoded.range.offset, encoded.range.scale) == (0.0, 1.0)
    decoded = encoded.decoded()
    np.testing.assert_array_equal(decoded, texels.astype(np.float16).astype(np.float32))
    assert encoded.nbytes == 8 * texels[..., 0].size


@pytest.mark.parametrize("profile", ["ultrafast", "veryfast", "fast", "basic", "slow"])
def test_bc7_keeps_a_smooth_atlas_close(profile):
    packing = pack([[32, 32]] * 4)

    def plane_of_colours(i, r_v, r_u):  # steep and two-dimensional: hard for BC7's lines through colour space
        v, u = np.mgrid[0:1:32j, 0:1:32j]
        return np.stack([v, u, np.full_like(u, 0.5)], axis=-1)

    texels = paint(packing, plane_of_colours)
    encoded = encode(texels, packing, "bc7", choose_range(listed(packing, texels), "minmax"), profile)
    assert encoded.psnr > (33 if profile == "ultrafast" else 40)  # one line per block, or more
    assert encoded.nbytes == texels[..., 0].size
    assert profile in encoded.encoder


def test_bc7_does_not_depend_on_threads_and_beats_noise(atlas, monkeypatch):
    packing, texels = atlas
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    one = encode(texels, packing, "bc7")
    monkeypatch.setattr("os.cpu_count", lambda: 3)
    assert one.payload == encode(texels, packing, "bc7").payload
    assert len(one.payload) == packing.layers
    assert one.psnr > 38
    assert one.nbytes * 4 == encode(texels, packing, "uint8").nbytes
    smallest = pack([[4, 4]])
    texels = paint(smallest, lambda *_: np.linspace(0, 1, 48).reshape(4, 4, 3))
    assert len(encode(texels, smallest, "bc7").payload[0]) == 16


def test_errors_say_what_to_choose(atlas):
    packing, texels = atlas
    with pytest.raises(ValueError, match="sigma6, minmax or auto"):
        choose_range(listed(packing, texels), "sigma3")
    with pytest.raises(ValueError, match="bc7, uint8 or fp16"):
        encode(texels, packing, "png")
    with pytest.raises(ValueError, match="profile"):
        encode(texels, packing, "bc7", profile="best")
    with pytest.raises(ValueError, match="has 64 bytes, not 3"):
        decode_pages([b"abc"], "uint8", 4, 4)


@pytest.mark.parametrize("format, bound", [("bc7", 0.1), ("uint8", 0.5 / 128), ("fp16", 1e-3)])
def test_alphas_are_a_fourth_channel_and_do_not_count_as_colours(format, bound):
    packing = pack([[32, 32]] * 4)
    v, u = np.mgrid[0:1:32j, 0:1:32j]
    colors = paint(packing, lambda *_: np.stack([v, u, np.full_like(u, 0.5)], axis=-1))
    alphas = paint(packing, lambda i, r_v, r_u: np.stack([2 * np.minimum(u * (i + 1), 1)] * 3, axis=-1))[..., :1]
    texels = np.concatenate([colors, alphas], axis=-1)
    with_alpha, opaque = (encode(each, packing, format) for each in (texels, colors))
    assert opaque.alpha_scale == 0 and with_alpha.alpha_scale == (1.0 if format == "fp16" else 255 / 128)
    assert with_alpha.range == opaque.range and with_alpha.clipped_fraction == opaque.clipped_fraction
    if format != "bc7":
        assert with_alpha.mse == opaque.mse
    decoded = with_alpha.decoded()
    assert decoded.shape == texels.shape and opaque.decoded().shape == colors.shape
    assert np.abs(decoded[..., 3] - np.minimum(texels[..., 3], with_alpha.alpha_scale * 255)).max() <= bound + 1 / 128


def test_an_alpha_of_one_is_exact_in_every_format():
    packing = pack([[16, 8]] * 4)
    texels = np.random.default_rng(0).random((packing.layers, packing.height, packing.width, 4)).astype(np.float32)
    texels[..., 3] = 1.0
    for format in ("uint8", "fp16"):
        assert (encode(texels, packing, format).decoded()[..., 3] == 1.0).all()
