import math

import pytest
import torch

from bitymi_ns.ops import view_color
from bitymi_ns.ops.view_kinds import VIEW_COLORS, fibonacci_sphere
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.init import (
    limit_first_surfels,
    neighbour_distance,
    quat_from_normal,
    scene_extent,
    surfels_from_points,
    tangents,
)

CENTERS = torch.tensor([[4.0, 0.0, 0.0], [-4.0, 0.0, 0.0], [0.0, 4.0, 1.0]])


def start(xyz, rgb=None, centers=CENTERS, config=None, kind="sv", **options):
    rgb = torch.full_like(xyz, 0.5) if rgb is None else rgb
    return surfels_from_points(xyz, rgb, centers, config or TrainConfig(), SceneConfig(view_color=kind), **options)


@pytest.fixture
def cloud():
    generator = torch.Generator().manual_seed(0)
    return torch.randn(200, 3, generator=generator), torch.rand(200, 3, generator=generator)


@pytest.mark.parametrize("kind", VIEW_COLORS)
def test_colours_are_those_of_the_points(cloud, kind):
    xyz, rgb = cloud
    surfels, _ = start(xyz, rgb, kind=kind)
    Scene(SceneConfig(view_color=kind), surfels, None)  # checks names and shapes of the parameters
    everywhere = torch.zeros(len(xyz), 3)
    directions = fibonacci_sphere(400)
    for d in directions:
        # a distant camera sees every surfel from direction d
        everywhere += view_color(kind, surfels, surfels["means"], -1e4 * d, torch.ones(len(xyz), dtype=torch.bool))
    tolerance = 5e-3 if kind == "sb" else 1e-4
    torch.testing.assert_close(everywhere / len(directions) + 0.5, rgb, atol=tolerance, rtol=0)


def test_scale_is_the_distance_to_three_neighbours(cloud):
    xyz, _ = cloud
    nearest = torch.cdist(xyz, xyz).sort(-1).values[:, 1:4]
    torch.testing.assert_close(neighbour_distance(xyz, 1.0), nearest.square().mean(-1).sqrt(), atol=1e-5, rtol=1e-4)


def test_discs_face_the_nearest_camera(cloud):
    xyz, _ = cloud
    surfels, _ = start(xyz)
    u, v = tangents(surfels["quats"]).unbind(-1)
    to_camera = CENTERS[torch.cdist(xyz, CENTERS).argmin(-1)] - xyz
    normal = torch.linalg.cross(u, v)
    torch.testing.assert_close((normal * to_camera).sum(-1), to_camera.norm(dim=-1))
    assert (u - u[0]).abs().max() > 0.5  # random rotation in the plane


def test_facing_down_and_zero_quaternions():
    normals = torch.tensor([[0.0, 0, -1], [0, 0, 1], [1, 0, 0], [1e-6, 0, -1]])
    u, v = tangents(quat_from_normal(normals, torch.tensor([0.3, 0.4, 0.5, 0.6]))).unbind(-1)
    torch.testing.assert_close(torch.linalg.cross(u, v), normals, atol=2e-6, rtol=0)
    u, v = tangents(torch.zeros(1, 4)).unbind(-1)
    assert u.tolist() == [[1, 0, 0]] and v.tolist() == [[0, 1, 0]]


def test_broken_and_repeated_points_are_dropped_and_counted(cloud):
    xyz, rgb = cloud
    xyz = torch.cat([xyz, torch.tensor([[math.nan, 0, 0], [0, math.inf, 0]]), xyz[:5], xyz[:1]])
    rgb = torch.cat([rgb, torch.zeros(8, 3)])
    rgb[3, 1] = math.nan
    surfels, report = start(xyz, rgb)
    assert (report.given, report.not_finite, report.duplicates) == (208, 2, 6)
    torch.testing.assert_close(surfels["means"], cloud[0])
    assert all(torch.isfinite(p).all() for p in surfels.values())


def test_without_points_surfels_are_placed_at_random():
    box = torch.tensor([[-1.0, -2, -3], [1, 2, 3]])
    config = TrainConfig(random_points=500, seed=3)
    surfels, report = start(torch.full((4, 3), math.nan), config=config, box=box)
    assert report.random == 500 and report.not_finite == 4
    assert (surfels["means"] >= box[0]).all() and (surfels["means"] <= box[1]).all()
    again, _ = start(torch.zeros(0, 3), config=config, box=box)
    torch.testing.assert_close(again["means"], surfels["means"], rtol=0, atol=0)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("centers", [CENTERS, CENTERS[:1], CENTERS[:0]])
def test_few_points_and_few_cameras(n, centers):
    surfels, _ = start(torch.arange(3.0 * n).reshape(n, 3), centers=centers)
    assert all(len(p) == n and torch.isfinite(p).all() for p in surfels.values())


def test_point_at_a_camera_and_far_outliers():
    cloud = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    xyz = torch.cat([cloud, CENTERS[:1], torch.tensor([[1e6, 0, 0], [0, 1e6, 0]])])
    surfels, _ = start(xyz)
    assert all(torch.isfinite(p).all() for p in surfels.values())
    reach = torch.cdist(xyz[:51], CENTERS).amin(1).clamp(min=scene_extent(CENTERS))
    assert (surfels["log_scales"].exp().amax(-1)[:51] <= 0.2501 * reach).all()
    assert surfels["log_scales"].exp().max() <= 0.2501e6 * 1.01


def test_the_cap_holds_from_the_start(cloud):
    surfels, report = start(*cloud, config=TrainConfig(densify=DensifyConfig(max_surfels=37)))
    assert len(surfels["means"]) == 37 and report.over_cap == 163
    for first, most in ((20, 20), (60, 37), (None, 37)):
        config = TrainConfig(densify=DensifyConfig(max_surfels=37), first_surfels=first)
        assert len(start(*cloud, config=config)[0]["means"]) == most
    thinned, _ = start(*cloud, config=TrainConfig(first_surfels=50))
    whole, _ = start(*cloud, config=TrainConfig(first_surfels=1000))
    assert len(whole["means"]) == 200 and thinned["log_scales"].mean() > whole["log_scales"].mean() + 0.3


def test_extent():
    for steps, pixels, most in ((900, 244 * 135, 29_646), (60, 48 * 36, 5_000)):
        assert limit_first_surfels(TrainConfig(), steps, 3 * pixels, 3).first_surfels == most
    assert scene_extent(torch.tensor([[1.0, 0, 0], [-1, 0, 0]])) == pytest.approx(1.1)
    one = torch.tensor([[5.0, 0, 0]])
    assert scene_extent(one, torch.tensor([[0.0, 0, 0], [7, 0, 0], [4, 0, 0]])) == pytest.approx(2.0)
    assert scene_extent(one) == 1.0
    assert scene_extent(torch.zeros(0, 3)) == 1.0
