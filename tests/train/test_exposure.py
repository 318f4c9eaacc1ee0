"""Exposure corrections of photographs: formula, state, conditions, resuming."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import embedding
from torch.optim import SparseAdam

from bitymi_ns.capture.exif import exif_stops
from bitymi_ns.train import exposure as module
from bitymi_ns.train.config import DensifyConfig, LearningRates, TrainConfig
from bitymi_ns.train.evaluate import evaluate
from bitymi_ns.train.exposure import (
    LIMIT,
    OTHER_LIMIT,
    Exposure,
    corrected,
    exif_gains,
    restored,
    settled,
)
from bitymi_ns.train.fit import Trainer, fit
from bitymi_ns.train.gains import ExposureGains
from bitymi_ns.train.score import multi_view_scores
from bitymi_ns.train.views import View, shown
from tests.train.part_of_a_run import advanced

DENSIFY = DensifyConfig(max_surfels=250, min_interval=1, min_reset_interval=1, pixels_per_surfel=0)


def config(kind: str, **more) -> TrainConfig:
    return TrainConfig(exposure=kind, densify=DENSIFY, **more)


@pytest.fixture
def uneven(views) -> list[View]:
    logs = torch.tensor([0.3, -0.2, 0.1, -0.3, 0.25, -0.15])
    return [v._replace(image=(v.image * g.exp()).clamp(0, 1)) for v, g in zip(views, logs, strict=True)]


def started(kind: str, log_gains: Tensor, stops: Sequence[float] | None = None, points: int = 10**6) -> Exposure:
    """Make an exposure from photographs with these gains."""
    exposure = Exposure(kind, stops)
    found = ExposureGains(log_gains, torch.full((len(log_gains),), points), 0.5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "estimate_gains", lambda *_: found)
        exposure.start(torch.zeros(1, 3), [None] * len(log_gains), 0.02)
    return exposure


def learn(exposure: Exposure, number: int) -> Tensor:
    """Return a photograph's correction as a leaf."""
    return exposure.learning(number, exposure.of(number))


# the formula


@pytest.mark.parametrize("background", [None, torch.tensor([0.2, 0.9, 1.0], dtype=torch.float64)])
@pytest.mark.parametrize("columns", [3, 12])
def test_gradients_of_the_corrected_image(columns: int, background: Tensor | None) -> None:
    g = torch.Generator().manual_seed(0)
    table = (0.3 * torch.randn(4, columns, generator=g, dtype=torch.float64)).requires_grad_()
    rgb, alpha = (torch.rand(3, 4, n, generator=g, dtype=torch.float64).requires_grad_() for n in (3, 1))
    exposure = Exposure("affine")

    def image(table: Tensor, rgb: Tensor, alpha: Tensor) -> Tensor:
        exposure.table = table
        return shown(rgb, exposure.of(2), alpha, background)

    assert torch.autograd.gradcheck(image, (table, rgb, alpha))


@pytest.mark.parametrize("kind", ["gain", "affine"])
def test_steps_are_those_of_sparse_adam_on_the_logs(kind: str) -> None:
    g = torch.Generator().manual_seed(3)
    exposure = started(kind, 0.3 * torch.randn(5, 3, generator=g))
    table = torch.nn.Parameter(exposure.table.double())
    optimizer = SparseAdam([table], lr=0.2, betas=module.BETAS)
    weights = torch.randn(40, *exposure.of(0).shape, generator=g)
    for step, weight in enumerate(weights):
        number = 3 * step % 5
        (learn(exposure, number) * weight).sum().backward()
        exposure.step(0.2)
        row = embedding(torch.tensor(number), table, sparse=True)
        (module._correction(row) * weight).sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        with torch.no_grad():
            table.copy_(settled(table))
        torch.testing.assert_close(exposure.table, table.float(), rtol=1e-4, atol=1e-5)
    assert exposure.table.abs().max() > 0.5


def test_an_affine_correction_is_its_formula() -> None:
    g = torch.Generator().manual_seed(1)
    rgb, alpha, background = torch.rand(5, 6, 3, generator=g), torch.rand(5, 6, 1, generator=g), torch.rand(3)
    correction = torch.rand(3, 4, generator=g)
    behind = (1 - alpha) * background
    want = (rgb - behind) @ correction[:, :3].T + alpha * correction[:, 3] + behind
    torch.testing.assert_close(shown(rgb, correction, alpha, background), want)
    gains = torch.diag(torch.tensor([1.2, 0.9, 1.1]))
    as_matrix = torch.cat([gains, torch.zeros(3, 1)], 1)
    torch.testing.assert_close(shown(rgb, gains.diag(), alpha, background), shown(rgb, as_matrix, alpha, background))
    assert shown(rgb, None, alpha, background) is rgb


# what is kept


