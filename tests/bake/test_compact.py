"""Compact bakes: surfels rounded as far as the pictures allow, texels trained through their coding."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from bitymi_ns.bake import Reduced, Rounded, Stage, TuneOptions, compact, export, tune_atlas
from bitymi_ns.bake.compact import ENOUGH, MAX_LAMBDA, START, TEXEL_SHARE, Coder, Compact, compacted
from bitymi_ns.bake.precision import PER_BIT
from bitymi_ns.bundle import check_files
from bitymi_ns.train.views import View
from tests.bake.test_tune import BACKGROUND, error, photographs, render


@pytest.fixture(scope="module")
def views(truth: Reduced) -> list[View]:
    """Photographs of `truth`, darker by 0.01, for a nonzero error."""
    return [View(view.camera, (view.image - 0.01).clamp(0, 1)) for view in photographs(truth)]


@pytest.fixture(scope="module")
def rounded(truth: Reduced, views: list[View]) -> Rounded:
    return compacted(truth, views, BACKGROUND, Compact(share=0.05))


def from_photographs(baked: Stage, views: list[View]) -> float:
    pictures = [(render(baked, view.camera).clamp(0, 1), view.image) for view in views]
    return sum(float((x - y).square().mean()) for x, y in pictures) / len(pictures)


def test_what_costs_less_takes_more_bytes(truth: Reduced, views: list[View], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compact, "MAX_LAMBDA", math.inf)  # the share alone decides
    sizes = []
    for share in (0.05, 0.4):
        rounded = compacted(truth, views, BACKGROUND, Compact(share=share, views=len(views)))
        allowed = share * from_photographs(truth, views)
        assert 0 < rounded.statistics.rounding.mse <= 1.001 * allowed
        assert from_photographs(rounded, photographs(truth)) < 4 * allowed
        assert sorted(rounded.rows.tolist()) == sorted(truth.rows.tolist())
        sizes.append(rounded.codes.nbytes() + rounded.encoded().codes.texels.nbytes())
    assert sizes[1] < 0.9 * sizes[0]


def test_a_large_error_of_the_bake_does_not_hide_that_of_rounding(truth: Reduced, views: list[View]) -> None:
    dark = [View(view.camera, view.image / 2) for view in views]
    capped = compacted(truth, dark, BACKGROUND, Compact(share=0.9))
    assert capped.step == pytest.approx(255 * math.sqrt(TEXEL_SHARE * 12 * MAX_LAMBDA / PER_BIT))
    assert capped.step == pytest.approx(4.16, abs=0.02)
    asked = compacted(truth, dark, BACKGROUND, Compact(psnr=Coder(truth, dark, BACKGROUND, Compact()).psnr - 2))
    assert asked.step > capped.step and asked.codes.nbytes() < capped.codes.nbytes()


def test_the_pictures_are_as_good_as_is_asked_for(truth: Reduced, views: list[View]) -> None:
    coder = Coder(truth, views, BACKGROUND, Compact())
    sizes = []
    for loss in (0.1, 1.0):
        rounded = compacted(truth, views, BACKGROUND, Compact(psnr=coder.psnr - loss))
        assert rounded.statistics.rounding.mse <= coder.error * (10 ** (loss / 10) - 1) * 1.1
        sizes.append(rounded.codes.nbytes())
    assert sizes[1] < sizes[0]
    with pytest.raises(ValueError, match="cannot be reached: ask for less"):
        compacted(truth, views, BACKGROUND, Compact(psnr=coder.psnr + 1))


def test_surfels_and_texels_fit_into_the_bytes_there_are(truth: Reduced, views: list[View], tmp_path: Path) -> None:
    free = compacted(truth, views, BACKGROUND, Compact(share=0.02))
    most = (free.codes.nbytes() + free.encoded().codes.texels.nbytes()) * 7 // 10
    fitted = compacted(truth, views, BACKGROUND, Compact(most_bytes=most))
    assert fitted.fill and fitted.codes.nbytes() < free.codes.nbytes()
    for fill in (True, False):
        options = TuneOptions(steps=0, coded_steps=60, val_every=0)
        again = replace(fitted, fill=fill)
        tuned = tune_atlas(again, views, BACKGROUND, options)
        export(tuned, bundle := tmp_path / f"fill-{fill}")
        size = sum((bundle / name).stat().st_size for name in ("surfels.bin", "texels.bin"))
        assert size == tuned.codes.surfels.nbytes() + tuned.codes.texels.nbytes()
        assert (0.93 if fill else 0.5) * most < size <= most
    with pytest.raises(ValueError, match="are too few for 60 surfels"):
        compacted(truth, views, BACKGROUND, Compact(most_bytes=300))


def test_a_size_that_the_coarsest_texels_exceed_is_refused(truth: Reduced, monkeypatch: pytest.MonkeyPatch) -> None:
    baked = SimpleNamespace(rows=range(60), codes=SimpleNamespace(nbytes=lambda: 1000))
    point = SimpleNamespace(bytes=5000, error=0.1, baked=baked)
    coder: Any = SimpleNamespace(measured=True, allowed=lambda share: 0.01, at=lambda lmbda: point)
    monkeypatch.setattr(compact, "Coder", lambda *_: coder)
    with pytest.raises(ValueError, match=r"3,000 bytes are too few for 60 surfels, which take at least 5,000"):
        compacted(truth, [], BACKGROUND, Compact(most_bytes=3000))


def test_bytes_that_buy_nothing_are_not_spent(truth: Reduced, views: list[View]) -> None:
    coder = Coder(truth, views, BACKGROUND, Compact(views=len(views)))
    kept = compacted(truth, views, BACKGROUND, Compact(views=len(views), most_bytes=10**9))
    fewer, more = kept.statistics.rounding.alternatives
    assert 0.45 < fewer[0] < 0.55 and 1.8 < more[0] < 2.2 and fewer[1] < more[1]
    assert kept.statistics.rounding.mse <= 1.001 * ENOUGH * coder.error
    size = kept.codes.nbytes() + kept.encoded().codes.texels.nbytes()
    assert size < 0.8 * coder.at(START / 1000).bytes
    assert kept.most_bytes == 10**9 - kept.codes.nbytes()


def test_without_views_the_reference_steps_are_taken(truth: Reduced) -> None:
    plain = compacted(truth, [], BACKGROUND)
    assert plain.statistics.rounding.mse is None and plain.statistics.rounding.alternatives is None
    assert len(plain.rows) == len(truth.rows) and len(plain.scene.surfels["view_terms"]) > 0


def test_texels_learn_through_their_coding(rounded: Rounded, views: list[View], tmp_path) -> None:
    options = TuneOptions(steps=8, coded_steps=40, coded_every=5, val_every=4)
    coarse = replace(rounded, step=30.0)
    still = tune_atlas(coarse, views, BACKGROUND, replace(options, coded_steps=0))
    tuned = tune_atlas(coarse, views, BACKGROUND, options)
    assert error(tuned, views) <= error(still, views)
    torch.testing.assert_close(tuned.scene.mean_residual, tuned.codes.texels.constants)
    export(tuned, tmp_path / "b")
    bundle, checks = check_files(tmp_path / "b")
    wrong = [check for check in checks if not check.ok and check.name != "statistics"]  # a tile was taken out above
    assert bundle is not None and not wrong
    for view in views[:2]:
        want = tuned.scene.render(view.camera, BACKGROUND).rgb
        torch.testing.assert_close(bundle.scene.render(view.camera, BACKGROUND).rgb, want, rtol=1e-4, atol=1e-4)
