"""Texels trained in the last part of a run."""

from dataclasses import replace

import pytest
import torch

from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.scene.field import TexelField
from bitymi_ns.scene.visibility import visibility
from bitymi_ns.train import texels
from bitymi_ns.train.config import DensifyConfig, TexelConfig, TrainConfig
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.fit import Trainer, fit
from bitymi_ns.train.processes import Processes
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.texels import (
    LEAST_COVERAGE,
    SMALLEST,
    LearningTexels,
    blank_texels,
    coverage,
    single_view_coverage,
    tiles_as_seen,
)
from bitymi_ns.train.views import at_size
from tests.train.part_of_a_run import advanced, resume, state_of

OPTIONS = TexelConfig(start=18_000, pixels_per_texel=0.5)


def config(**options) -> TrainConfig:
    densify = DensifyConfig(max_surfels=250, min_interval=1, min_reset_interval=1, pixels_per_surfel=0)
    return TrainConfig(densify=densify, texels=OPTIONS, **options)


@pytest.fixture
def textured(make_scene):
    """make(**options) -> a scene that will have texels."""

    def make(**options):
        scene = make_scene(texture=False, **options)
        scene.config.texture = "texels"
        return scene

    return make


def test_the_last_part_of_a_run() -> None:
    with_texels, without = (Schedule(config(), 600, 2.0, texels) for texels in (True, False))
    assert [with_texels.texels_learn(step) for step in (359, 360, 599)] == [False, True, True]
    assert not without.texels_learn(599) and max(with_texels.densify_steps | with_texels.reset_steps) < 360
    for name in ("means", "opacity_logits", "sv_rgb"):
        assert with_texels.lr(name, 359) == without.lr(name, 359)
        rates = [with_texels.lr(name, step) for step in range(360, 600)]
        assert rates == sorted(rates, reverse=True) and rates[-1] < 1e-3 * rates[0] > 0
    assert with_texels.lr("exposure", 400) == without.lr("exposure", 400)
    assert with_texels.texel_rate(360) == OPTIONS.rate > with_texels.texel_rate(500) > 0
    few_passes = [with_texels.texel_rate(360, count) for count in (1, 24, 100, 10_000)]
    assert few_passes == pytest.approx([OPTIONS.rate, 0.2 * OPTIONS.travel, OPTIONS.travel / 1.2, OPTIONS.travel])
    early = TrainConfig(texels=TexelConfig(start=6_000))
    assert max(Schedule(early, 3000, texels=True).densify_steps) < 600 < max(Schedule(early, 3000).densify_steps)
    never = Schedule(TrainConfig(texels=TexelConfig(start=30_000)), 600, texels=True)
    assert not never.texels_learn(599) and never.lr("quats", 599) == without.lr("quats", 599)


def test_every_surfel_gets_a_tile_as_fine_as_it_is_seen(textured, views) -> None:
    scene = textured()
    with torch.no_grad():
        scene.surfels["means"][0] += 1e4  # no view sees it
    surfels = {name: value.detach() for name, value in scene.surfels.items()}
    cameras = [view.camera for view in views]
    bound = scene.config.weight_bound
    seen = visibility(surfels, cameras, scene.near, bound)
    sizes = []
    for pixels in (0.05, 0.5, 1e6):
        options = TexelConfig(pixels_per_texel=pixels)
        size, extent = tiles_as_seen(surfels, cameras, seen, scene.near, bound, options)
        assert ((extent > 0) & (extent <= SUPPORT)).all() and size.dtype == torch.int32
        area = size.long().prod(1)
        assert set(size.unique().tolist()) <= {1, 4, 8, 16, 32, 64}
        assert ((area <= 16) | (area <= seen.pixels / pixels)).all()
        sizes.append(area)
    assert (sizes[0] >= sizes[1]).all() and (sizes[1] >= sizes[2]).all() and sizes[0].sum() > 2 * sizes[2].sum()
    assert sizes[0][0] <= 16


def test_there_are_no_more_texels_than_a_run_can_use(textured, views, monkeypatch) -> None:
    scene, cameras = textured(), [view.camera for view in views]
    pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
    options = replace(OPTIONS, pixels_per_texel=0.01, rendered_pixels_per_texel=8.0)
    free, _ = blank_texels(scene, views, len(views), options, to_come=1)  # below any limit
    smallest = SMALLEST**2 * len(scene)
    assert len(free.texels) > 2 * smallest
    monkeypatch.setattr(texels, "FEW", smallest)
    for share in (0.5, 0.8, 2.0):
        to_come = share * len(free.texels) * options.rendered_pixels_per_texel / pixels
        bound, _ = blank_texels(scene, views, len(views), options, to_come)
        if share < 1:
            assert 0.5 * share * len(free.texels) < len(bound.texels) <= share * len(free.texels)
            assert (bound.size <= free.size).all()
        else:
            assert torch.equal(bound.size, free.size)
    assert len(blank_texels(scene, views, len(views), options, to_come=0)[0].texels) <= smallest


