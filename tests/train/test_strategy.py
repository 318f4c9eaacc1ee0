"""Rules of densification and pruning for given multi-view scores."""

import itertools
import math
from types import SimpleNamespace

import pytest
import torch

from bitymi_ns.train import strategy as module
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.divergence import TrainingDiverged
from bitymi_ns.train.schedules import Schedule
from bitymi_ns.train.strategy import Strategy, most_surfels
from tests.train.strategy_bench import LARGE, SMALL, Bench

DENSIFY, RESET, ERROR, FINAL, LATE_DENSIFY, LAST_DENSIFY = 1000, 3000, 15_000, 18_000, 4000, 14_500


@pytest.fixture
def bench(monkeypatch):
    return lambda n=40, **densify: Bench(monkeypatch, n, **densify)


def statistics(bench):
    return dict(zip(module.STATISTICS, bench.strategy.statistics, strict=True))


def check(bench):
    n = len(bench.scene)
    for name, p in bench.scene.surfels.items():
        assert len(p) == n and torch.isfinite(p).all()
        assert bench.optimizers[name].param_groups[0]["params"] == [p]
        assert bench.optimizers[name].state[p]["exp_avg"].shape == p.shape
    assert bench.strategy.statistics.shape[1] == n


def test_nothing_happens_between_events(bench):
    b = bench()
    b.see(1.0, 1.0)
    for step in (0, 1, 500, 999, 1001, 15_001, 29_999):
        assert b.step(step) == {}
    assert len(b.scene) == 40 and b.asked == []


def test_statistics_are_means_over_the_views_that_saw_a_surfel(bench):
    b = bench(4)
    b.see(torch.tensor([1e-4, 2e-4, 3e-4, math.nan]), 1.0, radius=3.0)
    b.see(1e-4, 0.0, radius=torch.tensor([9.0, 1, 9, 1]), visible=torch.tensor([True, False, True, True]))
    torch.testing.assert_close(statistics(b)["grad_sum"], torch.tensor([2e-4, 2e-4, 4e-4, 1e-4]))
    assert statistics(b)["visible_count"].tolist() == [2, 1, 2, 2]
    assert statistics(b)["max_radius"].tolist() == [9, 3, 9, 3]
    b.scene.resize_for_state({"surfels.means": torch.zeros(7, 3)})
    with pytest.raises(ValueError, match="4 surfels, but 7"):
        b.see()
    b = bench(1)  # pixels become NDC with the size of the image
    projection = SimpleNamespace(
        visible=torch.tensor([True]), radii=torch.ones(1, 2),
        mean2d_grad=torch.tensor([[3.0, 4.0]]), mean2d_absgrad=torch.tensor([[6.0, 8.0]]),
        camera=SimpleNamespace(width=20, height=10),
    )  # fmt: skip
    b.strategy.accumulate(projection)
    assert statistics(b)["grad_sum"].item() == pytest.approx(math.hypot(30, 20))
    assert statistics(b)["abs_grad_sum"].item() == pytest.approx(math.hypot(60, 40))


def test_clone_and_split_need_score_gradient_and_size(bench):
    b = bench(8)
    #              0     1     2     3     4     5     6     7
    b.importance = torch.tensor([6, 5, 6, 6, 6, 5, 6, 6])
    b.set("log_scales", [4, 5, 6, 7], LARGE)
    grad = torch.tensor([2.1e-4, 1.0, 1.9e-4, 1.9e-4, 1.0, 1.0, 1.0, 0.0])
    absgrad = torch.tensor([0.0, 1.0, 0.0, 1.0, 7.1e-4, 1.0, 6.9e-4, 6.9e-4])
    b.see(grad, absgrad)
    report = b.step(DENSIFY)
    assert (report["cloned"], report["split"], report["pruned"], report["surfels"]) == (1, 1, 0, 10)
    assert b.x[:8] == [0, 1, 2, 3, 5, 6, 7, 0]
    assert b.asked == [10]
    check(b)


