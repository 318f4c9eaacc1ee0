"""Diverging runs recover or say why, and never end with a scene that is not finite."""

import math
import warnings
from dataclasses import replace

import pytest
import torch

from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import DensifyConfig, GuardConfig, LearningRates, PoseConfig, TrainConfig
from bitymi_ns.train.divergence import TrainingDiverged, describe_broken
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer
from tests.train.part_of_a_run import resume, state_of


def config_of(factor: float = 1.0, **guard: float) -> TrainConfig:
    densify = DensifyConfig(max_surfels=300, min_interval=20, min_reset_interval=10_000, pixels_per_surfel=0)
    rates = LearningRates().times(factor)
    return TrainConfig(densify=densify, lr=rates, guard=GuardConfig(**guard), resolution_schedule=0)


def run(trainer: Trainer, steps: int) -> list[dict[str, float]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return [trainer.advance()[2] for _ in range(steps)]


@pytest.fixture
def begun(make_scene, views):
    """begun(steps, ...) -> a trainer after these steps."""

    def make(steps: int, of: int = 120, config: TrainConfig | None = None, **scene) -> Trainer:
        trainer = Trainer(make_scene(**scene), views, config or config_of(), of)
        run(trainer, steps)
        return trainer

    return make


def test_a_healthy_run_is_left_alone(make_scene, views):
    log = {}
    for rollbacks in (5, 0):
        scene = make_scene()
        trainer = Trainer(scene, views, config_of(rollbacks=rollbacks), 60)
        run(trainer, 60)
        assert trainer.training.guard.rollbacks == 0 and trainer.training.guard.factor == 1.0
        log[rollbacks] = scene.surfels["means"].detach().clone()
    torch.testing.assert_close(log[5], log[0], rtol=0, atol=0)


@pytest.mark.parametrize("factor", [10.0, 10_000.0])
def test_rates_that_are_too_high_end_in_a_recovered_scene_or_a_message(make_scene, views, factor):
    scene, config = make_scene(), config_of(factor)
    start = evaluate(scene, views, config).psnr
    trainer = Trainer(scene, views, config, 120)
    try:
        reports = run(trainer, 120)
    except TrainingDiverged as error:
        assert "Lower the learning rates" in str(error) and "training diverged at step" in str(error)
        reports = []
    assert not describe_broken(scene)
    psnr = evaluate(scene, views, config).psnr
    assert math.isfinite(psnr) and psnr > start - 3.0
    assert sum("rolled_back" in report for report in reports) == trainer.training.guard.rollbacks or not reports


def test_a_field_that_breaks_on_the_way_is_restored(begun, views):
    trainer = begun(50)
    scene = trainer.scene
    good = scene.field.field_table.detach().clone()
    scene.field.field_w3.data[4] = math.nan
    message = r"step 5\d: training diverged .*field_w3 is not finite.*learning rates times 0.3"
    with pytest.warns(UserWarning, match=message):
        for _ in range(20):
            trainer.advance()
    assert trainer.training.guard.rollbacks == 1 and not describe_broken(scene)
    rate = trainer.training.schedule.lr("quats", 69)
    assert trainer.optimizers["quats"].param_groups[0]["lr"] == pytest.approx(0.3 * rate)
    assert (scene.field.field_table - good).abs().max() < 0.5
    run(trainer, 50)
    assert evaluate(scene, views, trainer.config).psnr > 15


def test_a_field_that_breaks_just_before_a_prune_is_restored(make_scene, views):
    """The prune detects it before the next loss."""
    scene = make_scene()
    trainer = Trainer(scene, views, config_of(), 120)
    schedule = trainer.training.schedule
    prune = next(step for step in range(50, 120) if step in schedule.densify_steps | schedule.final_prune_steps)
    run(trainer, prune)
    step = trainer.training.strategy.step

    def broken(*arguments):
        scene.field.field_w3.data[4] = math.nan
        trainer.training.strategy.step = step
        return step(*arguments)

    trainer.training.strategy.step = broken
    with pytest.warns(UserWarning, match=f"step {prune}: training diverged .*field_w3 is not finite"):
        _, _, report = trainer.advance()
    assert report["rolled_back"] > 0 and trainer.training.guard.rollbacks == 1 and not describe_broken(scene)
    run(trainer, 20)
    assert trainer.training.guard.rollbacks == 1


def test_views_drawn_worse_than_blank_ones_take_the_run_back(begun, views):
    trainer = begun(100)
    good = evaluate(trainer.scene, views, trainer.config).psnr
    assert trainer.training.guard.window == 20  # windows end with the run
    trainer.scene.surfels["sv_rgb"].data += 5.0
    with pytest.warns(UserWarning, match="step 119: training diverged .the views are drawn worse than blank ones"):
        for _ in range(20):
            trainer.advance()
    assert trainer.training.guard.rollbacks == 1
    assert evaluate(trainer.scene, views, trainer.config).psnr > good - 3


def test_texels_begin_a_window_of_their_own(make_scene, views):
    """States from before have no texels."""
    config = config_of()
    config.texels.start = 18_000
    trainer = Trainer(make_scene(texture=False, config=SceneConfig(texture="texels")), views, config, 250)
    start, guard = trainer.training.schedule.texels_start, trainer.training.guard
    run(trainer, start)
    assert guard._states[0][0] < start
    run(trainer, 1)
    assert guard._count == 1 and guard._states[0][0] == start
    run(trainer, 250 - trainer.step)
    assert guard.rollbacks == 0


def test_a_few_broken_surfels_are_dropped_and_many_take_the_run_back(begun):
    trainer = begun(30, of=200, every=2)
    scene = trainer.scene
    before = len(scene)
    scene.surfels["sv_rgb"].data[3] = math.nan  # the loss is not finite
    scene.surfels["quats"].data[7] = math.inf  # not drawn, without effect on the loss
    with pytest.warns(UserWarning, match="2 surfels were no longer finite and were dropped"):
        trainer.advance()
    assert len(scene) == before - 2 and not describe_broken(scene) and trainer.training.guard.rollbacks == 0
    run(trainer, 20)
    scene.surfels["means"].data[:60] = math.nan
    with pytest.warns(UserWarning, match="means is not finite in 60 of .* rows"):
        (report,) = (r for r in (trainer.advance()[2] for _ in range(trainer.training.guard.window)) if "rates" in r)
    assert report["rolled_back"] > 0 and report["rates"] == pytest.approx(0.3) and not describe_broken(scene)
    run(trainer, 5)


def test_going_back_restores_exposures_and_poses(begun):
    config = replace(config_of(), exposure="gain", refine_poses="on", poses=PoseConfig(start=0))
    trainer = begun(1, of=300, config=config)
    training, guard = trainer.training, trainer.training.guard
    before = training.exposure.table.clone(), training.poses.motions.clone()
    guard._states = [(1, guard._capture())]
    run(trainer, 8)
    assert not torch.equal(training.exposure.table, before[0]) and not torch.equal(training.poses.motions, before[1])
    with pytest.warns(UserWarning, match="diverged"):
        guard._go_back(9, "a test")
    assert torch.equal(training.exposure.table, before[0]) and torch.equal(training.poses.motions, before[1])
    run(trainer, 1)


def test_it_does_not_go_back_for_ever(begun):
    trainer = begun(5, config=config_of(rollbacks=2, rates=0.5))
    with pytest.raises(TrainingDiverged, match=r"after 2 rollbacks .rates times 0.25.: .* Lower"):
        for _ in range(3):
            trainer.scene.field.field_w1.data[0] = math.inf
            run(trainer, 1)


def test_images_that_are_not_finite_are_named_and_nothing_goes_back(make_scene, views):
    scene = make_scene(texture=False)
    broken = [views[0]._replace(image=torch.full((48, 48, 3), math.nan))]
    trainer = Trainer(scene, broken, config_of(), 120)
    with pytest.raises(TrainingDiverged, match="look for NaN in the images"):
        trainer.advance()
    assert trainer.training.guard.rollbacks == 0


def test_a_resumed_run_keeps_its_lowered_rates(begun):
    trainer = begun(30)
    trainer.scene.field.field_w3.data[4] = math.nan
    run(trainer, 2)
    resumed = begun(0, every=5)
    resume(resumed, state_of(trainer))
    assert (resumed.training.guard.factor, resumed.training.guard.rollbacks) == (pytest.approx(0.3), 1)
    run(resumed, 10)
    run(trainer, 10)
    torch.testing.assert_close(resumed.scene.surfels["means"], trainer.scene.surfels["means"], rtol=1e-4, atol=1e-6)