ODD = [0.0, math.nan, math.inf, -math.inf, 1e30]


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 9), st.sampled_from([3, 12]), st.floats(0, 100), st.sampled_from(ODD), st.integers(0, 99))
def test_tables_are_settled(count: int, columns: int, spread: float, odd: float, seed: int) -> None:
    table = spread * torch.randn(count, columns, generator=torch.Generator().manual_seed(seed))
    table[0, 0] = odd
    done = settled(table)
    limit = torch.full((columns,), OTHER_LIMIT)
    limit[[0, 1, 2] if columns == 3 else [0, 5, 10]] = LIMIT
    assert done.isfinite().all() and bool((done.abs() <= limit * (1 + 1e-6)).all())
    torch.testing.assert_close(done.mean(0), torch.zeros(columns), rtol=0, atol=1e-6)
    torch.testing.assert_close(settled(done), done, rtol=0, atol=1e-6)


@pytest.mark.parametrize("kind", ["gain", "affine"])
def test_steps_keep_the_mean_and_the_limits(kind: str) -> None:
    exposure = started(kind, torch.zeros(5, 3))
    for step, bad in enumerate([0.0, 0.0, math.nan, math.inf, 0.0] * 20):
        correction = learn(exposure, step % 5)
        correction.sum().backward()
        correction.grad += bad * correction.grad
        exposure.step(1.0)
        assert exposure.table.isfinite().all()
        assert exposure.log_gains.abs().max() <= LIMIT + 1e-6
        assert exposure.table.mean(0).abs().max() < 1e-6
    assert exposure.table.abs().max() > 0.1


# when there are any


def test_exif_is_where_the_corrections_start_from() -> None:
    stops = [exif_stops(1 / 60, 2.8, 100), exif_stops(1 / 30, 2.8, 100), exif_stops(1 / 60, 2.8, 400), math.nan]
    assert stops[1] - stops[0] == pytest.approx(1.0) and stops[2] - stops[0] == pytest.approx(2.0)
    gains = exif_gains(stops, 4)
    torch.testing.assert_close(gains[1:3] - gains[0], math.log(2) / 2.2 * torch.tensor([[1.0], [2.0]]).expand(-1, 3))
    torch.testing.assert_close(gains.mean(0), torch.zeros(3), atol=1e-6, rtol=0)
    assert not gains[3].any() and not exif_gains(None, 3).any() and not exif_gains([math.nan, math.inf], 2).any()
    assert exif_gains([0.0, 1e6], 2).abs().max() <= LIMIT
    unseen = started("gain", torch.zeros(4, 3), stops, points=0)
    torch.testing.assert_close(unseen.log_gains, gains)
    well_seen = started("gain", torch.tensor([[0.1], [-0.1], [0.2], [-0.2]]).expand(-1, 3).clone(), stops)
    torch.testing.assert_close(well_seen.log_gains[:, 0], torch.tensor([0.1, -0.1, 0.2, -0.2]), atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("stops", "explained", "on"),
    [
        (None, 0.5, True),
        (None, 0.07, False),
        (None, -0.2, False),
        (None, math.nan, False),
        ([0.0, 1.0, 2.0], math.nan, True),
        ([0.0, 0.01, 0.0], math.nan, False),
        ([0.0, 1.0, 2.0], 0.0, False),  # stated exposures that the camera compensated
    ],
)
def test_auto_asks_the_photographs_and_then_exif(monkeypatch, stops, explained, on) -> None:
    found = ExposureGains(torch.zeros(3, 3), torch.zeros(3, dtype=torch.int64), explained)
    monkeypatch.setattr(module, "estimate_gains", lambda *_: found)
    exposure = Exposure("auto", stops)
    exposure.start(torch.zeros(1, 3), [None] * 3, 0.02)
    assert exposure.decided and (exposure.table is not None) == on and exposure.reason
    assert exposure.reason in exposure.sentence if on else not exposure.sentence
    assert on == (exposure.of(1) is not None)


def test_off_and_auto_on_even_photographs_are_the_same_run(make_scene, views) -> None:
    runs = []
    for kind in ("off", "auto"):
        trainer = advanced(Trainer(make_scene(), views, config(kind), 30), 30)
        assert trainer.training.exposure.table is None
        runs.append([p.detach().clone() for p in trainer.scene.parameters()])
    for a, b in zip(*runs, strict=True):
        assert torch.equal(a, b)


# of other photographs


@pytest.mark.parametrize("kind", ["gain", "affine"])
def test_between_photographs_log_gains_and_other_entries_are_interpolated(kind: str) -> None:
    """Two views of the first photograph share its correction."""
    files = [Path(f"images/{name}.png") for name in ("1", "1", "5")]
    table = torch.tensor([[0.3] * 3, [-0.3] * 3])
    if kind == "affine":
        table = torch.cat([torch.arange(12.0)[None] / 100, -torch.arange(12.0)[None] / 100])
    state = {"kind": kind, "decided": True, "finding": "", "table": table, "optimizer": {"state": {}}}
    exposure = restored(state, 3, files)
    for number, row in (("0", table[0]), ("1", table[0]), ("2", 0.5 * table[0]), ("5", table[1]), ("9", table[1])):
        expected = row.exp() if kind == "gain" else row.view(3, 4).clone()
        if kind == "affine":
            expected[range(3), range(3)] = expected[range(3), range(3)].exp()
        found = exposure.at(Path(f"images/{number}.png"))
        torch.testing.assert_close(found, expected)
        assert not found.requires_grad
    torch.testing.assert_close(exposure.at(files[2]), exposure.of(2).detach())
    assert exposure.at(Path("others/2.png")) is None and exposure.at(None) is None
    for others in (restored(state, 4, [*files, Path("images/7.png")]), restored(None, 3, files)):
        assert others.table is None and others.at(files[0]) is None