def test_halves_lie_side_by_side_along_the_long_axis(bench):
    b = bench(2, max_surfels=0)
    b.set("log_scales", slice(0, 2), torch.tensor([[math.log(0.2), math.log(0.05)], [math.log(0.05), math.log(0.2)]]))
    b.set("quats", slice(0, 2), torch.tensor([0.5, -1.0, 2.0, 0.3]))
    b.set("opacity_logits", slice(0, 2), torch.tensor([0.4, 30.0]))
    parents = {name: p.detach().clone() for name, p in b.scene.surfels.items()}
    halves = b.strategy._halves(b.scene.surfels, torch.tensor([0, 1]))
    axes = module.tangents(parents["quats"])
    offset = (halves["means"] - parents["means"].repeat_interleave(2, 0)).view(2, 2, 3)
    for row, (long, wide) in enumerate(((0, 1), (1, 0))):
        expected = 0.7 * 0.2 * axes[row, :, long]
        torch.testing.assert_close(offset[row], torch.stack([expected, -expected]))
        scales = halves["log_scales"].exp()[2 * row : 2 * row + 2]
        assert scales[:, long].tolist() == pytest.approx([0.12] * 2)
        assert scales[:, wide].tolist() == pytest.approx([0.035] * 2)
    opacity = 0.9 * parents["opacity_logits"].sigmoid().repeat_interleave(2)
    torch.testing.assert_close(halves["opacity_logits"].sigmoid(), opacity)
    for name in set(parents) - {"means", "log_scales", "opacity_logits"}:
        torch.testing.assert_close(halves[name], parents[name].repeat_interleave(2, 0))


def test_clones_equal_their_parents_and_start_without_momentum(bench):
    b = bench(5)
    b.importance[2] = 9
    b.set("opacity_logits", 2, 0.5)
    b.see(1.0)
    b.step(DENSIFY)
    for name, p in b.scene.surfels.items():
        torch.testing.assert_close(p[5], p[2])
        assert (b.optimizers[name].state[p]["exp_avg"][5:] == 0).all()
    assert (statistics(b)["grad_sum"] == 0).all() and (statistics(b)["visible_count"] == 0).all()


def test_half_of_the_candidates_are_drawn_from_all(bench):
    b = bench(1000)
    b.set("opacity_logits", slice(0, 500), -5.3)  # 0.00497: candidate, but visible
    b.step(DENSIFY)
    removed = 1000 - len(b.scene)
    # 250 draws out of 1000 rows of equal weight hit a candidate about 125 times
    assert 95 <= removed <= 155
    assert set(range(500, 1000)) <= set(b.x)


def test_scores_stay_aligned_when_others_are_split_or_dropped(bench):
    b = bench(100)
    b.set("log_scales", slice(0, 30), LARGE)
    b.importance[:30] = 9
    b.set("means", 30, math.nan)
    b.set("opacity_logits", slice(40, 60), -5.3)
    b.prune[40:50] = 1.0
    b.see(0.0, 1.0)
    report = b.step(DENSIFY)
    assert report["split"] == 30 and report["not_finite"] == 1
    gone = set(range(100)) - set(b.x)
    # children stay within a few hundredths of their parents, to which they round
    assert gone == set(range(40, 50)) | {30}
    check(b)


@pytest.mark.parametrize(("step", "gone"), [(DENSIFY, set()), (LATE_DENSIFY, {3})])
def test_size_on_screen_counts_after_the_first_reset(bench, step, gone):
    b = bench(8, prune_budget=1.0)
    b.prune[3] = 1.0
    radius = torch.full((8,), 20.0)
    radius[3] = 20.5
    b.see(radius=radius)
    b.step(step)
    assert set(range(8)) - set(b.x) == gone
    b = bench(8, prune_budget=1.0)
    b.set("log_scales", 5, torch.tensor([math.log(0.11), SMALL]))  # size in the world, at any step
    b.prune[5] = 1.0
    b.step(step)
    assert set(range(8)) - set(b.x) == {5}


