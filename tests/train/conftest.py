"""A ball of coloured discs, seen by a ring of cameras."""

import math

import pytest
import torch

from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.field import HashField
from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.init import surfels_from_points
from bitymi_ns.train.views import View


def look_at_origin(center, size: int = 48) -> Camera:
    center = torch.tensor(center, dtype=torch.float32)
    forward = -center / center.norm()
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    K = torch.tensor([[0.94 * size, 0, size / 2], [0, 0.94 * size, size / 2], [0, 0, 1]])
    return Camera(viewmat, K, size, size)


@pytest.fixture(scope="session")
def cameras() -> list[Camera]:
    return [look_at_origin([3 * math.cos(a), 3 * math.sin(a), 0.8 + 0.3 * math.sin(3 * a)]) for a in range(6)]


@pytest.fixture(scope="session")
def ball() -> tuple[torch.Tensor, torch.Tensor]:
    """[600, 3] points on the unit sphere, and their colours."""
    xyz = torch.nn.functional.normalize(torch.randn(600, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    return xyz, 0.5 + 0.45 * torch.sin(4 * xyz)


@pytest.fixture(scope="session")
def truth(cameras, ball) -> Scene:
    """The scene in the photographs."""
    centers = torch.stack([camera.center for camera in cameras])
    surfels, _ = surfels_from_points(*ball, centers, TrainConfig(), SceneConfig())
    surfels["opacity_logits"].fill_(4.0)
    return Scene(SceneConfig(), surfels, None)


@pytest.fixture(scope="session")
def views(cameras, truth) -> list[View]:
    with torch.no_grad():
        return [View(camera, truth.render(camera).rgb.clamp(0, 1)) for camera in cameras]


@pytest.fixture
def make_scene(cameras, ball):
    """make(texture, every n-th point of the ball) -> a new scene."""

    def make(texture: bool = True, every: int = 6, config: SceneConfig | None = None) -> Scene:
        config = config or SceneConfig()
        centers = torch.stack([camera.center for camera in cameras])
        surfels, _ = surfels_from_points(*(t[::every] for t in ball), centers, TrainConfig(), config)
        generator = torch.Generator().manual_seed(0)
        field = HashField(config, (0.0, 0.0, 0.0), 1.5, False, 10, generator) if texture else None
        return Scene(config, surfels, field)

    return make
