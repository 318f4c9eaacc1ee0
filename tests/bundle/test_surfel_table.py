import numpy as np
import pytest
import torch

from bitymi_ns.bundle.surfel_table import from_columns, mean_view_color, to_columns
from bitymi_ns.ops import VIEW_COLORS
from bitymi_ns.ops.constants import SH_C0
from bitymi_ns.ops.view_kinds import kind_of
from bitymi_ns.ply import PlyError
from bitymi_ns.scene.baked import BakedScene

TILES = np.arange(25, dtype=np.int32).reshape(5, 5)


def columns_of(params, tiles=TILES, **means):
    return to_columns(BakedScene(params, kind_of(params), torch.from_numpy(tiles), **means))


@pytest.mark.parametrize("kind", VIEW_COLORS)
def test_surfels_survive_the_columns(surfels, kind):
    params = surfels(5, kind)
    columns = columns_of(params)
    read = from_columns(columns, kind)
    found, tiles = read["surfels"], read["tiles"]
    np.testing.assert_array_equal(tiles.numpy(), TILES)
    assert set(found) == set(params)
    for name, value in params.items():
        expected = torch.nn.functional.normalize(value, dim=1) if name == "quats" else value
        torch.testing.assert_close(found[name], expected, rtol=0, atol=1e-7 if name == "quats" else 0)


def test_the_columns_begin_with_those_of_gaussian_splatting(surfels):
    columns = columns_of(surfels(5))
    names = list(columns)
    assert names[:15] == (
        "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 beta".split()
    )
    assert names[15:17] == ["sv_sites_0", "sv_sites_1"] and names[-5:][0] == "tile_x"
    assert len(names) == 15 + 49 + 5
    assert (columns["scale_2"] == -31).all() and columns["tile_ru"].dtype == np.int32


def test_viewers_see_the_mean_colour_with_the_mean_of_the_tile(surfels):
    params = surfels(5, "sh")
    params["sh_dc"] = torch.tensor([[0.1, 0.2, -0.3]]).expand(5, 3) / SH_C0
    columns = columns_of(params, mean_residual=torch.full((5, 3), 0.25))
    shown = [0.5 + SH_C0 * columns[f"f_dc_{i}"][0] for i in range(3)]
    assert shown == pytest.approx([0.85, 0.95, 0.45])
    bright = columns_of(params, mean_residual=torch.full((5, 3), 9.0))
    assert 0.5 + SH_C0 * bright["f_dc_0"][0] == pytest.approx(1.0)


@pytest.mark.parametrize("kind", VIEW_COLORS)
def test_mean_view_colours_match_a_sum_over_the_sphere(surfels, kind):
    reference = pytest.importorskip("bitymi_ns.ops.reference.view_color")
    params = surfels(1, kind)
    dirs = torch.nn.functional.normalize(torch.randn(100_000, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    inputs = [params[name] for name in VIEW_COLORS[kind].names]
    expected = getattr(reference, kind)(*inputs, dirs).mean(0)
    torch.testing.assert_close(mean_view_color(params)[0], expected, atol=0.02, rtol=0)


def test_extreme_temperatures_leave_the_colour_finite(surfels):
    for kind, name in (("sv", "sv_log_tau"), ("sb", "sb_lobes"), ("sg", "sg_lobes")):
        params = surfels(3, kind)
        extremes = torch.tensor([-80.0, 0.0, 9.0]).reshape(3, *[1] * (params[name].dim() - 1))
        params[name] = extremes.expand_as(params[name])
        columns = columns_of(params, TILES[:3])
        assert all(np.isfinite(columns[f"f_dc_{i}"]).all() for i in range(3))


def test_degree_zero_and_one_site_keep_their_shapes(surfels):
    params = surfels(5, "sh")
    params["sh_rest"] = params["sh_rest"][:, :0]
    assert from_columns(columns_of(params), "sh")["surfels"]["sh_rest"].shape == (5, 0, 3)
    params = surfels(5, "sv")
    params = {name: value[:, :1] if name.startswith("sv_") else value for name, value in params.items()}
    assert from_columns(columns_of(params), "sv")["surfels"]["sv_sites"].shape == (5, 1, 3)


def test_extents_and_mean_residuals_are_optional_columns(surfels):
    params = surfels(5)
    plain = from_columns(columns_of(params), "sv")
    assert plain["extent"].tolist() == [3.0] * 5 and not plain["mean_residual"].any() and plain["mean_alpha"] is None
    extent, residual = torch.linspace(0.5, 3.0, 5), torch.randn(5, 3)
    columns = columns_of(params, mean_residual=residual, extent=extent)
    found = from_columns(columns, "sv")
    assert torch.equal(found["extent"], extent) and torch.equal(found["mean_residual"], residual)
    with pytest.raises(PlyError, match="tile_extent is 0 in row 1; it must be from 1e-06 to 16"):
        from_columns(columns | {"tile_extent": np.float32([1, 0, 1, 1, 1])}, "sv")
    del columns["residual_2"]
    with pytest.raises(PlyError, match="residual_2 is missing"):
        from_columns(columns, "sv")


def test_missing_or_extra_columns_are_refused(surfels):
    good = columns_of(surfels(5))
    for name in ("x", "rot_3", "beta", "tile_ru"):
        with pytest.raises(PlyError, match=f"{name} is missing"):
            from_columns({k: v for k, v in good.items() if k != name}, "sv")
    with pytest.raises(PlyError, match="groups of 3"):
        from_columns({k: v for k, v in good.items() if k != "sv_rgb_4"}, "sv")
    with pytest.raises(PlyError, match="number of sites"):
        from_columns({k: v for k, v in good.items() if k != "sv_log_tau_6"}, "sv")
    with pytest.raises(PlyError, match="groups of 3"):
        from_columns(good, "sh")
    with pytest.raises(PlyError, match="holds float32"):
        from_columns(good | {"tile_x": good["x"]}, "sv")
    with pytest.raises(PlyError, match="none of"):
        from_columns(good, "phong")