def test_opacities_are_clamped_at_densification_and_reset_on_time(bench):
    b = bench(6)
    b.set("opacity_logits", slice(0, 3), 4.0)
    b.step(DENSIFY)
    opacity = b.scene.surfels["opacity_logits"].sigmoid()
    torch.testing.assert_close(opacity[:3], torch.full((3,), 0.8))
    assert opacity[3:].min() > 0.7
    report = b.step(RESET)
    assert report["opacity_reset"] == 6
    logits = b.scene.surfels["opacity_logits"]
    torch.testing.assert_close(logits.sigmoid(), torch.full((6,), 0.01))
    assert (b.optimizers["opacity_logits"].state[logits]["exp_avg"] == 0).all()


@pytest.mark.parametrize("cap", [40, 41, 47, 60, 2000])
def test_surfels_grow_to_the_cap_in_equal_parts_and_reach_it(bench, cap):
    b = bench(40, max_surfels=cap, prune_budget=0.0)
    b.set("log_scales", slice(0, 40, 2), LARGE)
    events, counts = sorted(b.strategy.schedule.densify_steps), [40]
    for step in events:
        b.importance = torch.full((4000,), 10)
        b.see(1.0, 1.0)
        b.strategy.step(step, b.views)
        counts.append(len(b.scene))
    assert counts[-1] == cap
    if cap == 2000:  # at most two children per surfel at a time
        shares = [later - n for n, later in itertools.pairwise(counts)]
        assert max(shares[3:]) - min(shares[3:]) <= 1 and counts[1:4] != sorted(counts[1:4], reverse=True)
    check(b)


def test_parents_of_a_cap_are_drawn_by_error_and_gradient(bench):
    b = bench(400, max_surfels=40_000, prune_budget=0.0)
    b.importance = torch.full((400,), 10)
    b.importance[:100] = 0
    gradient = torch.ones(400)
    gradient[100:200], gradient[200:300] = 0.0, 1e-3
    b.strategy._draw = lambda weights, k: weights.nonzero().flatten()
    b.see(0.0, gradient)
    b.step(DENSIFY)
    assert [b.x.count(x) for x in (0, 99, 100, 199, 200, 399)] == [2, 2, 1, 1, 2, 2]  # none without a gradient
    b = bench(400, max_surfels=5_000, prune_budget=0.0)
    b.importance = torch.full((400,), 10)
    b.importance[:100] = 0
    b.see(0.0, 1.0)
    room = 4600 // sum(step >= DENSIFY for step in b.strategy.schedule.densify_steps)
    assert b.step(DENSIFY)["cloned"] == room
    grown = [x for x in range(400) if b.x.count(x) == 2]
    assert len(grown) == room and sum(x < 100 for x in grown) < room / 10


@pytest.mark.parametrize(("views", "surfels"), [(1, 60), (2, 80), (9, 80)])
def test_the_bound_follows_the_pixels_of_all_photographs(bench, views, surfels):
    b = bench(40)
    b.strategy = Strategy(b.scene, b.optimizers, Schedule(b.config, 30_000), image_pixels=views * 60 * 150)
    b.importance = torch.full((40,), 10)
    b.set("log_scales", slice(0, 40), LARGE)
    b.see(1.0, 1.0)
    report = b.step(DENSIFY)
    assert len(b.scene) == surfels and report["held_back"] == 80 - surfels


