"""Fine-tuning of a wrong atlas towards photographs of a known one."""

from dataclasses import replace
from functools import partial
from statistics import fmean
from typing import Any, TypeVar

import pytest
import torch
from torch import Tensor

from bitymi_ns.bake import BakeOptions, Coded, Reduced, Stage, Trained, TuneOptions, prune_and_resample, tune_atlas
from bitymi_ns.bake.field.tiles import field_tiles
from bitymi_ns.bake.pipeline import trained_texels
from bitymi_ns.bake.stages import with_means
from bitymi_ns.bake.tiles import Tiles
from bitymi_ns.bake.tuning_views import TexelList, TuningView, TuningViews
from bitymi_ns.codec.pages import tile_means
from bitymi_ns.ops import trace_cpu
from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import MemoryBudget, View
from tests.typed import Patch

S = TypeVar("S", bound=Stage)
BACKGROUND = torch.tensor([0.2, 0.4, 0.6])
OPTIONS = TuneOptions(steps=60, rate=0.3, val_every=4, coded_steps=0)


def cameras() -> list[Camera]:
    views = []
    for i in range(12):
        angle = torch.tensor(0.5236 * i)
        viewmat = torch.eye(4)
        viewmat[0, 0], viewmat[0, 2] = angle.cos(), angle.sin()
        viewmat[2, 0], viewmat[2, 2] = -angle.sin(), angle.cos()
        viewmat[2, 3] = 6.0
        views.append(Camera(viewmat, torch.tensor([[60.0, 0.0, 24.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]]), 48, 40))
    return views


def render(baked: Stage, camera: Camera) -> Tensor:
    return baked.unquantised().render(camera, BACKGROUND).rgb


def waving(made: Any, pixels_per_texel: float | None = None) -> Trained:
    """Make large surfels with a waving residual; the first one's is constant, the last is unseen."""
    made.surfels["log_scales"] += 1.5
    made.surfels["opacity_logits"] += 1.0
    made.surfels["means"][59] = torch.tensor([0.0, 100.0, 0.0])
    baked = trained_texels(made, BakeOptions(format="fp16", r_max=8))
    baked = field_tiles(baked, made.field, (), pixels_per_texel)
    area, sizes = int(baked.sizes[0].prod()), baked.sizes.clone()
    sizes[0] = 0
    texels = torch.cat([torch.full((1, 3), 0.3), baked.texels[area:]])
    return baked.with_tiles(Tiles(sizes, baked.extent, texels))


def bounded(baked: S) -> S:
    baked.scene.weight_bound = 0.02
    return baked


def waving_reduced(made: Any) -> Reduced:
    return bounded(prune_and_resample(waving(made), ()))


def with_texels(baked: Reduced, texels: Tensor) -> Reduced:
    return replace(baked, texels=texels, scene=with_means(baked.scene, tile_means(texels, baked.sizes)))


def tuning_views(baked: Stage, views: list[View], budget: int = 1 << 30) -> TuningViews:
    return TuningViews(TexelList(baked), views, BACKGROUND, MemoryBudget(budget))


def texels_of(baked: Stage) -> Tensor:
    return TexelList(baked).values


def photographs(truth: Stage) -> list[View]:
    return [View(camera, render(truth, camera).clamp(0.0, 1.0)) for camera in cameras()]


@pytest.fixture(scope="module")
def views(truth: Reduced) -> list[View]:
    return photographs(truth)


@pytest.fixture(scope="module")
def wrong(truth: Reduced) -> Reduced:
    """`truth` with a constant residual."""
    return with_texels(truth, torch.full_like(truth.texels, 0.1))


def test_tuning_finds_what_the_photographs_show(truth: Reduced, wrong: Reduced, views: list[View]) -> None:
    tuned = tune_atlas(wrong, views[:10], BACKGROUND, OPTIONS, eval_views=views[10:])
    statistics = tuned.statistics.finetune
    assert statistics.views == 7 and statistics.held_in_views == 3
    for gain in (statistics.psnr_held_in, statistics.psnr_held_out):
        assert gain.after > gain.before + 3
    error = (tuned.scene.mean_residual - truth.scene.mean_residual)[0].abs()
    assert (error < 0.05).all()  # a surfel without a tile gets its constant
    assert tuned.atlas.psnr is not None and tuned.atlas.payload != wrong.encoded().atlas.payload
    assert (wrong.texels == 0.1).all() and wrong.statistics.finetune is None  # the bake itself is as it was
    stated = statistics.psnr_held_out.after
    seen = [((render(tuned, v.camera).clamp(0, 1) - v.image) ** 2).mean().log10() * -10 for v in views[10:]]
    assert float(sum(seen) / 2) == pytest.approx(stated, abs=0.01)


def test_its_pictures_are_the_renderers(truth: Reduced) -> None:
    for camera in cameras()[:2]:
        want = render(truth, camera)
        drawn = tuning_views(truth, [View(camera, want)])
        got = drawn.picture(drawn[0], texels_of(truth))
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)


