"""Training steps on the device give the same loss and parameters as on the CPU."""

import math

import pytest
import torch

from bitymi_ns.scene import Camera, HashField, Scene, SceneConfig
from bitymi_ns.train.config import PoseConfig, TrainConfig
from bitymi_ns.train.divergence import TrainingDiverged
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer
from bitymi_ns.train.score import removal_errors
from bitymi_ns.train.views import View
from tests.ops.golden import random_scene
from tests.train.part_of_a_run import advanced

pytestmark = pytest.mark.slow

STEPS = 3


def scene_and_views(dtype: torch.dtype = torch.float32) -> tuple[Scene, list[View]]:
    """Make a few textured discs, and photographs of other colours, one with a mask."""
    case = random_scene(20, 5, width=20, height=16, scale=0.5)
    config = SceneConfig(min_resolution=8, near=0.2)
    field = HashField(config, (0.0, 0.0, 0.0), 4.0, True, 6, torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.field_w3.normal_(0, 0.3, generator=torch.Generator().manual_seed(1))
    scene = Scene(config, {key: value.to(dtype) for key, value in case.params.items()}, field.to(dtype))
    g = torch.Generator().manual_seed(2)
    camera = Camera(case.viewmat.float(), case.K.float(), case.width, case.height)
    first, second = (torch.rand(16, 20, channels, generator=g) for channels in (3, 4))
    return scene, [View(camera, first, torch.rand(16, 20, generator=g) < 0.8), View(camera, second)]


def train(device: torch.device, background: str, exposure: str) -> tuple[list[float], float, dict[str, torch.Tensor]]:
    """Return the losses of the steps, PSNR after them, and the parameters on the CPU."""
    scene, views = scene_and_views()
    config = TrainConfig(
        background=background, exposure=exposure, resolution_schedule=0, freeze_after=1, freeze_every=2
    )
    trainer = Trainer(scene.to(device), views, config, STEPS)
    losses = []
    for _ in range(STEPS):
        trainer.advance()
        losses.append(trainer.loss)
    trainer.training.watch.finish(scene)
    psnr = evaluate(scene, views, config).psnr
    return losses, psnr, {name: p.detach().cpu() for name, p in scene.named_parameters()}


@pytest.mark.parametrize(("background", "exposure"), [("random", "off"), ("black", "gain"), ("random", "affine")])
def test_training_steps_equal_those_of_the_cpu(background: str, exposure: str, both) -> None:
    (losses, psnr, parameters), (want_losses, want_psnr, want) = both(lambda where: train(where, background, exposure))
    assert losses == pytest.approx(want_losses, rel=1e-4)
    assert psnr == pytest.approx(want_psnr, abs=0.01)
    for name, value in want.items():
        # Adam's first steps have the length of the rate: where a gradient is nearly 0 their sign may differ
        close = torch.isclose(parameters[name], value, rtol=1e-3, atol=1e-4)
        assert close.float().mean() > 0.97, name


def motions(device: torch.device) -> torch.Tensor:
    """Return the refined poses' motions after a few steps."""
    scene, views = scene_and_views()
    config = TrainConfig(resolution_schedule=0, refine_poses="on", poses=PoseConfig(start=0))
    trainer = advanced(Trainer(scene.to(device), views, config, STEPS), STEPS)
    return trainer.training.poses.motions


def test_poses_move_as_on_the_cpu(device: torch.device, both) -> None:
    found, want = both(motions)
    assert found.device.type == "cpu" and want.abs().max() > 1e-4
    torch.testing.assert_close(found, want, rtol=0.02, atol=1e-5)


def test_a_loss_that_is_not_finite_ends_the_run(device: torch.device) -> None:
    scene, views = scene_and_views()
    broken = [View(views[0].camera, torch.full_like(views[0].image, math.nan))]
    trainer = Trainer(scene.to(device), broken, TrainConfig(resolution_schedule=0), 10)
    with pytest.raises(TrainingDiverged, match="loss is nan at step 0"):
        trainer.advance()
        trainer.training.watch.finish(scene)


def test_removal_errors_equal_those_of_the_cpu(device: torch.device, cpu) -> None:
    scene, views = scene_and_views()
    errors, total = removal_errors(scene.to(device), views, TrainConfig(), 7)
    with cpu():
        want, want_total = removal_errors(scene.to("cpu"), views, TrainConfig(), 7)
    assert want.gt(0).any() and total.item() == pytest.approx(want_total.item(), rel=1e-4)
    torch.testing.assert_close(errors.cpu(), want, rtol=1e-3, atol=1e-6)
