import math

import pytest
import torch

from bitymi_ns.scene.tile_sizes import (
    coarsened,
    max_projected_extent,
    next_power_of_two,
    nyquist_resolution,
    seen_sides,
    voxel_along_axes,
)
from bitymi_ns.train.init import tangents

FACING = torch.tensor([[1.0, 0.0, 0.0, 0.0]])  # u along x, v along y


def test_next_power_of_two_is_exact_at_powers_and_forgives_rounding():
    x = torch.tensor([0.0, 0.3, 1.0, 1.01, 4.0, 4.0000005, 5.0, 64.0, 65.0])
    assert next_power_of_two(x).tolist() == [0, 0.5, 1, 2, 4, 4, 8, 64, 128]
    assert torch.isfinite(next_power_of_two(torch.tensor([math.inf, 1e38]))).all()


def test_resolution_follows_the_papers_equation_on_each_axis():
    scales = torch.tensor([[0.01, 0.1], [0.02, 1e-6], [10.0, 0.05]])
    resolution = nyquist_resolution(scales, torch.full((3, 2), 0.05), extent=3.0)
    expected = [[min(64, max(4, 2 ** math.ceil(math.log2(12 * s / 0.05)))) for s in row] for row in scales.tolist()]
    assert resolution.tolist() == expected
    wider = nyquist_resolution(scales, torch.full((3, 2), 0.05), extent=4.0)
    assert (wider >= resolution).all() and wider[0, 1] == 32
    for r_min, r_max in ((2, 64), (4, 48), (32, 16)):
        with pytest.raises(ValueError, match="r_m"):
            seen_sides(torch.ones(1, 2), r_min, r_max)


def test_views_cap_the_resolution_at_the_next_power_of_two():
    scales, delta = torch.full((4, 2), 1.0), torch.full((4, 2), 0.01)
    pixels = torch.tensor([[0.0, 3.0], [5.0, 8.0], [9.0, 33.0], [1000.0, 17.0]])
    capped = nyquist_resolution(scales, delta, max_pixels=pixels)
    assert capped.tolist() == [[4, 4], [8, 8], [16, 64], [64, 32]]


def test_voxels_are_longer_along_the_ray_from_the_centre():
    axes = tangents(FACING)
    voxel = torch.tensor([[9.0, 2.0]])
    along_x = voxel_along_axes(voxel, axes, torch.tensor([[5.0, 0.0, 0.0]]), torch.zeros(3))
    torch.testing.assert_close(along_x, torch.tensor([[9.0, 2.0]]))
    along_z = voxel_along_axes(voxel, axes, torch.tensor([[0.0, 0.0, 5.0]]), torch.zeros(3))
    torch.testing.assert_close(along_z, torch.tensor([[2.0, 2.0]]))
    assert voxel_along_axes(voxel, axes, torch.ones(1, 3)).tolist() == [[2.0, 2.0]]
    assert torch.isfinite(voxel_along_axes(voxel, axes, torch.zeros(1, 3), torch.zeros(3))).all()


def test_projected_extent_of_a_facing_disc(camera):
    means, scales = torch.zeros(1, 3), torch.tensor([[0.1, 0.2]])
    pixels = max_projected_extent(means, tangents(FACING), scales, [camera(6.0), camera(12.0)])
    torch.testing.assert_close(pixels, torch.tensor([[6 * 0.1 * 60 / 6, 6 * 0.2 * 50 / 6]]))


def test_surfels_behind_the_camera_or_far_outside_the_image_are_unseen(camera):
    means = torch.tensor([[0.0, 0.0, -7.0], [0.0, 0.0, -5.9], [50.0, 0.0, 0.0], [3.3, 0.0, 0.0]])
    pixels = max_projected_extent(means, tangents(FACING.expand(4, 4)), torch.full((4, 2), 0.1), [camera(6.0)])
    assert (pixels[:3] == 0).all() and (pixels[3] > 0).all()  # the last one's centre is outside, its edge inside


def test_coarsened_halves_the_longer_side_until_it_fits():
    sides = torch.tensor([[64, 16], [8, 8], [4, 64], [4, 4], [32, 32]], dtype=torch.int32)
    got = coarsened(sides, torch.tensor([256.0, 64.0, 100.0, 1.0, 500.0]))
    assert got.tolist() == [[16, 16], [8, 8], [4, 16], [4, 4], [16, 16]]
    assert coarsened(sides, torch.zeros(5)).eq(4).all() and sides[0, 0] == 64
