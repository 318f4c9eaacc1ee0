"""Resolution of the photographs at points of the scene."""

import math

import pytest
import torch

from bitymi_ns.bake import bake_field
from bitymi_ns.bake.inputs import POINTS, BakeInput, photo_resolution
from bitymi_ns.scene.sampling import size_of
from bitymi_ns.scene.visibility import Visibility
from tests.bake.conftest import make_camera, make_surfels


def test_rates_are_geometric_means_over_the_views() -> None:
    surfels = {"means": torch.zeros(1, 3)}
    cameras = [make_camera(distance) for distance in (4.0, 8.0, 4.0)]
    focal = math.sqrt(float(cameras[0].K[0, 0] * cameras[0].K[1, 1]))
    row = photo_resolution(BakeInput(surfels, cameras, 0.2, 0.02))
    assert row.tolist() == [[0.0, 0.0, 0.0, pytest.approx(focal / (4 * 8 * 4) ** (1 / 3))]]
    seen = torch.tensor([[False], [True], [False]])
    visible = Visibility(torch.ones(1), torch.ones(1), seen)
    row = photo_resolution(BakeInput(surfels, cameras, 0.2, 0.02, visible))
    assert row[0, 3] == pytest.approx(focal / 8)


def test_nothing_is_known_without_views() -> None:
    surfels = {"means": torch.tensor([[0.0, 0.0, 1000.0], [0.0, 0.0, -1000.0]])}
    assert photo_resolution(BakeInput(surfels, [], 0.2, 0.02)) is None
    sideways = {"means": torch.tensor([[1e5, 0.0, 0.0]])}
    assert photo_resolution(BakeInput(sideways, [make_camera()], 0.2, 0.02)) is None


def test_points_are_drawn_evenly() -> None:
    surfels = make_surfels(2000)
    points = photo_resolution(BakeInput(surfels, [make_camera(20.0)], 0.2, 0.02))
    assert points.shape == (POINTS, 4) and points.dtype == torch.float32 and bool((points[:, 3] > 0).all())


def test_a_baked_scene_knows_it(scene) -> None:
    camera = make_camera()
    baked = bake_field(scene(60), [camera]).scene
    assert size_of(baked.photographed, camera) == pytest.approx(1.0, rel=0.3)
    assert size_of(baked.photographed, camera.scaled(0.5)) == pytest.approx(0.5, rel=0.3)
    assert bake_field(scene(60)).scene.photographed is None