def test_texels_that_no_view_sees_stay_and_the_hardly_seen_hardly_move(wrong: Reduced, views: list[View]) -> None:
    scene = TexelList(wrong)
    seen = scene.coverage([v for i, v in enumerate(views) if i % 4])[:, 0]
    tuned = texels_of(tune_atlas(wrong, views, BACKGROUND, OPTIONS))
    moved = (tuned - 0.1).abs().amax(1)
    last = scene.tiles.first[59]
    assert not moved[last:].any() and not moved[seen == 0].any()
    few, many = (seen > 0) & (seen < 0.02), seen > 5
    assert few.sum() > 50 and many.sum() > 50
    assert moved[few].mean() < 0.2 * moved[many].mean()


def test_coverage_of_several_views_is_their_sum(wrong: Reduced, views: list[View]) -> None:
    texels = TexelList(wrong)
    both = texels.coverage(views[:5])
    torch.testing.assert_close(both, sum(texels.coverage([view]) for view in views[:5]))
    covered, squares = both.T
    assert covered.max() > 1 and (squares <= covered).all()
    hidden = torch.zeros(40, 48, 1, dtype=torch.bool)  # masked pixels are not seen
    masked = [views[0], *(View(v.camera, v.image, hidden) for v in views[1:3])]
    assert torch.equal(*(texels.coverage(each) for each in (views[:1], masked)))


@pytest.mark.parametrize("patience", [2, 99])
def test_it_gives_up_without_a_gain(wrong: Reduced, views: list[View], patience: int) -> None:
    told: list[tuple[int, int]] = []

    def progress(step: str, done: int, total: int) -> None:
        if step == "tuning texels":
            told.append((done, total))

    wild = replace(OPTIONS, rate=50.0, steps=40, patience=patience)
    statistics = tune_atlas(wrong, views, BACKGROUND, wild, progress).statistics.finetune
    assert (statistics.steps < 40) == (patience == 2) and statistics.steps_asked == 40
    assert told[0] == (1, 40) and told[-1] == (statistics.steps, statistics.steps)

    def interrupt(step: str, done: int, total: int) -> None:
        if step == "tuning texels" and done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tune_atlas(wrong, views, BACKGROUND, OPTIONS, interrupt)
    assert (wrong.texels == 0.1).all()
    perfect = [View(v.camera, render(wrong, v.camera)) for v in views]
    kept = tune_atlas(wrong, perfect, BACKGROUND, replace(wild, steps=10))
    assert kept.statistics.finetune.best_step == 0
    torch.testing.assert_close(kept.texels, wrong.texels, rtol=0, atol=0)


@pytest.mark.parametrize("coded", [False, True])
def test_the_best_texels_are_kept(wrong: Reduced, views: list[View], monkeypatch: Patch, coded: bool) -> None:
    """A run that gains, then loses, as its rate rises instead of falling."""
    seen: list[tuple[float, Tensor]] = []
    judge = TuningViews.psnr

    def noted(self: TuningViews, texels: Tensor, *arguments: Any) -> float:
        seen.append((judge(self, texels, *arguments), texels.clone()))
        return seen[-1][0]

    monkeypatch.setattr(TuningViews, "psnr", noted)
    monkeypatch.setattr("math.cos", lambda angle: 20.0 * angle**6 - 0.9)
    options = replace(OPTIONS, patience=99)
    if coded:
        wrong = replace(wrong, options=replace(wrong.options, format="uint8"))
        options = replace(options, steps=0, coded_steps=60, coded_rate=OPTIONS.rate)
    tuned = tune_atlas(wrong, views, BACKGROUND, options)
    if not coded:
        del seen[-1]  # of what is stored
    best = max(range(len(seen)), key=lambda i: seen[i][0])
    assert 0 < best < len(seen) - 1 and seen[-1][0] < seen[best][0] - 0.5
    if coded:
        kept = tuned.shown
    else:
        kept = texels_of(tuned)
        assert tuned.statistics.finetune.psnr_held_in.after == pytest.approx(seen[best][0], abs=1e-4)
    torch.testing.assert_close(kept, seen[best][1], rtol=0, atol=0)


def test_memory_for_the_views_does_not_change_the_result(wrong: Reduced, views: list[View]) -> None:
    few = replace(OPTIONS, steps=8)
    results = [tune_atlas(wrong, views, BACKGROUND, replace(few, cache_bytes=b)) for b in (0, 200_000, 1 << 30)]
    assert all(torch.equal(r.texels, results[0].texels) for r in results)


