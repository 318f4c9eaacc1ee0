"""Short runs have the same events, as often, at the same share of the run."""

import itertools

import pytest

from bitymi_ns.train.config import DensifyConfig, LearningRates, TexelConfig, TrainConfig
from bitymi_ns.train.schedules import Schedule


def every_event() -> TrainConfig:
    """Configure a run that skips no event, however short it is."""
    return TrainConfig(densify=DensifyConfig(min_interval=1, min_reset_interval=1))


def fired(schedule: Schedule, name: str) -> list[int]:
    return sorted(getattr(schedule, name))


def overdraw_steps(schedule: Schedule) -> list[int]:
    return [step for step in range(schedule.max_steps) if schedule.overdraw_counts(step)]


def test_reference_run_has_the_published_events():
    schedule = Schedule(TrainConfig(), 30_000)
    assert fired(schedule, "densify_steps") == list(range(1000, 15_000, 500))
    assert fired(schedule, "reset_steps") == [3000, 6000, 9000, 12_000]
    assert fired(schedule, "error_prune_steps") == [15_000]
    assert fired(schedule, "final_prune_steps") == [18_000, 21_000, 24_000, 27_000]
    assert schedule.scaled(12_345) == 12_345
    short = Schedule(TrainConfig(), 3000)
    assert [short.scaled(step) for step in (500, 0, 1)] == [50, 0, 1]
    assert fired(short, "densify_steps") == list(range(fired(short, "densify_steps")[0], 1500, 100))
    assert min(short.densify_steps) >= 50 and not short.reset_steps
    for extent in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="extent"):
            Schedule(TrainConfig(), 100, extent)


@pytest.mark.parametrize("max_steps", [60, 97, 300, 1000, 1999, 2000, 2500, 3000, 7000, 29_999, 35_000])
@pytest.mark.parametrize("event", ["densify_steps", "reset_steps", "error_prune_steps", "final_prune_steps"])
def test_every_event_fires_as_often_as_in_the_reference_run(max_steps, event):
    reference = fired(Schedule(TrainConfig(), 30_000), event)
    steps = fired(Schedule(every_event(), max_steps), event)
    assert len(steps) == len(reference)
    for step, at_30k in zip(steps, reference, strict=True):
        assert abs(step - at_30k * max_steps / 30_000) <= 0.5


@pytest.mark.parametrize("max_steps", [1, 2, 3, 10, 59, 300, 2000, 2500, 3001])
def test_short_runs_stay_inside_the_run_and_reset_as_they_densify(max_steps):
    schedule = Schedule(TrainConfig(), max_steps)
    for steps in (schedule.densify_steps, schedule.reset_steps, schedule.error_prune_steps, schedule.final_prune_steps):
        assert all(0 <= s < max_steps for s in steps)
    assert max_steps < 100 or schedule.reset_steps <= schedule.densify_steps


@pytest.mark.slow
@pytest.mark.parametrize("max_steps, every", [(30_000, 10), (3000, 8), (1200, 3), (300, 1)])
def test_field_learns_on_few_steps_after_freezing_and_on_more_in_short_runs(max_steps, every):
    schedule = Schedule(TrainConfig(), max_steps)
    freeze = max_steps // 6
    learning = [schedule.field_trains(s) for s in range(max_steps)]
    assert all(learning[:freeze])
    assert sum(learning[freeze:]) == sum(s % every == 0 for s in range(freeze, max_steps))
    assert all(Schedule(TrainConfig(freeze_every=1), 100).field_trains(s) for s in range(100))


def test_resolution_doubles_up_to_full_size():
    schedule = Schedule(TrainConfig(), 3000)
    assert [schedule.resolution_factor(s) for s in (0, 299, 300, 599, 600, 2999)] == [0.25, 0.25, 0.5, 0.5, 1.0, 1.0]
    assert Schedule(TrainConfig(resolution_schedule=0), 3000).resolution_factor(0) == 1.0
    assert Schedule(TrainConfig(num_downscales=0), 3000).resolution_factor(0) == 1.0


def doublings(config: TrainConfig, steps: int, pixels: float = 1e6) -> list[int]:
    """List the steps at which pictures double in size, in a run whose last part trains texels."""
    schedule = Schedule(config, steps, texels=True, pixels=pixels)
    factors = [schedule.resolution_factor(step) for step in range(steps)]
    assert all(now in (before, 2 * before) for before, now in itertools.pairwise(factors)) and factors[-1] == 1.0
    return [step for step in range(1, steps) if factors[step] > factors[step - 1]]


