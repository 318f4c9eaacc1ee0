"""Limits that take effect are reported."""

import json

from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train import messages
from bitymi_ns.train.config import DensifyConfig, TrainConfig
from bitymi_ns.train.init import PointReport
from bitymi_ns.train.schedules import Schedule


def test_runs_by_their_length() -> None:
    assert messages.short_run(Schedule(TrainConfig(), 30_000), views=300) == []
    (rules,) = messages.short_run(Schedule(TrainConfig(), 1200), views=43)
    assert "30,000 steps: surfels learn 3.1 times as fast" in rules
    assert "5 densifications, 100 steps apart" in rules and "no opacity resets" in rules
    assert "the texture field learns on 1 of 3 steps once it is frozen" in rules
    (rules,) = messages.short_run(Schedule(TrainConfig(), 1200), views=43, field=False)
    assert "field" not in rules
    rules, views = messages.short_run(Schedule(TrainConfig(), 80), views=263)
    assert "no densifications" in rules and "the texture field is never frozen" in rules
    assert "80 of the 263" in views and "--max-num-iterations" in views


def test_a_table_smaller_than_the_photographs_could_fill_is_announced() -> None:
    for config, number in (
        (SceneConfig(), 1),
        (SceneConfig(log2_table_size=19), 0),
        (SceneConfig(texture="texels"), 0),
    ):
        sentences = messages.warnings_at_start(PointReport(given=9), TrainConfig(), 10**12, config)
        assert [("log2-table-size" in s and "2^35" in s) for s in sentences] == [True] * number
    assert messages.warnings_at_start(PointReport(given=100), TrainConfig(), 44 * 270 * 480, SceneConfig()) == []


def test_points_that_do_not_fit_are_announced() -> None:
    config, points = TrainConfig(densify=DensifyConfig(max_surfels=10_000)), PointReport(given=12_000, over_cap=2_000)
    for first, option in ((None, "(--max-surfels)"), (20_000, "(--max-surfels)"), (9_000, "train.first-surfels)")):
        config.first_surfels = first
        (sentence,) = messages.warnings_at_start(points, config, 0, SceneConfig())
        assert f"from {min(10_000, first or 10_000):,} surfels: 2,000 of 12,000 points" in sentence
        assert option in sentence
    points = PointReport(given=0, random=20_000, over_cap=15_000)
    (sentence,) = messages.warnings_at_start(points, TrainConfig(first_surfels=5_000), 1, SceneConfig())
    assert "from 5,000 surfels: 15,000 of 20,000 random points are left out" in sentence


def test_a_bound_that_densification_meets_is_named() -> None:
    sentence = messages.held_back(1234, 700, TrainConfig())
    assert "700 surfels, one for 150 pixels of all photographs" in sentence and "would have made 1,234 more" in sentence
    assert "densify.pixels-per-surfel" in sentence and "--max-surfels" in sentence


def test_a_resumed_run_names_the_options_that_differ() -> None:
    record = messages.recorded(TrainConfig())
    assert messages.other_options(record, TrainConfig()) == [] and messages.other_options(None, TrainConfig()) == []
    other = TrainConfig(densify=DensifyConfig(max_surfels=800), exposure="gain")
    (sentence,) = messages.other_options(record, other)
    assert "densify.max-surfels 800 (was 0)" in sentence and "exposure gain (was auto)" in sentence
    assert "quats" not in sentence
    earlier = json.loads(record)
    del earlier["dropout"]
    (sentence,) = messages.other_options(json.dumps(earlier), TrainConfig())
    assert "dropout 0.1 (new in this version)" in sentence and "dropout-passes" not in sentence