@pytest.mark.parametrize("alpha", [False, True])
def test_processes_exchange_the_gradients_of_texels_that_a_view_moves(alpha: bool, textured, monkeypatch) -> None:
    """Two processes: this one moves texels 0 and 2, the other one texels 2 and 5."""
    reduced = []

    def reduce(self: Processes, tensors: list[torch.Tensor], how: object) -> None:
        reduced.append(sum(tensor.nbytes for tensor in tensors))
        if tensors[0].dtype == torch.uint8:
            tensors[0].copy_(torch.tensor([1, 0, 1, 0, 0, 1]))
        else:
            for tensor in tensors:
                tensor[1:] += 1.0

    monkeypatch.setattr(Processes, "_reduce", reduce)
    scene, one = textured(), torch.ones(6, 1)
    scene.field = TexelField(one[:, :1].expand(6, 2), one[:, 0], torch.zeros(6, 3), 0 * one[:, 0] + 0.1)
    scene.field.alpha = torch.nn.Parameter(one[:, 0].clone()) if alpha else None
    learning = LearningTexels(scene, Schedule(config(), 600, 2.0, texels=True), Processes(0, 2))
    own = torch.tensor([4.0, 0, 2, 0, 0, 0])
    scene.field.texels.grad = own[:, None].expand(6, 3).clone()
    if alpha:
        scene.field.alpha.grad = own.clone()
    learning.average()
    want = torch.tensor([2.0, 0, 1.5, 0, 0, 0.5])
    assert reduced == [6, 3 * (16 if alpha else 12)]
    assert torch.equal(scene.field.texels.grad, want[:, None].expand(6, 3))
    assert not alpha or torch.equal(scene.field.alpha.grad, want)
    learning.step()
    assert torch.equal(scene.field.texels.detach()[:, 0], -0.1 * want) and scene.field.texels.grad is None


def test_coverage_is_the_gradient_of_the_summed_picture(textured, views) -> None:
    scene = textured()
    field, _ = blank_texels(scene, views, len(views), OPTIONS)
    covered = coverage(scene, field, views)
    assert torch.allclose(field.share, 1 / (covered + OPTIONS.prior))
    half, _ = blank_texels(scene, views, 2 * len(views), OPTIONS)  # half of the views represent all
    cameras = [view.camera for view in views]
    least = LEAST_COVERAGE * single_view_coverage(scene.surfels, cameras, half.size, half.extent, scene.near).detach()
    assert torch.allclose(half.share, 1 / (torch.maximum(2 * covered, least) + OPTIONS.prior))
    with torch.no_grad():
        scene.surfels["sv_rgb"].fill_(0.2)  # avoids clipping
    scene.field, total = field, 0.0
    for view in views:
        image = scene.render(view.camera).rgb[..., 0]
        total = total + (image if view.mask is None else image * view.mask.reshape(image.shape)).sum()
    total.backward()
    torch.testing.assert_close(covered, field.texels.grad[:, 0], rtol=1e-4, atol=1e-4)
    assert (covered > 0).any()