@pytest.mark.parametrize(
    ("cap", "per_surfel", "pixels", "first", "most"),
    [
        (0, 300.0, 0, 0, 0),
        (0, 300.0, 3000, 0, 10),
        (7, 300.0, 3000, 0, 7),
        (70, 300.0, 3000, 0, 70),  # the option replaces the bound by pixels
        (0, 0.0, 3000, 0, 0),
        (7, 0.0, 3, 0, 7),
        (0, 300.0, 3000, 4, 10),
        (0, 300.0, 3000, 9, 18),  # room to grow, however few the pixels
        (12, 300.0, 3000, 9, 12),
        (0, 0.0, 3000, 9, 0),
        (0, 300.0, 0, 9, 0),  # of unknown size
    ],
)
def test_the_bound_is_the_one_asked_for_or_follows_pixels(cap, per_surfel, pixels, first, most):
    config = TrainConfig(densify=DensifyConfig(max_surfels=cap, pixels_per_surfel=per_surfel, growth=2.0))
    assert most_surfels(config, pixels, first) == most
    # 263 photographs of 979 x 543, 98,705 points; the paper ends at up to 159,000 surfels there
    assert most_surfels(TrainConfig(), 263 * 979 * 543) > 2 * 159_000


@pytest.mark.parametrize("step", [1, DENSIFY, FINAL])
@pytest.mark.parametrize("cap", [1, 12, 19])
def test_a_scene_over_the_cap_loses_its_faintest_at_once(bench, step, cap):
    b = bench(20, max_surfels=cap, min_surfels=100)
    b.set("opacity_logits", slice(0, 20), torch.linspace(-2, 2, 20))
    b.step(step)
    assert b.x == list(range(20 - cap, 20))


@pytest.mark.parametrize(
    ("cap", "faint", "important", "step", "replaced", "cloned"),
    [
        (42, (-4.0, -3.1), slice(2, 30), LAST_DENSIFY, [0, 1], 4),  # room for two of 28; the others are important
        (42, (-3.1, -4.0), slice(30, 35), LAST_DENSIFY, [5, 6, 7], 5),  # only as many as needed, the faintest
        (46, (-4.0, -3.1), slice(2, 30), 13_500, [], 2),  # 1,500 steps after a reset
    ],
)
def test_faint_surfels_make_room_for_important_ones_at_the_cap(
    bench, cap, faint, important, step, replaced, cloned
) -> None:
    b = bench(40, max_surfels=cap, prune_budget=0.0)
    b.set("opacity_logits", slice(0, 8), torch.linspace(*faint, 8))  # all below 0.05
    b.importance[important] = 9
    b.see(1.0, 1.0)
    report = b.step(step)
    assert (report["replaced"], report["cloned"]) == (len(replaced), cloned)
    rest = [row for row in range(40) if row not in replaced]
    assert b.x[: len(rest)] == rest and len(b.scene) == len(rest) + cloned
    check(b)


def test_no_surfel_makes_room_at_the_bound_by_pixels(bench):
    b = bench(40, prune_budget=0.0)
    b.strategy.most = 42
    b.importance[2:30] = 9
    b.see(1.0, 1.0)
    report = b.step(DENSIFY)
    assert (report["held_back"], report["cloned"]) == (26, 2)


def test_broken_rows_go_and_invisible_ones_too(bench):
    b = bench(10)
    b.set("means", 1, math.nan)
    b.set("sv_rgb", 2, math.inf)
    b.set("opacity_logits", 3, -6.0)
    b.set("opacity_logits", 4, -5.5)  # 0.00407, above 1/255
    report = b.step(DENSIFY)
    assert (report["not_finite"], report["invisible"]) == (2, 1)
    assert set(range(10)) - set(b.x) <= {1, 2, 3, 4} and {1, 2, 3}.isdisjoint(b.x)
    check(b)


def test_a_scene_without_a_finite_row_is_an_error(bench):
    b = bench(3)
    b.set("quats", slice(0, 3), math.nan)
    with pytest.raises(TrainingDiverged, match=r"quats.*row 0"):
        b.step(DENSIFY)