def test_short_runs_see_small_pictures_for_longer_but_their_texels_full_size():
    assert doublings(TrainConfig(), 30_000) == [3000, 6000]
    assert doublings(TrainConfig(), 60_000) == [6000, 12_000]
    gain = Schedule(TrainConfig(), 1500).short_run_gain
    assert gain > 2 and doublings(TrainConfig(), 1500) == [round(150 * gain), round(300 * gain)]
    assert doublings(TrainConfig(), 3000) == [300, 600] and doublings(TrainConfig(), 2400) == [375, 750]
    assert doublings(TrainConfig(), 1200) == [360, 720] and doublings(TrainConfig(), 10) == [3, 6]
    assert doublings(TrainConfig(), 1200, 22_500) == [180, 360]
    assert doublings(TrainConfig(), 1200, 9_000) == doublings(TrainConfig(), 1200, 0.0) == [120, 240]
    assert doublings(TrainConfig(texels=TexelConfig(start=3000)), 1200) == [120, 240]  # as in a run without
    assert doublings(TrainConfig(texels=TexelConfig(start=30_000)), 1200) == [120, 240]
    assert doublings(TrainConfig(num_downscales=0), 1200) == doublings(TrainConfig(resolution_schedule=0), 1200) == []


def test_learning_rates():
    schedule = Schedule(TrainConfig(), 30_000, extent=4.0)
    first, last = LearningRates().mean_pixels
    assert schedule.in_pixels and schedule.lr("means", 0) == pytest.approx(first)
    assert schedule.lr("means", 29_999) == pytest.approx(last)
    recorded = Schedule(TrainConfig(lr=LearningRates(means=(1.6e-4, 1.6e-6))), 30_000, extent=4.0)
    assert not recorded.in_pixels and recorded.lr("means", 0) == pytest.approx(4 * 1.6e-4)
    assert recorded.lr("means", 29_999) == pytest.approx(4 * 1.6e-6)
    assert schedule.lr("sh_rest", 0) == pytest.approx(schedule.lr("sh_dc", 0) / 20)
    assert schedule.lr("field_table", 0) == pytest.approx(1e-2 / 500)
    assert schedule.lr("field_mlp", 29_999) == pytest.approx(1e-3)
    names = "means quats log_scales opacity_logits beta_raw sv_sites sv_log_tau sv_rgb sh_dc sh_rest sb_base sb_lobes"
    for name in (names + " sg_base sg_lobes field_table field_mlp").split():
        assert type(schedule.lr(name, 1234)) is float  # no numpy scalars in checkpoints
        assert schedule.lr(name, 1234) > 0
    with pytest.raises(AttributeError, match="colour"):
        schedule.lr("colour", 0)


@pytest.mark.parametrize(("max_steps", "opacity"), [(30_000, 0.01), (3700, 0.01), (1000, 0.01613), (200, 0.2689)])
def test_resets_leave_time_to_recover(max_steps, opacity):
    assert Schedule(every_event(), max_steps).reset_opacity() == pytest.approx(opacity, rel=1e-3)


def test_positions_move_less_than_the_rest_when_texels_begin() -> None:
    """Other rates follow a run as long as the texels' part."""
    for steps in (1000, 30_000):
        schedule = Schedule(TrainConfig(), steps, texels=True)
        begin, part = schedule.texels_start, Schedule(TrainConfig(), schedule.texel_steps)
        assert schedule.lr("quats", begin) == pytest.approx(TexelConfig().surfel_rates * part.lr("quats", 0))
        assert schedule.lr("means", begin) == pytest.approx(TexelConfig().mean_rates * part.lr("means", 0))
        assert schedule.lr("means", begin) < 5 * schedule.lr("means", begin - 1)
        assert schedule.lr("means", steps - 1) < 1e-4 * schedule.lr("means", begin)


def test_short_runs_learn_faster() -> None:
    long, short, tiny = (Schedule(TrainConfig(), n) for n in (60_000, 3000, 50))
    for name in ("means", "quats", "opacity_logits", "sv_rgb", "sh_rest", "sb_lobes"):
        assert short.lr(name, 0) == pytest.approx(10**0.35 * long.lr(name, 0))
        assert tiny.lr(name, 0) == pytest.approx(4 * long.lr(name, 0))
    assert short.lr("field_mlp", 2999) == pytest.approx(long.lr("field_mlp", 59_999))


def test_the_overdraw_loss_counts_in_its_share_of_the_run() -> None:
    config = TrainConfig()
    assert overdraw_steps(Schedule(config, 100)) == []
    config.loss.overdraw_weight = 0.003
    assert overdraw_steps(Schedule(config, 100)) == list(range(40, 90))
    config.loss.overdraw_start, config.loss.overdraw_stop = 0, 30_000
    assert overdraw_steps(Schedule(config, 50)) == list(range(50))


@pytest.mark.parametrize(("views", "share"), [(0, 0.0), (50, 0.0), (75, 0.5), (100, 1.0), (2000, 1.0)])
def test_dropout_begins_where_photographs_are_seen_often(views, share):
    assert Schedule(TrainConfig(dropout=0.2), 100).dropout(views) == pytest.approx(0.2 * share)
