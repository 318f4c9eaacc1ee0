"""Polish from a shifted and faded scene towards photographs of a known one."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from bitymi_ns.bake import (
    BakeOptions,
    PolishOptions,
    Reduced,
    Stage,
    Trained,
    TuneOptions,
    bake_field,
    polish_scene,
    prune_and_resample,
    tune_atlas,
)
from bitymi_ns.bake.field.tiles import field_tiles
from bitymi_ns.bake.pipeline import trained_texels
from bitymi_ns.scene import Camera
from bitymi_ns.train import losses
from bitymi_ns.train.config import GuardConfig
from bitymi_ns.train.views import View
from tests.bake.test_tune import BACKGROUND, bounded, cameras, photographs, render, waving, with_exposures

OPTIONS = PolishOptions(steps=40, rate=0.3, share=1.0, val_every=4)


@pytest.fixture(scope="module")
def truth(scene) -> Trained:
    """The scene in the photographs, with full view colours."""
    return bounded(waving(scene(60), pixels_per_texel=0.5))


@pytest.fixture(scope="module")
def views(truth: Trained) -> list[View]:
    return photographs(truth)


@pytest.fixture(scope="module")
def wrong(truth: Trained) -> Trained:
    """`truth` with a constant residual, surfels shifted and fainter."""
    g = torch.Generator().manual_seed(0)
    surfels = {name: value.clone() for name, value in truth.scene.surfels.items()}
    surfels["means"] += 0.03 * torch.randn(surfels["means"].shape, generator=g)
    surfels["opacity_logits"] -= 0.4
    return truth.with_colors(torch.full_like(truth.texels, 0.1)).with_surfels(surfels)


def db(baked: Stage, views: list[View]) -> float:
    errors = [(render(baked, v.camera).clamp(0, 1) - v.image).square().mean() for v in views]
    return float(torch.stack(errors).log10().mean() * -10)


def tiles_of(made: Any, seen: list[Camera], pixels_per_texel: float, options: BakeOptions | None = None) -> Trained:
    return field_tiles(trained_texels(made, options or BakeOptions()), made.field, seen, pixels_per_texel)


def test_everything_learns_and_the_gain_is_what_is_stated(wrong: Trained, views: list[View]) -> None:
    polished = polish_scene(wrong, views[:10], BACKGROUND, OPTIONS, eval_views=views[10:])
    same = wrong.become(Reduced, in_front=torch.ones(60), colors=None)
    tuned = tune_atlas(same, views[:10], BACKGROUND, TuneOptions(steps=40, rate=0.3, val_every=4, coded_steps=0))
    told = polished.statistics.polish
    assert (told.views, told.held_in_views, told.steps) == (7, 3, 40)
    assert told.psnr_held_in.after > told.psnr_held_in.before + 3
    assert db(polished, views[10:]) > db(tuned, views[10:]) + 0.5
    assert db(wrong, views[10:]) == pytest.approx(told.psnr_held_out.before, abs=0.01)
    assert db(polished, views[10:]) == pytest.approx(told.psnr_held_out.after, abs=0.05)  # half floats
    for name, before in wrong.scene.surfels.items():
        after = polished.scene.surfels[name]
        assert not torch.equal(after, before) and torch.equal(after[59], before[59]), name  # no view sees the last one
    assert torch.equal(polished.extent, wrong.extent) and (polished.packing.tiles == wrong.packing.tiles).all()
    assert (wrong.texels == 0.1).all() and wrong.statistics.polish is None  # the bake itself is as it was


def test_view_colours_are_reduced_afterwards_and_can_be_tuned(wrong: Trained, views: list[View]) -> None:
    polished = polish_scene(wrong, views[:10], BACKGROUND, OPTIONS)
    polished.scene.surfels["opacity_logits"][5] = -9.0  # no longer drawn
    reduced = prune_and_resample(polished, [v.camera for v in views[:10]])
    assert "view_terms" in reduced.scene.surfels and reduced.statistics.view_color.error.p100 <= 0.76
    left = reduced.statistics.surfels
    assert (left.kept, left.left_out.transparent, left.left_out.unseen) == (58, 1, 1)
    assert reduced.rows.tolist() == [i for i in range(60) if i not in (5, 59)]
    assert db(reduced, views[10:]) == pytest.approx(db(polished, views[10:]), abs=0.1)
    again = tune_atlas(reduced, views[:10], BACKGROUND, TuneOptions(steps=8, coded_steps=0, patience=8))
    assert again.statistics.polish == polished.statistics.polish and again.statistics.finetune.steps == 8


def test_a_bake_whose_surfels_did_not_change_is_nearly_that_of_one_go(scene, views: list[View]) -> None:
    made, seen, options = scene(60), [v.camera for v in views], BakeOptions(format="fp16")
    once, later = bake_field(made, seen, options), tiles_of(made, seen, 1e-3, options)
    assert (later.packing.tiles[:, 3:] >= once.packing.tiles[:, 3:]).all()
    later = prune_and_resample(later, seen)
    assert all(torch.equal(later.scene.surfels[name], value) for name, value in once.scene.surfels.items())
    assert later.statistics.view_color == once.statistics.view_color
    assert later.packing.texels < 1.2 * once.packing.texels  # what the tolerance asks for, of the fitted field
    for camera in seen[:4]:
        atol = 3 * options.tolerance / 255
        torch.testing.assert_close(render(later, camera), render(once, camera), atol=atol, rtol=0)


def test_tiles_are_as_fine_as_the_views_see(scene, views: list[View]) -> None:
    made, seen = scene(60), [v.camera for v in views]
    sizes = [tiles_of(made, seen, each).packing.tiles[:, 3:].prod(1) for each in (0.05, 2.0, 1e6)]
    assert (sizes[0] >= sizes[1]).all() and sizes[0].sum() > 2 * sizes[1].sum() and (sizes[2] <= 16).all()


def test_some_of_the_surfels_keep_their_texels(truth: Trained) -> None:
    kept = torch.arange(60) % 3 > 0
    some = truth.only(kept)
    gone = dict(truth.scene.surfels)
    gone["opacity_logits"] = torch.where(kept, gone["opacity_logits"], -20.0)
    for camera in cameras()[:3]:
        want = render(truth.with_surfels(gone), camera)
        torch.testing.assert_close(render(some, camera), want, rtol=1e-5, atol=1e-5)
    assert truth.only(torch.ones(60, dtype=torch.bool)) is truth


def test_the_best_state_is_kept(truth: Trained, wrong: Trained, views: list[View]) -> None:
    wild = replace(OPTIONS, rate=30.0, share=40.0, patience=2)
    perfect = [View(v.camera, render(wrong, v.camera)) for v in views]
    progress: list[tuple[int, int]] = []
    report = lambda name, *counts: progress.append(counts) if name == "polishing" else None  # noqa: E731
    kept = polish_scene(wrong, perfect, BACKGROUND, wild, progress=report)
    told = kept.statistics.polish
    assert told.best_step == 0 and told.steps < 40
    assert progress[0] == (1, 40) and progress[-1] == (told.steps, told.steps)
    torch.testing.assert_close(kept.texels, wrong.texels, rtol=0, atol=0)
    assert all(torch.equal(kept.scene.surfels[name], value) for name, value in wrong.scene.surfels.items())


def test_steps_not_finite_are_survived(wrong: Trained, views: list[View], monkeypatch: pytest.MonkeyPatch) -> None:
    real, calls = losses.photometric, []

    def sometimes(*arguments: Any) -> Tensor:
        calls.append(1)
        return real(*arguments) * (math.nan if len(calls) in (5, 6) else 1.0)

    monkeypatch.setattr(losses, "photometric", sometimes)
    told = polish_scene(wrong, views, BACKGROUND, OPTIONS)
    assert told.statistics.polish.steps == 40 and told.texels.isfinite().all()
    assert told.statistics.polish.psnr_held_in.after > told.statistics.polish.psnr_held_in.before + 1
    monkeypatch.setattr(losses, "photometric", lambda *a: real(*a) * math.nan)
    given_up = polish_scene(wrong, views, BACKGROUND, OPTIONS)
    assert given_up.statistics.polish.steps == GuardConfig().rollbacks and given_up.statistics.polish.best_step == 0
    torch.testing.assert_close(given_up.texels, wrong.texels, rtol=0, atol=0)


def test_masks_and_exposures(truth: Trained, wrong: Trained, views: list[View]) -> None:
    mask = torch.ones(40, 48, 1, dtype=torch.bool)
    mask[:, :24] = False
    spoilt = [View(v.camera, torch.where(mask, v.image, float("nan")), mask) for v in views]
    polished = polish_scene(wrong, spoilt, BACKGROUND, replace(OPTIONS, steps=12))
    assert polished.texels.isfinite().all() and not torch.equal(polished.texels, wrong.texels)
    assert polished.statistics.polish.psnr_held_in.after > polished.statistics.polish.psnr_held_in.before
    exposed = with_exposures(truth, views)
    blind = [view._replace(correction=None) for view in exposed]
    known, unknown = (db(polish_scene(wrong, each, BACKGROUND, OPTIONS), views) for each in (exposed, blind))
    assert known > unknown + 1.0


@pytest.mark.parametrize(
    "bad", [{"steps": 0}, {"val_every": 1}, {"rate": 0.0}, {"share": 0.0}, {"pixels_per_texel": 0.0}]
)
def test_bad_options_and_too_few_views(wrong: Trained, views: list[View], bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        partial(polish_scene, wrong, views, BACKGROUND)(replace(PolishOptions(), **bad))
    same = polish_scene(wrong, views[:3], BACKGROUND)  # too few
    assert same.texels is wrong.texels and same.statistics.polish.model_dump() == {"steps": 0, "views": 3}