def test_the_error_prune_removes_what_hardly_matters(bench):
    b = bench(10, prune_error=0.02)
    b.set("opacity_logits", 3, -9.0)  # invisible for good
    b.added[:6] = torch.tensor([5.0, 0.0, 9.0, 1.0, 8.5, 7.0])  # no drawn view shows row 1
    report = b.step(ERROR)
    assert b.x == [1, 2, 4, 6, 7, 8, 9]  # 5 + 7 <= 0.02 x 1000 < 5 + 7 + 8.5
    assert (report["invisible"], report["pruned"], report["surfels"]) == (1, 2, 7)
    assert b.asked == [3000]
    b = bench(10, prune_error=0.02, min_surfels=9)
    b.added[:6] = 1.0
    assert b.step(ERROR)["pruned"] == 1
    b = bench(10, prune_error=0.0)
    b.added[:6] = 1.0
    assert b.step(ERROR) == {} and b.asked == []


def test_final_prune_removes_the_transparent_that_the_pictures_do_not_miss(bench):
    b = bench(10, final_prune_error=0.01)
    b.set("opacity_logits", slice(0, 4), -2.3)
    b.added[:6] = torch.tensor([6.0, 3.0, 0.0, 4.0, 1.0, 1.0])  # the pictures would miss 0, and 4 and 5 are opaque
    b.prune[7] = 1.0
    report = b.step(FINAL)
    assert b.x == [0, 2, 4, 5, 6, 7, 8, 9]  # 3 + 4 <= 0.01 x 1000 < 3 + 4 + 6; no drawn view shows row 2
    assert (report["pruned"], report["surfels"]) == (2, 8) and b.asked == [750]
    assert len(b.optimizers["means"].state[b.scene.surfels["means"]]["exp_avg"]) == 8


@pytest.mark.parametrize(("n", "least", "left"), [(10, 4, 4), (10, 100, 10), (10, 0, 1)])
def test_a_prune_never_empties_the_scene(bench, n, least, left):
    for logit in (-3.0, -9.0):
        b = bench(n, min_surfels=least)
        b.added[:] = 1.0
        b.set("opacity_logits", slice(0, n), torch.linspace(logit, logit + 0.1, n))
        for step in (FINAL, FINAL + 3000, DENSIFY):
            b.step(step)
            assert len(b.scene) == left
        assert b.x == list(range(n - left, n))  # the most opaque ones
    b = bench(30, min_surfels=25, prune_budget=1.0)
    b.set("opacity_logits", slice(0, 30), -5.3)
    b.step(DENSIFY)
    assert len(b.scene) == 25


def test_state_survives_a_round_trip_and_the_lots_are_the_same(bench):
    first, second = bench(200), bench(200)
    for b in (first, second):
        b.set("opacity_logits", slice(0, 200, 2), -5.3)
        b.see(1e-4, 2e-4)
    first.strategy._draw(torch.ones(10, dtype=torch.float64), 3)  # advances the generator
    state = first.strategy.state_dict()
    second.strategy.load_state_dict(state)
    for b in (first, second):
        b.step(DENSIFY)
    assert first.x == second.x and len(first.x) < 200
    for name in module.STATISTICS:
        assert isinstance(state[name], torch.Tensor)
    with pytest.raises(RuntimeError, match="equal size"):
        second.strategy.load_state_dict({**state, "grad_sum": torch.zeros(3)})


def test_lots_follow_their_weights(bench):
    strategy = bench(1).strategy
    weights = torch.tensor([0.0, 1.0, 3.0], dtype=torch.float64)
    first = [int(strategy._draw(weights, 1)[0]) for _ in range(2000)]
    assert first.count(0) == 0 and first.count(2) / 2000 == pytest.approx(0.75, abs=0.04)
    assert sorted(strategy._draw(weights, 3).tolist()) == [1, 2]
    assert len(strategy._draw(weights, 0)) == 0
    assert len(strategy._draw(weights[:0], 5)) == 0