def test_large_views_are_traced_in_bands(wrong: Reduced, views: list[View], monkeypatch: Patch) -> None:
    def learned() -> tuple[TuningView, Tensor]:
        drawn, texels = tuning_views(wrong, views[:1]), texels_of(wrong)
        drawn.step(0, texels, torch.ones(len(texels)), 1e-3, 0.2)
        return drawn[0], texels

    whole, texels = learned()
    monkeypatch.setattr(trace_cpu, "MOST", 3500)
    parts, same = learned()
    assert len(whole.lists) == 1 < len(parts.lists) and sum(map(len, parts.lists)) == len(whole.lists[0])
    torch.testing.assert_close(parts.rest, whole.rest, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(same, texels, rtol=1e-4, atol=1e-5)
    assert not torch.equal(texels, texels_of(wrong))


def test_masked_pixels_and_alpha(wrong: Reduced, views: list[View]) -> None:
    few = replace(OPTIONS, steps=12)
    mask = torch.ones(40, 48, 1, dtype=torch.bool)
    mask[:, :24] = False
    spoilt = [View(v.camera, torch.where(mask, v.image, float("nan")), mask) for v in views]
    tuned = tune_atlas(wrong, spoilt, BACKGROUND, few)
    assert tuned.texels.isfinite().all() and not torch.equal(tuned.texels, wrong.texels)
    statistics = tuned.statistics.finetune.psnr_held_in
    assert statistics.after > statistics.before
    clear = [View(v.camera, torch.cat([v.image, torch.zeros(40, 48, 1)], -1)) for v in views]
    plain = [View(v.camera, BACKGROUND.expand(40, 48, 3)) for v in views]
    same = [tune_atlas(wrong, each, BACKGROUND, few).texels for each in (clear, plain)]
    assert torch.equal(*same)


def with_exposures(truth: Reduced, views: list[View]) -> list[View]:
    exposed = []
    for view, log in zip(views, torch.linspace(-0.4, 0.4, len(views)), strict=True):
        alpha = truth.unquantised().render(view.camera, BACKGROUND).alpha
        bare = view._replace(correction=log.exp().expand(3))
        exposed.append(bare._replace(image=bare.shown(view.image, alpha, BACKGROUND)))
    return exposed


def test_exposures_are_not_tuned_into_the_texels(truth: Reduced, wrong: Reduced, views: list[View]) -> None:
    exposed = with_exposures(truth, views)
    assert tuning_views(truth, exposed).psnr(texels_of(truth)) > 55  # background and all
    blind = [view._replace(correction=None) for view in exposed]
    after = {}
    for name, each in (("known", exposed), ("unknown", blind)):
        tuned = tune_atlas(wrong, each, BACKGROUND, OPTIONS)
        after[name] = tuning_views(tuned, views).psnr(texels_of(tuned))
    assert after["known"] > after["unknown"] + 1.0


def test_too_few_views_leave_the_atlas_alone(scene, wrong: Reduced, views: list[View]) -> None:
    same = tune_atlas(wrong, views[:3], BACKGROUND)
    assert same.texels is wrong.texels and same.statistics.finetune.model_dump() == {"steps": 0, "views": 3}
    with pytest.raises(ValueError, match="without texture"):
        tune_atlas(prune_and_resample(trained_texels(scene(20, field=None), BakeOptions()), ()), views, BACKGROUND)


@pytest.mark.parametrize("bad", [{"steps": -1}, {"val_every": 1}, {"rate": 0.0}, {"prior": -1.0}, {"ssim_weight": 2}])
def test_options_out_of_range_are_refused(wrong: Reduced, views: list[View], bad: dict[str, float]) -> None:
    tune = partial(tune_atlas, wrong, views, BACKGROUND)
    with pytest.raises(ValueError, match=next(iter(bad))):
        tune(replace(TuneOptions(), **bad))


def error(baked: Coded, views: list[View]) -> float:
    return fmean(float((baked.scene.render(v.camera, BACKGROUND).rgb - v.image).square().mean()) for v in views)


@pytest.mark.parametrize("format", ["bc7", "uint8"])
def test_the_last_steps_see_what_is_stored(truth: Reduced, views: list[View], format: str) -> None:
    """With texels that BC7 blocks cannot hold, the render of the stored ones improves, with or without validation
    views."""
    options = replace(truth.options, format=format)
    generator = torch.Generator().manual_seed(3)
    noise = 0.2 * torch.randn(truth.texels.shape, generator=generator)
    noisy = with_texels(replace(truth, options=options), truth.texels + noise)
    plain = noisy.encoded()
    for val_every in (0, 4):
        steps = TuneOptions(steps=0, coded_steps=40, coded_rate=0.3, val_every=val_every)
        tuned = tune_atlas(noisy, views, BACKGROUND, steps)
        assert error(tuned, views) < 0.8 * error(plain, views)
        assert tuned.statistics.finetune.steps == 40
        assert float((tuned.shown - tuned.texels).abs().max()) < 0.75  # stored texels are those
    few = tune_atlas(noisy, views[:1], BACKGROUND, TuneOptions.of_learned(5))
    assert few.atlas is not None and few.statistics.finetune.psnr_held_in is None


def test_texels_that_have_learned_stay_when_nothing_is_left_to_learn(truth: Reduced) -> None:
    """Fine-tuning towards photographs of the scene itself does not drift."""
    scene = replace(truth, options=replace(truth.options, format="fp16"))
    views = photographs(scene)
    tuned = tune_atlas(scene, views, BACKGROUND, TuneOptions.of_learned(20))
    assert error(tuned, views) < 3e-6
