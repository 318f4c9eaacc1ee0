"""Certificates in bundles are true, and `bitymi verify` measures them again."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.bake import BakeOptions, Coded, Reduced, RefineOptions, TuneOptions, bake, export
from bitymi_ns.bake.compact import Compact
from bitymi_ns.bake.tile_errors import cells_per_pixel, closest_pixels, listed_errors, moving_average
from bitymi_ns.bake.tiles import TileVisibility
from bitymi_ns.bundle import check_files
from bitymi_ns.bundle.statistics import Certificate
from bitymi_ns.scene.visibility import visibility
from tests.bake.test_tune import BACKGROUND, photographs
from tests.bundle.damage import amend, recode

SIDES = ((0, 0), (4, 4), (8, 4), (8, 16))


def mean_over(row: np.ndarray, center: float, width: float) -> float:
    """Average a piecewise constant function of unit steps over a window."""
    low, high = center - width / 2, center + width / 2
    edges = np.arange(len(row))
    share = np.clip(np.minimum(high, edges + 1) - np.maximum(low, edges), 0, None)
    return float((share * row).sum() / width)


def by_hand(values: np.ndarray, cells: tuple[float, float]) -> np.ndarray:
    """Compute `moving_average` of one channel [v, u], cell by cell."""
    for axis, width in ((1, cells[0]), (0, cells[1])):
        count = values.shape[axis]
        at = [min(max(i + 0.5, width / 2), count - width / 2) for i in range(count)]
        moved = np.moveaxis(values, axis, 1)
        moved = np.array([[mean_over(row, center, width) for center in at] for row in moved])
        values = np.moveaxis(moved, 1, axis)
    return values


@settings(max_examples=30, deadline=None)
@given(
    size=st.sampled_from(SIDES[1:]),
    shares=st.tuples(st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    seed=st.integers(0, 1000),
)
def test_a_pixel_averages_what_it_covers(size: tuple[int, int], shares: tuple[float, float], seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=(size[1], size[0]))
    cells = tuple(1 + share * (side - 1) for share, side in zip(shares, size, strict=True))
    got = moving_average(torch.from_numpy(values).float()[None, None], torch.tensor([cells]))
    np.testing.assert_allclose(got[0, 0].numpy(), by_hand(values, cells), atol=2e-5)


def test_a_pixel_covers_from_one_cell_to_the_whole_tile() -> None:
    pixels = torch.tensor([[10.0, 1.0], [0.0, 0.25]])
    shown = TileVisibility(torch.ones(2), torch.ones(2), torch.tensor([1.0, 2.0]), 0.0, pixels=pixels)
    cells = cells_per_pixel(shown, torch.arange(2), (8, 16))
    assert cells.tolist() == [[1.0, 8.0], [8.0, 16.0]]
    values = torch.rand(2, 3, 16, 8)
    assert torch.equal(moving_average(values, torch.ones(2, 2)), values)
    whole = moving_average(values, torch.tensor([[8.0, 16.0]] * 2))
    torch.testing.assert_close(whole, values.mean((2, 3), keepdim=True).expand_as(values))


def test_pixels_are_those_of_the_closest_view(scene, camera) -> None:
    surfels = scene(5).surfels
    near, far = (closest_pixels(surfels, [camera(d)], 3.0, 0.2) for d in (4.0, 9.0))
    both = closest_pixels(surfels, [camera(4.0), camera(9.0)], 3.0, 0.2)
    assert torch.equal(both, torch.maximum(near, far)) and (near > far).any()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.0, 0.05))
def test_the_counts_are_true(seed: int, size: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    sizes = torch.tensor([SIDES[i] for i in torch.randint(len(SIDES), (9,), generator=generator).tolist()])
    extent, opacity, beta = (torch.rand(9, generator=generator) for _ in range(3))
    pixels = 20 * torch.rand(9, 2, generator=generator)
    shown = TileVisibility(opacity, 4 * beta, 0.2 + 2.8 * extent, 0.3, pixels=pixels)
    area = sizes.clamp(min=1).prod(1)
    difference = size * torch.randn(int(area.sum()), 3, generator=generator)
    errors, seen = listed_errors(difference, sizes, shown, chunk=40)
    found, first = [], 0
    for i, (r_u, r_v) in enumerate(sizes.tolist()):
        u, v = (r_u, r_v) if r_u else (8, 8)
        d = difference[first : first + int(area[i])].double().numpy()
        d = d.reshape(v, u, 3) if r_u else np.broadcast_to(d, (v, u, 3))
        first += int(area[i])
        e, b = float(shown.extent[i]), float(shown.beta[i])
        x, y = (e * ((2 * np.arange(n) + 1) / n - 1) for n in (u, v))
        rest = np.clip(1 - (x[None, :] ** 2 + y[:, None] ** 2) / 9, 0, None)
        weight = float(opacity[i]) * rest**b
        weight[(weight < 0.3) | (rest <= 0)] = 0
        if not weight.any():
            assert not seen[i]
            continue
        cells = [min(max(n / (2 * e * float(p)), 1.0), n) for n, p in zip((u, v), pixels[i], strict=True)]
        seen_by_a_pixel = np.stack([by_hand(weight * d[..., c], cells) for c in range(3)])
        square = (seen_by_a_pixel**2 * (weight > 0)).sum() / (3 * (weight > 0).sum())
        found.append(255 * math.sqrt(square))
        assert seen[i] and float(errors[i]) == pytest.approx(found[-1], rel=1e-3, abs=1e-4)
    if found and min(abs(each - 0.75) for each in found) > 1e-3:
        stated = Certificate.of(errors[seen], 0.75)
        assert (stated.within, stated.beyond) == (sum(e <= 0.75 for e in found), sum(e > 0.75 for e in found))
        assert stated.worst == pytest.approx(max(found), rel=1e-3, abs=1e-4)


@pytest.fixture(scope="module", params=[True, False], ids=["compact", "pages"])
def tuned(scene, truth: Reduced, request: pytest.FixtureRequest) -> Coded:
    compact, made, views = request.param, scene(60), photographs(truth)
    made.surfels["log_scales"] += 1.5
    made.surfels["opacity_logits"] += 1.0
    refine = RefineOptions(tune=TuneOptions(steps=2, coded_steps=10), compact=Compact() if compact else None)
    seen = ([view.camera for view in views], views, BACKGROUND)
    return bake(made, *seen, BakeOptions(format="uint8"), refine)


def test_what_is_stated_is_true_and_other_integers_fail(tuned: Coded, truth: Reduced, tmp_path: Path) -> None:
    baked = tuned
    stated = baked.statistics.certificate
    cameras = [view.camera for view in photographs(truth)]
    drawn = baked.scene
    found = visibility(drawn.surfels, cameras, drawn.near, drawn.weight_bound).in_front
    assert (baked.in_front - found).abs().mean() < 0.02  # in the order of the bundle; compact ones are rounded
    assert stated is not None and stated.against == "texels" and stated.within + stated.beyond <= len(baked.rows)
    export(baked, tmp_path / "b")
    checks = {check.name: check for check in check_files(tmp_path / "b")[1]}
    assert all(check.ok for check in checks.values()) and "steps of the texels as seen" in checks["certificate"].detail
    if baked.codes is None:
        return
    for name, rows in {"opacity": len(baked.rows), "grade": int((baked.sizes[:, 0] > 0).sum())}.items():
        recode(tmp_path / "b", name, lambda codes: codes.__setitem__(0, codes[0] + 1), rows=rows)
        assert [check.name for check in check_files(tmp_path / "b")[1] if not check.ok] == ["decoder"]


def test_counts_that_contradict_each_other_fail(tuned: Coded, tmp_path: Path) -> None:
    export(tuned, tmp_path / "b")
    amend(tmp_path / "b", lambda info: info["statistics"]["certificate"].update(beyond=0, worst=2.0))
    assert [check.name for check in check_files(tmp_path / "b")[1] if not check.ok] == ["certificate"]
