"""Supervision by depth and normals: loss terms, and runs with and without."""

import math

import numpy as np
import pytest
import torch

from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import LossConfig, TrainConfig
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.losses import depth_error, normal_error, objective
from bitymi_ns.train.views import View, at_size, resample_nearest


def a_plane(height: int = 7, width: int = 9) -> torch.Tensor:
    return 2.0 + 0.02 * torch.arange(width).expand(height, width).double()


def test_depth_error_is_the_relative_error_in_float64() -> None:
    generator = torch.Generator().manual_seed(0)
    depth, alpha = a_plane(), torch.rand(7, 9, 1, generator=generator).double()
    rendered = 3.0 * torch.rand(7, 9, 1, generator=generator).double()
    depth[2, 3], depth[5, 1], depth[0, 0] = 0.0, math.nan, math.inf
    mask = torch.ones(7, 9, dtype=torch.bool)
    mask[6] = False
    relative = (rendered[:6, :, 0] / depth[:6] - alpha[:6, :, 0]).abs()[(depth[:6] > 0) & depth[:6].isfinite()]
    assert float(depth_error(rendered, alpha, depth, mask)) == pytest.approx(float(relative.mean()), rel=1e-12)


def test_gradients_against_finite_differences() -> None:
    generator = torch.Generator().manual_seed(1)
    depth, normal = a_plane(), torch.randn(7, 9, 3, generator=generator).double()
    depth[1, 1], normal[2, 2], normal[3, 3] = 0.0, 0.0, math.nan
    alpha, z = (torch.rand(7, 9, 1, generator=generator).double().requires_grad_() for _ in range(2))
    n = torch.randn(7, 9, 3, generator=generator).double().requires_grad_()
    torch.autograd.gradcheck(lambda z, alpha: depth_error(z, alpha, depth), (z, alpha))
    torch.autograd.gradcheck(lambda n, alpha: normal_error(n, alpha, normal), (n, alpha))


def test_normal_error_of_known_normals() -> None:
    normal = torch.tensor([0.0, 0.0, -2.0]).expand(4, 5, 3).clone()
    alpha = torch.full((4, 5, 1), 0.5)
    assert float(normal_error(0.5 * normal / 2.0, alpha, normal)) == pytest.approx(0.0)
    tilted = torch.tensor([0.0, math.sin(0.4), -math.cos(0.4)]).expand(4, 5, 3)
    assert float(normal_error(0.5 * tilted, alpha, normal)) == pytest.approx(0.5 * (1.0 - math.cos(0.4)), rel=1e-5)


def test_edges_of_depth_do_not_count() -> None:
    depth = torch.full((6, 8), 2.0)
    depth[:, 4:] = 3.0
    rendered = depth[..., None].clone().requires_grad_()
    depth_error(rendered * 1.5, torch.ones(6, 8, 1), depth).backward()
    counted = (rendered.grad[..., 0] != 0.0).any(0)
    assert counted.tolist() == [True, True, True, False, False, True, True, True]


@pytest.mark.parametrize("depth", [0.0, math.nan, -1.0, math.inf])
def test_depth_that_is_unknown_everywhere_has_no_gradient(depth: float) -> None:
    rendered = torch.rand(5, 5, 1).requires_grad_()
    loss = depth_error(rendered, torch.ones(5, 5, 1), torch.full((5, 5), depth))
    loss.backward()
    assert loss == 0 and (rendered.grad == 0).all()


def test_terms_of_a_view_with_maps(make_scene, views) -> None:
    scene, view = make_scene(texture=False), views[0]
    output = scene.render(view.camera, maps=True)
    depth = torch.full((48, 48), 2.5, dtype=torch.float16)
    config = LossConfig(depth_weight=0.1, normal_weight=0.02, geometry_interval=3)
    terms = objective(output, view.image, config, depth=depth, normal=output.normal.detach())
    assert set(terms) == {"photometric", "falloff", "depth", "normal"}
    torch.testing.assert_close(terms["depth"], 0.3 * depth_error(output.depth, output.alpha, depth))
    off = LossConfig(depth_weight=0.0, normal_weight=0.0)
    assert set(objective(output, view.image, off, depth=depth)) == {"photometric", "falloff"}
    assert set(objective(scene.render(view.camera), view.image, config, depth=depth)) == {"photometric", "falloff"}


def test_maps_are_resized_to_the_nearest(views) -> None:
    depth = torch.arange(48 * 48).reshape(48, 48).float()
    view = views[0]._replace(depth=depth, normal=depth[..., None].expand(48, 48, 3))
    small = at_size(view, view.camera.scaled(0.5), "cpu")
    assert torch.equal(small.depth, depth[1::2, 1::2]) and small.normal.shape == (24, 24, 3)
    assert view.nbytes > views[0].nbytes and torch.equal(resample_nearest(depth, 48, 48), depth)
    with pytest.raises(ValueError, match="the depth is 10 x 48"):
        at_size(view._replace(depth=depth[:, :10]), view.camera, "cpu")


def run(make_scene, views: list[View], steps: int = 60, **loss) -> tuple[Scene, list[set[str]]]:
    config = TrainConfig(loss=LossConfig(**loss))
    scene = make_scene(texture=False)
    trainer = Trainer(scene, views, config, steps)
    terms = [set(trainer.advance()[0]) for _ in range(steps)]
    return scene, terms


def with_depth(views: list[View]) -> list[View]:
    """Add the depth of the unit ball to views."""
    result = []
    ys, xs = np.mgrid[0:48, 0:48] + 0.5
    rays = np.stack([(xs - 24) / 45.12, (ys - 24) / 45.12, np.ones_like(xs)], -1)
    for view in views:
        center = view.camera.viewmat[:3, 3].double().numpy()
        a, b, c = (rays**2).sum(-1), rays @ center, center @ center - 1.0
        root = b**2 - a * c
        z = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0.0)
        result.append(view._replace(depth=torch.from_numpy(z).float()))
    return result


@torch.no_grad()
def off_the_surface(scene: Scene, views: list[View]) -> float:
    outputs = [scene.render(view.camera, maps=True) for view in views]
    return sum(float(depth_error(out.depth, out.alpha, view.depth)) for out, view in zip(outputs, views, strict=True))


def test_depth_moves_surfels_to_the_surface(make_scene, views) -> None:
    known = with_depth(views)

    def shifted(*args, **kwargs):
        scene = make_scene(*args, **kwargs)
        scene.surfels["means"].data.mul_(1.1)
        return scene

    without, plain = run(shifted, views, 120)
    with_it, terms = run(shifted, known, 120, depth_weight=1.0, geometry_interval=2)
    assert off_the_surface(with_it, known) < 0.7 * off_the_surface(without, known)
    assert all(("depth" in each) == (step % 2 == 0) for step, each in enumerate(terms))
    assert not any("depth" in each for each in plain)
