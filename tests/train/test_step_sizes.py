"""Steps in pixels: footprints against float64, scale invariance, scenes of large extent and fine detail."""

import math
import warnings

import pytest
import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import LearningRates, TexelConfig, TrainConfig
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.init import scene_for_views
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.step_sizes import MEASURED, StepSizes, pixel_footprints
from bitymi_ns.train.views import View
from tests.train.conftest import look_at_origin
from tests.train.part_of_a_run import advanced


def reference(means: Tensor, cameras: list[Camera], near: float) -> Tensor:
    """Compute footprints in float64; inf where no view holds a centre."""
    found = []
    for mean in means.double():
        sides = [math.inf]
        for camera in cameras:
            x, y, z = (camera.viewmat.double() @ torch.cat([mean, torch.ones(1).double()]))[:3].tolist()
            (fx, _, cx), (_, fy, cy) = camera.K[:2].double().tolist()
            if z > near and 0 <= fx * x / z + cx < camera.width and 0 <= fy * y / z + cy < camera.height:
                sides.append(z / (0.5 * (fx + fy)))
        found.append(min(sides))
    return torch.tensor(found, dtype=torch.float64)


@pytest.mark.parametrize("size", [1.0, 1e-4, 1e5])
def test_footprints_are_those_of_the_nearest_view_that_holds_a_centre(size: float) -> None:
    g = torch.Generator().manual_seed(0)
    cameras = []
    for i in range(12):
        camera = look_at_origin((torch.randn(3, generator=g) * (1 + i) * size).tolist(), 40 + i)
        K = camera.K.clone()
        K[0, 0], K[0, 2] = (1 + 0.1 * i) * K[0, 0], K[0, 2] + i
        cameras.append(Camera(camera.viewmat, K, camera.width, camera.height + i))
    means = 4 * size * torch.randn(300, 3, generator=g)
    want = reference(means, cameras, 0.02 * size)
    got = pixel_footprints(means, cameras, 0.02 * size, 1.0).double()
    held = want.isfinite()
    assert 50 < int(held.sum()) < 300  # some that no view holds
    torch.testing.assert_close(got[held], want[held], rtol=1e-5, atol=0)
    assert bool((got[~held] == got[held].median()).all())


def test_footprints_of_what_cannot_be_seen_are_finite() -> None:
    camera = look_at_origin([3.0, 0.0, 0.0])
    behind = torch.tensor([[9.0, 0.0, 0.0], [math.nan, 0.0, 0.0], [math.inf, 0.0, 0.0], [3.0, 0.0, 0.0]])
    assert pixel_footprints(behind, [camera], 0.02, 2.0).tolist() == pytest.approx([2.0 / float(camera.K[0, 0])] * 4)
    some = pixel_footprints(torch.cat([behind, torch.zeros(1, 3)]), [camera], 0.02, 2.0)
    assert some.tolist() == pytest.approx([3.0 / float(camera.K[0, 0])] * 5)


def test_many_views_are_sampled(cameras: list[Camera]) -> None:
    assert len(StepSizes(Schedule(TrainConfig(), 100), cameras * 20).cameras) == MEASURED


def test_a_step_moves_near_and_far_surfels_by_as_many_pixels(make_scene, views: list[View]) -> None:
    scene = make_scene(texture=False)
    with torch.no_grad():
        scene.surfels["means"][::2] *= 0.3
    trainer = Trainer(scene, views, TrainConfig(resolution_schedule=0), 100)
    before = scene.surfels["means"].detach().clone()
    trainer.advance()  # Adam's first step equals its rate in every coordinate
    moved = (scene.surfels["means"].detach() - before).abs()
    footprints = trainer.training.step_sizes.footprints
    pixels = trainer.training.schedule.lr("means", 0)
    assert pixels == pytest.approx(4 * LearningRates().mean_pixels[0])
    touched = moved[:, 0] > 0
    assert int(touched.sum()) > 50 and float(footprints.max()) > 1.2 * float(footprints.min())
    want = (pixels * footprints)[touched, None].expand(-1, 3)
    torch.testing.assert_close(moved[touched], want, rtol=1e-2, atol=0)


def test_the_scale_of_a_capture_changes_nothing(views: list[View], ball: tuple[Tensor, Tensor]) -> None:
    losses = []
    for by in (1.0, 256.0, 2.0**-7):
        xyz, rgb = (t[::6] for t in ball)
        config = TrainConfig(resolution_schedule=0)
        unit = torch.tensor([1.0, 1.0, 1.0, by])  # of the columns of poses
        here = [view._replace(camera=view.camera.posed(view.camera.viewmat * unit)) for view in views]
        trainer = Trainer(scene_for_views(here, xyz * by, rgb, SceneConfig(texture="none"), config), here, config, 60)
        advanced(trainer, 60)
        losses.append(trainer.loss)
    assert losses[1:] == pytest.approx(losses[:1] * 2, rel=0.05)


def fine(views: list[View], by: float) -> list[View]:
    """Make the scene small in its capture: cameras farther away with longer lenses, one of them on the other side of
    the world, so that the extent is large."""
    found = []
    for view in views:
        camera = view.camera
        viewmat = camera.viewmat.clone()
        viewmat[2, 3] *= by
        K = camera.K.clone()
        K[0, 0], K[1, 1] = by * K[0, 0], by * K[1, 1]
        found.append(view._replace(camera=Camera(viewmat, K, camera.width, camera.height)))
    return found


@pytest.mark.parametrize("by", [1.0, 30.0])
def test_texels_keep_the_picture_of_a_scene_with_a_large_extent(
    views: list[View], ball: tuple[Tensor, Tensor], by: float
) -> None:
    """With steps relative to the extent, 30 times as many pixels per step, training diverges."""
    here, losses = fine(views, by), {}
    for name, rates in {"pixels": LearningRates(), "extent": LearningRates(means=(1.6e-4, 1.6e-6))}.items():
        config = TrainConfig(lr=rates, resolution_schedule=0, texels=TexelConfig(start=18_000))
        scene = scene_for_views(here, *ball, SceneConfig(texture="texels"), config)
        trainer = Trainer(scene, here, config, 300)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            while trainer.step < 300:
                if trainer.step == trainer.training.schedule.texels_start:
                    before = evaluate(scene, here, config).psnr
                trainer.advance()
        losses[name] = (before, evaluate(scene, here, config).psnr, trainer.training.guard.rollbacks)
    step_sizes = trainer.training.step_sizes  # of rates in extents
    assert step_sizes.factors() == {} and step_sizes.rate("means", 9) == trainer.training.schedule.lr("means", 9)
    before, after, rollbacks = losses["pixels"]
    assert after > before and rollbacks == 0
    if by > 1:
        assert losses["extent"][1] < after - 1.0
