"""Short training with the real renderer."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.scene.scene import Scene
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.divergence import LossWatch
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer, fit
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.step import DROPOUT_NUMBERS, view_losses, with_dropout
from bitymi_ns.train.views import View, at_size, random_numbers
from tests.train.part_of_a_run import advanced, resume, state_of

EVERY_EVENT = DensifyConfig(max_surfels=400, min_interval=1, min_reset_interval=1, pixels_per_surfel=0)


def test_a_run_on_photographs_that_show_little_sees_full_size_early(make_scene, views):
    scene = make_scene(texture=False)
    scene.config.texture = "texels"
    pixels = views[0].camera.width * views[0].camera.height
    config = TrainConfig(small_photograph=pixels // 3)
    masks = [torch.rand(view.camera.height, view.camera.width, 1) < share for view in views for share in (2.0, 0.4)]
    full, little = (
        Trainer(scene, [view._replace(mask=mask) for view, mask in zip(views, masks[i::2], strict=True)], config, 1200)
        for i in range(2)
    )
    sizes = [[run.training.schedule.resolution_factor(step) for step in (250, 300, 500)] for run in (full, little)]
    assert sizes == [[0.5, 0.5, 1.0], [0.5, 1.0, 1.0]]


def test_a_short_run_is_a_proper_run(make_scene, views):
    scene, config, seen = make_scene(), TrainConfig(densify=EVERY_EVENT), []
    before = evaluate(scene, views[:1], config).psnr
    log = fit(scene, views[1:], views[:1], config, 200, callback=lambda t: seen.append(len(t.scene)), eval_steps=[100])
    assert [entry.step for entry in log.entries] == [100, 200]
    assert log.entries[-1].psnr > before + 3.0
    assert log.entries[-1].loss < 0.12
    assert log.entries[1].seconds > log.entries[0].seconds > 0 and log.entries[1].cpu_seconds > 0
    assert log.entries[-1].fragments > 0 and log.entries[-1].surfels == len(scene)
    assert len(seen) == 200 and max(seen) <= 400
    assert sum("split" in event for event in log.events) == 28
    assert sum("opacity_reset" in event for event in log.events) == 4
    assert all(torch.isfinite(p).all() for p in scene.parameters())


@pytest.mark.slow
def test_a_resumed_run_is_the_same_run(make_scene, views):
    densify = replace(EVERY_EVENT, max_surfels=250)
    config = TrainConfig(densify=densify, background="random", freeze_every=1, exposure="affine")
    straight = advanced(Trainer(make_scene(), views, config, 60), 14)
    state = state_of(straight)
    resumed = Trainer(make_scene(every=5), views, config, 60)
    resume(resumed, state)
    for _ in range(14, 40):  # across densifications, resets and a final prune
        straight.advance()
        resumed.advance()
    assert len(resumed.scene) == len(straight.scene) != len(state["scene"]["surfels.means"])
    for (name, a), (_, b) in zip(straight.scene.named_parameters(), resumed.scene.named_parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-6, msg=name)
    exposures = [run.training.exposure for run in (straight, resumed)]
    torch.testing.assert_close(exposures[0].table, exposures[1].table)
    moments = [e.state_dict()["optimizer"]["state"][0]["exp_avg"].to_dense() for e in exposures]
    torch.testing.assert_close(*moments)


def test_timing_a_step_at_other_sizes_changes_nothing(make_scene, views):
    plain, timed = (Trainer(make_scene(), views, TrainConfig(densify=EVERY_EVENT), 40) for _ in range(2))
    for step in range(20):
        plain.advance()
        timed.advance()
        if step in (2, 12):
            assert all(timed.training.seconds_at(size) >= 0.0 for size in (0.25, 0.5, 1.0))
    assert len(plain.scene) == len(timed.scene) and plain.scene.state_dict().keys() == timed.scene.state_dict().keys()
    assert all(torch.equal(value, timed.scene.state_dict()[name]) for name, value in plain.scene.state_dict().items())
    moments = [
        [torch.get_rng_state(), *trainer.optimizers["means"].state_dict()["state"][0].values()]
        for trainer in (plain, timed)
    ]
    assert all(torch.equal(a, b) for a, b in zip(*moments, strict=True))


def test_the_field_learns_on_its_steps_only(make_scene, views):
    scene, config = make_scene(), TrainConfig(resolution_schedule=0, freeze_min_updates=50)
    schedule = Schedule(config, 600)
    for step, learns in ((0, True), (99, True), (101, False), (110, True)):
        scene.zero_grad(set_to_none=True)
        terms, output = view_losses(scene, views[0], schedule, step, LossWatch())
        sum(terms.values()).backward()
        assert (scene.field.field_w3.grad is not None) == learns
        assert scene.surfels["means"].grad is not None
        assert output.rgb.shape == (48, 48, 3)


@settings(deadline=None, max_examples=20)
@given(probability=st.floats(0.0, 0.99), seed=st.integers(0, 2**40), step=st.integers(0, 2**30))
def test_dropout_keeps_the_odds_and_the_expected_share(probability, seed, step):
    logits = torch.linspace(-6.0, 6.0, 10_000).double().requires_grad_()
    drawn = with_dropout(logits, probability, seed, step)
    drawn.sum().backward()
    kept = drawn > -20.0
    assert abs(float(kept.double().mean()) - (1.0 - probability)) < 0.02
    assert torch.equal(logits.grad, kept.double())
    torch.testing.assert_close(drawn.exp()[kept] * (1.0 - probability), logits.exp()[kept])
    assert torch.equal(drawn, with_dropout(logits, probability, seed, step))
    numbers = [torch.rand(3, generator=random_numbers(seed, first + step)) for first in (0, DROPOUT_NUMBERS)]
    assert not torch.equal(*numbers)
    assert probability < 0.01 or not torch.equal(drawn, with_dropout(logits, probability, seed, step + 1))


def test_a_view_is_drawn_without_the_surfels_left_out(make_scene, views):
    scene, schedule = make_scene(texture=False), Schedule(TrainConfig(), 100)
    terms, _ = view_losses(scene, views[0], schedule, 5, LossWatch(), dropout=0.4)
    sum(terms.values()).backward()
    logits = scene.surfels["opacity_logits"]
    drawn = with_dropout(logits, 0.4, schedule.config.seed, 5).detach()
    left_out = drawn < -20.0
    assert 0.2 < float(left_out.float().mean()) < 0.6
    for name, parameter in scene.surfels.items():
        assert not parameter.grad[left_out].any(), name
    assert logits.grad[~left_out].any()
    rest = Scene(scene.config, {name: value[~left_out] for name, value in scene.surfels.items()}, None, scene.near)
    rest.surfels["opacity_logits"].data = drawn[~left_out]
    want, _ = view_losses(rest, views[0], schedule, 5, LossWatch())
    for name, value in want.items():
        torch.testing.assert_close(terms[name], value)


def test_low_resolution_steps_take_either_picture(make_scene, views):
    scene, config = make_scene(texture=False), TrainConfig()
    schedule = Schedule(config, 3000)
    camera, image, *_ = views[0]
    reduced = camera.scaled(schedule.resolution_factor(0))
    terms, output = view_losses(scene, at_size(views[0], reduced, "cpu"), schedule, 0, LossWatch())
    assert output.rgb.shape == (12, 12, 3)
    small = View(camera, image.reshape(12, 4, 12, 4, 3).mean((1, 3)))
    again, _ = view_losses(scene, at_size(small, reduced, "cpu"), schedule, 0, LossWatch())
    torch.testing.assert_close(again["photometric"], terms["photometric"])


def test_images_with_alpha_and_bytes_and_masks(make_scene, views):
    scene, config = make_scene(texture=False), TrainConfig(background="white", resolution_schedule=0)
    schedule = Schedule(config, 100)
    camera, image, *_ = views[0]
    rgba = torch.cat([image, torch.ones(48, 48, 1)], -1)
    rgba[:, :10] = torch.tensor([0.3, 0.9, 0.1, 0.0])  # transparent: the background shows
    white = image.clone()
    white[:, :10] = 1.0
    mask = torch.zeros(48, 48, 1, dtype=torch.bool)
    mask[10:] = True
    results = []
    for picture in (rgba, white, (rgba * 255).round().to(torch.uint8)):
        terms, _ = view_losses(scene, View(camera, picture, mask), schedule, 3, LossWatch())
        results.append(terms["photometric"].item())
    assert results[0] == pytest.approx(results[1], abs=1e-6)
    assert results[0] == pytest.approx(results[2], abs=2e-3)
    assert math.isfinite(evaluate(scene, [View(camera, rgba, mask)], config).psnr)


def test_the_colour_behind_the_scene_may_be_given(make_scene, views):
    scene, color = make_scene(texture=False), torch.tensor([0.2, 0.4, 0.6])
    scene.surfels["means"].data[:, 2] -= 1e3  # nothing is seen
    camera = views[0].camera
    for kind in ("black", "random"):
        schedule = Schedule(TrainConfig(background=kind), 100)
        for channels in (3, 4):
            view = View(camera, torch.zeros(48, 48, channels))
            shown = view_losses(scene, view, schedule, 0, LossWatch(), color)[1].rgb[0, 0]
            assert torch.equal(shown, color) == (kind == "black")


def test_views_that_see_nothing_and_runs_of_one_step(make_scene, views):
    scene = make_scene()
    away = views[0].camera.viewmat.clone()
    away[2, 3] = -50.0
    camera = type(views[0].camera)(away, views[0].camera.K, 48, 48)
    log = fit(scene, [View(camera, views[0].image)], [], TrainConfig(), 3)
    assert math.isnan(log.entries[-1].psnr) and math.isfinite(log.entries[-1].loss)
    fit(make_scene(), views[:1], views[:1], TrainConfig(), 1)
    with pytest.raises(ValueError, match="no views"):
        fit(make_scene(), [], [], TrainConfig(), 1)
