"""A bake becomes compact: surfels are rounded as far as the pictures allow, texels learn through their coding."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bitymi_ns.bake import Baked, TuneOptions, tune_atlas
from bitymi_ns.bake.compact import Compact, with_coded_texels, with_rounded_surfels
from bitymi_ns.bake.precision import PrecisionOptions
from bitymi_ns.bake.texel_codes import TexelCodeOptions
from bitymi_ns.bundle import check_files, export
from bitymi_ns.train.views import View
from tests.bake.test_tune import BACKGROUND, photographs, render, waving

SHARP = TexelCodeOptions(step=1.0)


@pytest.fixture(scope="module")
def truth(scene) -> Baked:
    """The scene of the photographs."""
    return waving(scene(60))


@pytest.fixture(scope="module")
def views(truth: Baked) -> list[View]:
    """Photographs of it, darker by a hundredth, so that there is an error to compare with."""
    return [View(view.camera, (view.image - 0.01).clamp(0, 1)) for view in photographs(truth)]


@pytest.fixture(scope="module")
def rounded(truth: Baked, views: list[View]) -> Baked:
    """The same with rounded surfels."""
    return with_rounded_surfels(truth, views, BACKGROUND, PrecisionOptions(share=0.05))


def error(a: Baked, b: Baked, views: list[View]) -> float:
    """Mean square difference of their pictures."""
    pictures = [(render(a, view.camera), render(b, view.camera)) for view in views]
    return sum(float((x.clamp(0, 1) - y.clamp(0, 1)).square().mean()) for x, y in pictures) / len(pictures)


def test_rounding_changes_the_pictures_by_what_it_may(truth: Baked, rounded: Baked, views: list[View]) -> None:
    stated, allowed = rounded.statistics.rounding.mse, 0.05 * 1e-4
    assert stated <= allowed * 1.05 and error(truth, rounded, views) < 2 * allowed
    assert sorted(rounded.rows.tolist()) == sorted(truth.rows.tolist())
    finer = with_rounded_surfels(truth, views, BACKGROUND, PrecisionOptions(share=0.005))
    assert finer.statistics.rounding.mse < stated and finer.codes.surfels.nbytes() > rounded.codes.surfels.nbytes()


def test_surfels_fit_into_the_bytes_there_are(truth: Baked, rounded: Baked, views: list[View]) -> None:
    most = rounded.codes.surfels.nbytes() * 9 // 10
    fitted = with_rounded_surfels(truth, views, BACKGROUND, PrecisionOptions(share=0.05, most_bytes=most))
    assert fitted.codes.surfels.nbytes() < rounded.codes.surfels.nbytes()


def test_without_views_the_reference_steps_are_taken(truth: Baked) -> None:
    plain = with_rounded_surfels(truth, [], BACKGROUND)
    assert plain.statistics.rounding.mse is None or math.isnan(plain.statistics.rounding.mse)
    assert len(plain.rows) == len(truth.rows)


def test_texels_learn_through_their_coding_and_are_what_is_stored(rounded: Baked, views: list[View], tmp_path) -> None:
    options = TuneOptions(steps=8, coded_steps=40, coded_every=5, held_in_every=4)
    coarse = TexelCodeOptions(step=30.0)
    still = tune_atlas(rounded, views, BACKGROUND, replace(options, coded_steps=0), coding=coarse)
    tuned = tune_atlas(rounded, views, BACKGROUND, options, coding=coarse)

    def against_photographs(baked: Baked) -> float:
        return sum(float((render(baked, v.camera).clamp(0, 1) - v.image).square().mean()) for v in views)

    assert against_photographs(tuned) <= against_photographs(still)
    torch.testing.assert_close(tuned.mean_residual, tuned.codes.texels.constants)
    export(tuned, tmp_path / "b")
    bundle, checks = check_files(tmp_path / "b")
    wrong = [check for check in checks if not check.ok and check.name != "statistics"]  # a tile was taken out above
    assert bundle is not None and not wrong
    for view in views[:2]:
        want = tuned.stored().render(view.camera, BACKGROUND).rgb
        torch.testing.assert_close(bundle.scene.render(view.camera, BACKGROUND).rgb, want, rtol=1e-4, atol=1e-4)


def test_texels_fit_into_the_bytes_there_are(rounded: Baked, views: list[View]) -> None:
    free = with_coded_texels(rounded, SHARP).codes.texels.nbytes()
    most = free * 6 // 10
    assert with_coded_texels(rounded, replace(SHARP, most_bytes=most)).codes.texels.nbytes() <= most
    options = TuneOptions(steps=4, coded_steps=10, held_in_every=4)
    tuned = tune_atlas(rounded, views, BACKGROUND, options, coding=replace(SHARP, most_bytes=most))
    assert tuned.codes.texels.nbytes() <= most


def test_what_is_left_is_asked_of_the_rounded_surfels(rounded: Baked, truth: Baked) -> None:
    assert Compact(left=lambda codes: len(codes.surfels)).coding_of(rounded).most_bytes == len(rounded.rows)
    assert Compact(left=lambda codes: 5).coding_of(truth).most_bytes is None
