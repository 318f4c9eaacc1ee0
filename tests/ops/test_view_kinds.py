"""Entries of `VIEW_COLORS` are consistent with themselves, the kernels and the float64 twin."""

from typing import get_args, get_type_hints

import pytest
import torch
import yaml

from bitymi_ns import ops
from bitymi_ns.ops.reference import view_color as reference
from bitymi_ns.ops.view_color import check_reduced, check_view_color
from bitymi_ns.ops.view_kinds import VIEW_COLORS, Kind, kind_of
from bitymi_ns.presets import preset_dir
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import LearningRates


def test_the_type_of_options_has_the_kinds() -> None:
    assert get_args(Kind) == tuple(VIEW_COLORS)


@pytest.mark.parametrize("kind", list(VIEW_COLORS))
def test_an_entry_agrees_with_itself_the_kernels_and_the_twin(kind: str) -> None:
    entry, n = VIEW_COLORS[kind], 4
    at_least, at_most = get_type_hints(SceneConfig, include_extras=True)[entry.option].__metadata__[0].metadata
    low, high = at_least.ge, at_most.le
    for value in {low, min(high, low + 1), getattr(SceneConfig(), entry.option), high}:
        terms = entry.terms_of(value)
        config = SceneConfig(view_color=kind, **{entry.option: value})
        g = torch.Generator().manual_seed(0)
        params = entry.first_values(torch.rand(n, 3, generator=g) - 0.5, config, g)
        assert tuple(params) == entry.names and kind_of(params) == kind
        assert [tuple(p.shape) for p in params.values()] == [(n, *shape) for shape in entry.shapes(terms)]
        assert entry.terms(params) == check_view_color(kind, params, n) == terms and terms - entry.base_terms >= 0
        means = torch.randn(n, 3, generator=g)
        want = getattr(reference, kind)(*(p.double() for p in params.values()), torch.nn.functional.normalize(means))
        got = ops.view_color(kind, params, means, torch.zeros(3))
        torch.testing.assert_close(got.double(), want, rtol=1e-5, atol=1e-5)
    for wrong in {min(entry.counts) - 1, max(entry.counts) + 1}:
        assert entry.problem(wrong)
    for parameter in entry.parameters:
        assert len(parameter.limit) in (1, parameter.shape[-1]) and 0 < parameter.rate_factor <= 1
        assert hasattr(LearningRates(), parameter.rate)
    assert len(entry.reduced_limit) in (1, entry.reduced_width)
    if entry.sites is None:  # the reduced colour has the same parameters
        first, second = entry.parameters
        assert first.shape == (3,) and second.width == entry.reduced_width and second.limit == entry.reduced_limit


@pytest.mark.parametrize("kind", list(VIEW_COLORS))
def test_a_base_of_one_shows_its_unit_and_whole_numbers_of_terms_are_taken(kind: str) -> None:
    entry = VIEW_COLORS[kind]
    reduced = {"view_base": torch.ones(1, 3), "view_span": torch.zeros(1, 2).int()}
    reduced["view_terms"] = torch.zeros(max(entry.reduced_counts) + 1, entry.reduced_width)
    color = ops.view_color(kind, reduced, torch.rand(1, 3), torch.zeros(3))
    torch.testing.assert_close(color, torch.full((1, 3), entry.base_unit))
    for count in range(-1, max(entry.reduced_counts) + 2):
        reduced["view_span"] = torch.tensor([[0, count]]).int()
        if count in entry.reduced_counts:
            check_reduced(kind, reduced, 1)
        else:
            with pytest.raises(ValueError, match="surfel 0"):
                check_reduced(kind, reduced, 1)


def test_every_kind_has_a_preset() -> None:
    stated = [yaml.safe_load(path.read_text("utf8")).get("scene", {}) for path in preset_dir().glob("*.yaml")]
    kinds = {scene.get("view_color", SceneConfig().view_color) for scene in stated}
    assert kinds == set(VIEW_COLORS)
