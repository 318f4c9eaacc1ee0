"""Views that see no initial point."""

import pytest
import torch

from bitymi_ns.scene import visibility
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.scene.scene import Scene
from bitymi_ns.scene.visibility import views_without_surfels
from bitymi_ns.train.config import TrainConfig
from bitymi_ns.train.init import surfels_from_points


def scene_at(points: torch.Tensor, scale: float = 0.01) -> Scene:
    config = SceneConfig(texture="none")
    surfels, _ = surfels_from_points(points, torch.full_like(points, 0.5), torch.zeros(1, 3), TrainConfig(), config)
    surfels["log_scales"] = torch.full_like(surfels["log_scales"], scale).log()
    return Scene(config, surfels, None, 0.05)


def camera(turned: bool = False) -> Camera:
    """Make a camera at the origin, looking along z or -z."""
    viewmat = torch.eye(4)
    if turned:
        viewmat[0, 0] = viewmat[2, 2] = -1.0
    return Camera(viewmat, torch.tensor([[40.0, 0.0, 20.0], [0.0, 40.0, 15.0], [0.0, 0.0, 1.0]]), 40, 30)


@pytest.mark.parametrize("sample", [1, 4096])
def test_views_that_see_nothing_are_named(sample: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visibility, "SAMPLE", sample)
    points = torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [50.0, 0.0, 2.0], [90.0, 0.0, 2.0]])
    assert views_without_surfels(scene_at(points), [camera(), camera(turned=True)]) == [1]


def test_discs_that_reach_into_the_picture_are_seen() -> None:
    beside = torch.tensor([[1.2, 0.0, 2.0], [1.3, 0.0, 2.0]])  # the picture ends at x = 1
    assert views_without_surfels(scene_at(beside), [camera()]) == [0]
    assert views_without_surfels(scene_at(beside, scale=0.1), [camera()]) == []
    too_near = torch.tensor([[0.0, 0.0, 0.01], [0.001, 0.0, 0.01]])
    assert views_without_surfels(scene_at(too_near, scale=1e-4), [camera()]) == [0]