# in training


@pytest.mark.slow
def test_training_learns_the_exposures(make_scene, views, uneven) -> None:
    results, grey = {}, torch.full((1, 1, 3), 0.5)
    for kind in ("off", "gain", "affine"):
        lr = LearningRates(exposure=(0.02, 0.005))
        trainer = advanced(Trainer(make_scene(every=2), uneven, config(kind, lr=lr, resolution_schedule=0), 150), 150)
        results[kind] = evaluate(trainer.scene, views, trainer.config)
        if kind == "off":
            continue
        learned = [shown(grey, trainer.training.exposure.of(i), torch.ones(1, 1, 1), None) for i in range(6)]
        logs = torch.stack([image.mean() / 0.5 for image in learned]).log()
        torch.testing.assert_close(logs, torch.tensor([0.3, -0.2, 0.1, -0.3, 0.25, -0.15]), atol=0.1, rtol=0)
        assert results[kind].fitted_psnr > results["off"].fitted_psnr + 0.5
        assert results[kind].psnr > results["off"].psnr - 0.1


@pytest.mark.slow
def test_held_out_photographs_are_judged_with_the_exposure_of_their_neighbours(make_scene, views) -> None:
    """The first three photographs are bright, the last three dark."""
    logs = torch.tensor([0.3, 0.3, 0.3, -0.3, -0.3, -0.3])
    named = [
        v._replace(image=(v.image * g.exp()).clamp(0, 1), file=Path(f"{i}.png"))
        for i, (v, g) in enumerate(zip(views, logs, strict=True))
    ]
    options = {"lr": LearningRates(exposure=(0.02, 0.005)), "resolution_schedule": 0}
    train, held_out = [named[i] for i in (0, 1, 3, 5)], [named[2], named[4]]
    (last,) = fit(make_scene(every=2), train, held_out, config("gain", **options), 100).entries
    assert last.psnr > last.mean_exposure_psnr
    unnamed = [view._replace(file=None) for view in held_out]
    (last,) = fit(make_scene(every=2), train, unnamed, config("gain", **options), 2).entries
    assert last.psnr == last.mean_exposure_psnr
    (last,) = fit(make_scene(every=2), train, held_out, config("off", **options), 2).entries
    assert math.isnan(last.mean_exposure_psnr)


def test_scores_are_of_the_corrected_image(make_scene, views) -> None:
    scene = make_scene(texture=False)
    with torch.no_grad():
        view = views[0]._replace(image=0.6 * scene.render(views[0].camera).rgb, correction=torch.full((3,), 0.6))
    assert multi_view_scores(scene, [view], TrainConfig()).importance.sum() == 0
    assert multi_view_scores(scene, [view._replace(correction=None)], TrainConfig()).importance.sum() > 0


@pytest.mark.parametrize(
    ("kind", "saved", "views", "decided"),
    [
        ("affine", "gain", 6, False),  # starts over
        ("gain", "gain", 5, False),
        ("gain", None, 6, False),
        ("auto", None, 6, True),
        ("auto", "off", 6, True),
        ("off", "gain", 6, True),
    ],
)
def test_states_of_earlier_versions_other_options_and_other_photographs(kind, saved, views, decided) -> None:
    states = {None: None, "off": Exposure("off").state_dict(), "gain": started("gain", torch.ones(6, 3)).state_dict()}
    exposure = Exposure(kind)
    exposure.load_state_dict(states[saved], views)
    assert exposure.decided == decided and exposure.table is None
    there = Exposure("gain")
    there.load_state_dict(states["gain"], 6, "meta")
    assert there.table.device.type == there.of(0).device.type == "meta"


def test_the_photographs_of_a_run_with_its_corrections(make_scene, uneven) -> None:
    trainer = Trainer(make_scene(), uneven, config("gain"), 20)
    trainer.advance()
    state = trainer.training.exposure.state_dict()
    views = corrected(uneven, state)
    torch.testing.assert_close(views[3].correction, trainer.training.exposure.log_gains[3].exp())
    assert views[3].image is uneven[3].image and not views[3].correction.requires_grad
    assert corrected(uneven, None) is uneven and corrected(uneven, {**state, "table": None}) is uneven
    with pytest.raises(ValueError, match="6 photographs, and now there are 5"):
        corrected(uneven[:5], state)
