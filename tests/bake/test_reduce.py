"""Tiles are as small as the tolerance allows, but not smaller."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from bitymi_ns.bake import BakeOptions, Coded, bake_field
from bitymi_ns.bake.field.tiles import grids
from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bake.tiles import fit, interpolation
from bitymi_ns.ops.reference.render import texel, texel_centers
from bitymi_ns.scene.tile_sizes import kernel_parameters, visible_extent
from bitymi_ns.train.init import tangents
from tests.bake.conftest import WaveField

OPTIONS = BakeOptions(format="fp16")
BOUND = 0.02


class GivenField(WaveField):
    """A residual colour by a function of positions."""

    def __init__(self, color: Callable[[torch.Tensor], torch.Tensor]) -> None:
        super().__init__(voxel=0.02)
        self.color = color

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        return self.color(x)


def wave(direction: torch.Tensor, frequency: float) -> GivenField:
    return GivenField(lambda x: (0.2 * torch.sin(frequency * (x @ direction)))[:, None].expand(-1, 3))


@pytest.fixture
def discs(scene):
    """make(field) -> eight soft discs of one size at the origin, randomly rotated, with the axes of the first."""

    def make(field=None):
        made = scene(8, field=field)
        made.surfels["means"].zero_()
        made.surfels["log_scales"].fill_(-2.0)
        made.surfels["quats"] = made.surfels["quats"][:1].expand(8, 4).clone()
        made.surfels["opacity_logits"].fill_(2.0)
        made.surfels["beta_raw"].fill_(2.0)
        made.config.weight_bound = BOUND
        return made, tangents(made.surfels["quats"])[0]

    return make


def error_of_the_first(baked: Coded, made: SimpleNamespace, axes: torch.Tensor, uv: torch.Tensor) -> float:
    """Compute the weighted root mean square error of the first disc at points [M, 2], 8-bit steps."""
    r_u, r_v = baked.sizes[0].clamp(min=1).tolist()
    tile, extent = baked.texels[: r_u * r_v].view(r_v, r_u, 3), float(baked.extent[0])
    uv = uv[uv.norm(dim=1) < extent]
    opacity, beta = (value[0] for value in kernel_parameters(made.surfels))
    weight = opacity * (1 - uv.square().sum(1) / 9) ** beta
    exact = made.field((uv * made.surfels["log_scales"][0].exp()) @ axes.T)
    error = 255 * weight[:, None] * (texel(tile, uv * 3 / extent) - exact)  # the reference's tiles reach to 3
    return float(error.square().mean().sqrt())


def centers(baked: Coded) -> torch.Tensor:
    """List the texel centres [M, 2] of the first tile before it was reduced."""
    side = round((baked.statistics.texels.within_visible_part / 8) ** 0.5)
    at = texel_centers(side).float() * float(baked.extent[0]) / 3
    return torch.cartesian_prod(at, at)


def test_interpolation_is_that_of_the_renderers_and_the_fit_inverts_it():
    tile = torch.rand(1, 8, 1, dtype=torch.float64)
    uv = torch.stack([texel_centers(32), torch.zeros(32, dtype=torch.float64)], dim=1)
    expected = texel(tile, uv)[:, 0]
    torch.testing.assert_close(interpolation(32, 8).double() @ tile[0, :, 0], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(fit(32, 8).double() @ expected, tile[0, :, 0], atol=1e-5, rtol=0)
    torch.testing.assert_close(fit(8, 8), torch.eye(8))


def test_the_visible_extent_is_where_the_kernel_falls_to_the_bound():
    opacity, beta = torch.tensor([0.9, 0.3, 0.02, 0.01, 0.5]), torch.tensor([3.5, 1.0, 2.0, 2.0, 1e-3])
    extent = visible_extent(opacity, beta, BOUND)
    kernel = opacity * (1 - extent.square() / 9).clamp(min=1e-30) ** beta
    torch.testing.assert_close(kernel[:2], torch.full((2,), BOUND), atol=1e-5, rtol=0)
    assert extent[2:4].tolist() == [0, 0] and extent[4] == pytest.approx(3.0)
    assert visible_extent(opacity, beta, 0.0).tolist() == [3.0] * 5


def test_a_constant_residual_needs_no_tile(discs):
    made, _ = discs(GivenField(lambda x: torch.full((len(x), 3), 0.25)))
    baked = bake_field(made, options=OPTIONS)
    assert baked.atlas is None and not baked.packing.tiles.any()
    torch.testing.assert_close(baked.scene.mean_residual, torch.full((8, 3), 0.25))
    assert baked.statistics.surfels.without_tile == 8


@pytest.mark.parametrize("axis", [0, 1])
def test_detail_along_one_axis_refines_that_axis_alone(discs, axis):
    made, axes = discs()
    made.field = wave(axes[:, axis], 30.0)
    sizes = bake_field(made, options=OPTIONS).packing.tiles[:, 3:]
    assert (sizes[:, 1 - axis] == 4).all() and (sizes[:, axis] >= 16).all()


def test_the_error_stays_below_the_tolerance_and_the_next_smaller_grid_does_not(discs, camera):
    made, axes = discs()
    made.field = wave(axes[:, 0] + 0.3 * axes[:, 1], 25.0)
    sizes = {}
    for tolerance in (0.1, 0.5, 2.0, 20.0):
        baked = bake_field(made, options=replace(OPTIONS, tolerance=tolerance))
        assert error_of_the_first(baked, made, axes, centers(baked)) <= tolerance + 0.02
        sizes[tolerance] = baked.packing.texels
    assert sizes[0.1] > sizes[0.5] > sizes[2.0] > sizes[20.0] == 0
    exact = bake_field(made, options=replace(OPTIONS, tolerance=0.0))
    assert exact.statistics.texels.kept == exact.statistics.texels.nyquist and exact.extent.tolist() == [3.0] * 8
    near, far = (bake_field(made, [camera(d)], replace(OPTIONS, drop_unseen=False)) for d in (1.0, 60.0))
    assert far.packing.texels < near.packing.texels  # views that see less allow less


def test_the_error_between_texel_centres_is_hardly_larger(discs):
    made, axes = discs()
    made.field = wave(axes[:, 0], 25.0)
    baked = bake_field(made, options=replace(OPTIONS, tolerance=1.0))
    uv = (torch.rand(200_000, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1) * float(baked.extent[0])
    at_centers = error_of_the_first(baked, made, axes, centers(baked))
    assert 0.3 < at_centers <= error_of_the_first(baked, made, axes, uv) < 1.2 * at_centers


def test_texels_out_of_sight_do_not_widen_the_range(discs):
    made, _ = discs()
    radius = float(visible_extent(*kernel_parameters(made.surfels), BOUND)[0]) * 0.1353353

    def wild_outside(x):
        inside = x.norm(dim=1, keepdim=True) < 1.001 * radius
        return torch.where(inside, 0.2 * torch.sin(60 * x), 1000.0)

    made.field = GivenField(wild_outside)
    assert bake_field(made, options=OPTIONS).texels.abs().max() < 0.5


def test_what_is_hidden_counts_less(discs):
    made, axes = discs()
    made.field = wave(axes[:, 0], 25.0)
    inputs = BakeInput(made.surfels, (), 0.2, BOUND)

    def grids_behind(transmittance):
        views = SimpleNamespace(in_front=torch.full((8,), transmittance))
        return grids(replace(inputs, views=views), made.field, OPTIONS, None)

    _, clear, _ = grids(inputs, made.field, OPTIONS, None)
    assert (grids_behind(0.1)[1] < clear).all()
    assert not any(values.any() for values in grids_behind(0.0)[:2])
