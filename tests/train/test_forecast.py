"""Estimates of a run's surfels and of its end."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from bitymi_ns.train import forecast
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.forecast import Forecast, expected_surfels
from bitymi_ns.train.schedules import Schedule


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    found = SimpleNamespace(now=0.0)
    times = dict.fromkeys(("perf_counter", "process_time"), lambda: found.now)
    monkeypatch.setattr(forecast, "time", SimpleNamespace(**times))
    return found


@pytest.mark.parametrize("steps", [300, 3000, 30_000])
@pytest.mark.parametrize(("pixels", "first"), [(77_000, 8000), (130_000, 13_000), (1_920_000, 18_000)])
@pytest.mark.parametrize("fragments", [0.6, 1.6], ids=["few", "many"])
@pytest.mark.parametrize("growth", [1.1, 1.25])
def test_the_end_is_known_from_the_first_steps_on(
    steps: int, pixels: float, first: int, fragments: float, growth: float, clock: SimpleNamespace
) -> None:
    schedule = Schedule(TrainConfig(), steps, texels=True, pixels=pixels)
    surfels = expected_surfels(schedule, first, pixels)
    run = Forecast(schedule, 100, pixels, surfels, {steps - 1: 12})
    n, stated = float(first), {}
    for step in range(steps):
        run.begin()
        view = 6e-7 * fragments * pixels * schedule.resolution_factor(step) ** 2 + 1.1e-6 * n
        clock.now += view * (1.5 if schedule.texels_learn(step) else 1.0) + 1.5 * (step == 0)
        if step in schedule.densify_steps:
            clock.now += 0.5 * 10 * view
            n = min(growth * n, 0.5 * pixels)
        clock.now += view * min(100, schedule.error_views) * (step in schedule.error_prune_steps)
        clock.now += view * min(100, schedule.final_views) * (step in schedule.final_prune_steps)
        run.end(step)
        if step in (50, 200, 1000) and step < 0.9 * steps:
            assert run.settled and run.left is not None
            stated[step] = clock.now + run.left
    assert run.left == 0
    assert all(clock.now / 1.5 < end < 1.5 * clock.now for end in stated.values()), (clock.now, stated)


@pytest.mark.parametrize("slower", [{0.5: 1.0, 1.0: 1.0}, {0.5: 2.0, 1.0: 3.0}], ids=["even", "large lists"])
def test_measured_sizes_tell_what_large_pictures_take(slower: dict[float, float], clock: SimpleNamespace) -> None:
    schedule = Schedule(TrainConfig(), 3000, texels=True, pixels=2e6)
    surfels = np.full(3000, 2e4)
    run = Forecast(schedule, 100, 2e6, surfels, {})

    def seconds(size: float) -> float:
        return slower.get(size, 1.0) * (1e-6 * 2e6 * size**2 + 1e-6 * 2e4)

    stated = {}
    for step in range(3000):
        size = schedule.resolution_factor(step)
        run.begin()
        views = np.where(step in schedule.densify_steps, 1 + 10 * forecast.DRAWN, 1.0)
        views += 100 * (step in schedule.error_prune_steps) + 75 * (step in schedule.final_prune_steps)
        clock.now += 0.05 + seconds(size) * (forecast.TEXELS if schedule.texels_learn(step) else 1.0) * views
        run.end(step)
        if step == 30:
            run.compare_sizes(step, {size: seconds(size) for size in (0.25, 0.5, 1.0)})
            half = run.half()
        if step in (30, 200, 700, 1500):
            assert run.left is not None
            stated[step] = clock.now + run.left
    assert all(clock.now / 1.2 < end < 1.2 * clock.now for end in stated.values()), (clock.now, stated)
    shares = [run._cost(side).sum() / run._units.sum() for side in (half, 1.0)]
    assert shares == pytest.approx([0.5, 1.0], rel=0.01)
    assert half > 0.72 if slower[1.0] > 1 else half < 0.72  # large pictures, slower per pixel, need less of a reduction


def test_a_run_that_goes_on_forgets_nothing_and_evaluations_count(clock: SimpleNamespace) -> None:
    schedule = Schedule(TrainConfig(densify=DensifyConfig(final_prune_steps=()), num_downscales=0), 100)
    even = np.zeros(100)
    plain, more = (Forecast(schedule, 10, 1e6, even, evaluated, 60) for evaluated in ({}, {80: 6}))
    for run in (plain, more):
        assert run.left is None
        for step in range(60, 70):
            run.begin()
            clock.now += 9.0 if step < 60 + forecast.WARM else 2.0
            run.end(step)
    assert plain.left == pytest.approx(60.0) and more.left == pytest.approx(60.0 + 6 * forecast.DRAWN * 2.0)


def test_no_smaller_pictures_halve_the_cost_of_surfels() -> None:
    schedule = Schedule(TrainConfig(), 300, texels=True, pixels=1e6)
    assert Forecast(schedule, 10, 1e3, np.full(300, 1e5), {}).half() == 0


def test_surfels_grow_up_to_their_bounds() -> None:
    schedule = Schedule(TrainConfig(), 3000, texels=True)
    free = expected_surfels(schedule, 1000, 1e9)
    assert free[0] == 1000 and (np.diff(free[: max(schedule.densify_steps)]) >= 0).all()
    assert free.max() == pytest.approx(1000 * forecast.GROWTH ** len(schedule.densify_steps))
    assert free[-1] == pytest.approx(forecast.KEPT * free.max())
    assert expected_surfels(schedule, 1000, 1e9, 2000).max() == 2000
    assert expected_surfels(schedule, 1000, 3000).max() == forecast.SURFELS_PER_PIXEL * 3000
    assert expected_surfels(schedule, 1000, 10, 0).max() == 1000  # there are so many already
    asked = Schedule(TrainConfig(), 3000, texels=True)
    asked.config.densify.max_surfels = 50_000
    assert math.isclose(expected_surfels(asked, 1000, 10).max(), 50_000, rel_tol=1e-6)