def test_large_photographs_are_looked_through_at_half_their_size(textured, views, monkeypatch) -> None:
    scene, cameras = textured(), [view.camera for view in views]
    whole, _ = blank_texels(scene, views, len(views), OPTIONS)
    pixels = sum(camera.width * camera.height for camera in cameras) // len(cameras)
    monkeypatch.setattr(texels, "SURVEY_PIXELS", pixels // 4)
    field, _ = blank_texels(scene, views, len(views), OPTIONS)
    halves = [at_size(view, view.camera.scaled(0.5), "cpu") for view in views]
    assert all(half.camera.width == round(0.5 * camera.width) for half, camera in zip(halves, cameras, strict=True))
    found, at_full_size = 4 * coverage(scene, field, halves), coverage(scene, field, views)
    assert torch.allclose(field.share, 1 / (found + OPTIONS.prior))
    assert 0.95 < float(found.sum() / at_full_size.sum()) < 1.05
    assert float((found - at_full_size).norm()) < 0.5 * float(at_full_size.norm())
    assert 0.9 < len(field.texels) / len(whole.texels) < 1.1


def test_views_that_were_not_looked_through_move_no_texel_far(textured, views) -> None:
    scene, far = textured(), 0.0
    field, _ = blank_texels(scene, views[:1], len(views), OPTIONS)
    counted = coverage(scene, field, views[:1]) * len(views)
    for view in views[1:]:
        seen = coverage(scene, field, [view])
        far = max(far, float((seen / (counted + OPTIONS.prior)).max()))
        assert float((seen * field.share).max()) < 1.5 / LEAST_COVERAGE  # times the rate
    assert far > 1.5 / LEAST_COVERAGE


def test_a_run_with_texels_is_better_than_one_without(textured, make_scene, views) -> None:
    quality = []
    for scene in (textured(), make_scene(texture=False)):
        fit(scene, views[1:], [], config(resolution_schedule=0), 300)
        quality.append(evaluate(scene, views[1:], config()).psnr)
        assert all(torch.isfinite(p).all() for p in scene.parameters())
    assert quality[0] > quality[1] + 0.3


def test_a_run_resumes_before_and_after_its_texels_came(textured, views) -> None:
    straight, states = Trainer(textured(), views, config(), 60), []
    for step in range(60):
        if step in (30, 40):
            states.append(state_of(straight))
        straight.advance()
    assert isinstance(straight.scene.field, TexelField)
    for state in states:
        resumed = Trainer(textured(every=5), views, config(), 60)
        resume(resumed, state)
        assert isinstance(resumed.scene.field, TexelField) == (resumed.step == 40)
        advanced(resumed, 60 - resumed.step)
        theirs, ours = straight.scene.state_dict(), resumed.scene.state_dict()
        assert theirs.keys() == ours.keys()
        assert all(torch.equal(theirs[name], ours[name]) for name in theirs)


@pytest.mark.slow
@pytest.mark.parametrize("length", [45, 97, 400])
def test_a_run_of_another_length_goes_on_at_every_event(textured, views, length: int) -> None:
    """Events of 60 steps: densifications until 29, resets, texels from 36, final prunes until 54, poses until 54."""
    options = config(exposure="gain", refine_poses="on")
    first, states = Trainer(textured(), views, options, 60), []
    for step in range(60):
        first.advance()
        if step in (1, 28, 35, 36, 59) and first.step < length:
            states.append(state_of(first))
    for state in states:
        resumed = Trainer(textured(every=5), views, options, length)
        resume(resumed, state)
        schedule, had_texels = resumed.training.schedule, state["step"] > 36
        assert not had_texels or (schedule.texels_start, schedule.resolution_factor(resumed.step)) == (36, 1.0)
        known = {*schedule.densify_steps, *schedule.reset_steps, *schedule.error_prune_steps, length - 1}
        events = {*known, *schedule.final_prune_steps, schedule.texels_start}
        for event in sorted(event for event in events if event >= resumed.step):
            resumed.step = event  # other steps change no shapes
            *_, report = resumed.advance()
            assert not (had_texels and {"cloned", "opacity_reset"} & report.keys())
        field = resumed.scene.field
        assert isinstance(field, TexelField) and len(field.size) == len(resumed.scene)
        assert int(field.size.long().prod(1).sum()) == len(field.texels)


def test_surfels_that_are_pruned_take_their_texels_along(textured, views) -> None:
    scene = textured()
    trainer = advanced(Trainer(scene, views, config(), 60), 40)
    field, n = scene.field, len(scene)
    camera = views[0].camera
    with torch.no_grad():
        scene.surfels["opacity_logits"][3] = scene.surfels["opacity_logits"][n - 1] = -20.0
        before = scene.render(camera).rgb
    gone = torch.zeros(n, dtype=torch.bool)
    gone[[3, n - 1]] = True
    left = len(field.texels) - int(field.size[gone].prod(1).sum())
    trainer.training.strategy.remove(gone)
    assert len(scene) == len(field.size) == len(field.extent) == n - 2
    assert len(field.texels) == len(field.share) == field.tiles.count == left
    with torch.no_grad():
        torch.testing.assert_close(scene.render(camera).rgb, before, rtol=0, atol=1e-6)
    trainer.advance()


def test_a_run_that_diverges_goes_back_to_its_texels(textured, views) -> None:
    scene = textured()
    trainer = advanced(Trainer(scene, views, config(), 60), 45)
    gone = torch.arange(len(scene)) == 5
    trainer.training.strategy.remove(gone)  # since the state it rolls back to
    with torch.no_grad():
        scene.field.texels[7] = float("nan")
        scene.surfels["means"][:] = float("nan")
    trainer.training.guard.window = 1  # it looks when a window ends
    with pytest.warns(UserWarning, match="back to the state"):
        trainer.advance()
    kept = trainer.training.guard._states[0][1]["scene"]["field.texels"]
    assert kept.dtype == torch.float16 and torch.equal(scene.field.texels, kept.float())
    assert all(torch.isfinite(p).all() for p in scene.parameters())
    assert len(scene.field.size) == len(scene) and len(scene.field.texels) == scene.field.tiles.count
    trainer.advance()
