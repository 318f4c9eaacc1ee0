"""No bound is met in silence."""

import pytest

from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train import limits
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.init import PointReport
from bitymi_ns.train.schedules import Schedule


def test_a_full_run_meets_no_bound() -> None:
    assert limits.short_run(Schedule(TrainConfig(), 30_000), views=300) == []
    assert limits.start(PointReport(given=100), TrainConfig(), 44 * 270 * 480, SceneConfig()) == []


def test_a_short_run_says_which_rules_are_in_force() -> None:
    (sentence,) = limits.short_run(Schedule(TrainConfig(), 1200), views=43)
    assert "30,000 steps: surfels learn 3.1 times as fast" in sentence
    assert "5 densifications, 100 steps apart" in sentence and "no opacity resets" in sentence
    assert "the texture field learns on 1 of 3 steps once it is frozen" in sentence


def test_a_run_that_does_not_see_every_photograph_says_so() -> None:
    rules, views = limits.short_run(Schedule(TrainConfig(), 80), views=263)
    assert "no densifications" in rules and "the texture field is never frozen" in rules
    assert "80 of the 263" in views and "--max-num-iterations" in views


@pytest.mark.parametrize(("table", "said"), [(None, True), (19, False)])
def test_a_table_smaller_than_the_photographs_could_fill_is_announced(table, said) -> None:
    sentences = limits.start(PointReport(given=9), TrainConfig(), 10**12, SceneConfig(log2_table_size=table))
    assert [("log2-table-size" in s and "2^35" in s) for s in sentences] == [True] * said


def test_points_that_do_not_fit_are_announced() -> None:
    config, points = TrainConfig(densify=DensifyConfig(max_surfels=10_000)), PointReport(given=12_000, over_cap=2_000)
    for first, option in ((None, "densify.max-surfels"), (20_000, "densify.max-surfels"), (9_000, "first-surfels")):
        config.first_surfels = first
        (sentence,) = limits.start(points, config, 0, SceneConfig())
        assert f"from {min(10_000, first or 10_000):,} surfels: 2,000 of 12,000 points" in sentence
        assert f"train.{option})" in sentence


def test_random_points_that_do_not_fit_are_counted_themselves() -> None:
    config = TrainConfig(first_surfels=5_000)
    (sentence,) = limits.start(PointReport(given=0, random=20_000, over_cap=15_000), config, 1, SceneConfig())
    assert "from 5,000 surfels: 15,000 of 20,000 random points are left out" in sentence


def test_nothing_is_said_of_a_field_where_there_is_none() -> None:
    (sentence,) = limits.short_run(Schedule(TrainConfig(), 1200), views=43, field=False)
    assert "field" not in sentence
    assert limits.start(PointReport(given=9), TrainConfig(), 10**12, SceneConfig(texture="texels")) == []


def test_a_bound_that_densification_meets_is_named() -> None:
    config = TrainConfig(densify=DensifyConfig(max_surfels=800))
    capped, by_pixels = limits.held_back(1234, 800, config), limits.held_back(1234, 700, config)
    assert "800 surfels and would have made 1,234 more" in capped and "densify.max-surfels" in capped
    assert "one for 300 pixels of all photographs" in by_pixels and "densify.pixels-per-surfel" in by_pixels
