"""nerfstudio's cameras and ours agree."""

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.data.cameras import normal_image, ray_distance, to_camera
from tests.stand_in_card import CARD, noted_reads


def rotation(generator: torch.Generator) -> torch.Tensor:
    q, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
    return q * torch.det(q)


def cameras(**changes: object) -> Cameras:
    generator = torch.Generator().manual_seed(1)
    c2w = torch.cat([rotation(generator), torch.randn(3, 1, generator=generator)], 1)[None]
    values = dict(fx=61.0, fy=57.0, cx=20.5, cy=14.0, width=40, height=30, camera_to_worlds=c2w)
    return Cameras(**{**values, **changes})


def test_points_along_nerfstudios_rays_project_to_their_pixels() -> None:
    ns = cameras()
    camera = to_camera(ns)
    rays = ns.generate_rays(camera_indices=0, keep_shape=True)
    points = (rays.origins + 2.5 * rays.directions).reshape(-1, 3)
    homogeneous = torch.cat([points, torch.ones(len(points), 1)], 1) @ camera.viewmat.T
    pixels = (homogeneous[:, :3] @ camera.K.T)[:, :2] / homogeneous[:, 2:3]
    y, x = torch.meshgrid(torch.arange(30) + 0.5, torch.arange(40) + 0.5, indexing="ij")
    assert torch.allclose(pixels, torch.stack([x, y], -1).reshape(-1, 2), atol=1e-3)
    assert torch.allclose(camera.center, ns.camera_to_worlds[0, :, 3], atol=1e-5)
    depth = homogeneous[:, 2].reshape(30, 40, 1)
    alpha = torch.full_like(depth, 0.5)
    assert torch.allclose(ray_distance(depth * 0.5, alpha, camera), torch.full_like(depth, 2.5), atol=1e-4)


def test_nothing_seen_is_as_far_as_the_farthest() -> None:
    camera = to_camera(cameras())
    depth, alpha = torch.full((30, 40, 1), 2.0), torch.ones(30, 40, 1)
    depth[3, 4] = alpha[3, 4] = 0.0
    distance = ray_distance(depth, alpha, camera)
    assert distance[3, 4] == distance.max() and distance.isfinite().all()


def test_normals_are_shown_in_the_world_frame() -> None:
    camera = to_camera(cameras())
    world = torch.nn.functional.normalize(torch.tensor([0.2, -0.5, 1.0]), dim=0)
    image = normal_image((0.7 * camera.viewmat[:3, :3] @ world).expand(30, 40, 3), camera)
    assert torch.allclose(2 * image - 1, world.expand(30, 40, 3), atol=1e-5)
    assert normal_image(torch.zeros(30, 40, 3), camera).abs().max() == 0


def test_distorted_cameras_are_refused() -> None:
    with pytest.raises(InputError, match="lens distortion"):
        to_camera(cameras(distortion_params=torch.tensor([[0.1, 0, 0, 0, 0, 0]])))
    to_camera(cameras(distortion_params=torch.zeros(1, 6)))


def test_a_camera_on_a_card_is_read_at_once() -> None:
    with noted_reads() as reads:
        there, here = to_camera(cameras().to(CARD)), to_camera(cameras(), CARD)
    assert len(reads) == 1
    for camera in (there, here):
        assert torch.equal(camera.viewmat, to_camera(cameras()).viewmat) and type(camera.K) is not torch.Tensor
