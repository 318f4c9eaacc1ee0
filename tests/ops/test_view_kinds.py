"""The entries of `VIEW_COLORS`: each agrees with itself, the kernels and the float64 twin, and is the only place that
knows its kind."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import get_type_hints

import pytest
import torch
import yaml

import bitymi_ns
from bitymi_ns import ops
from bitymi_ns.ops.reference import view_color as reference
from bitymi_ns.ops.view_color import check_lean, check_view_color
from bitymi_ns.ops.view_kinds import VIEW_COLORS, VIEW_PARAMETERS, kind_of
from bitymi_ns.presets import preset_dir
from bitymi_ns.scene.config import SceneConfig
from bitymi_ns.train.config import LearningRates

PACKAGE = Path(bitymi_ns.__file__).parent
KNOWING = ("ops/view_kinds.py", "ops/reference/view_color.py")
"""The entries and the float64 twins; the formulas are in csrc/core/view_kinds.h."""
NAMES = frozenset({*VIEW_COLORS, *VIEW_PARAMETERS})


def names_in(node: ast.AST | None) -> set[str]:
    """Kinds and parameters of kinds that an expression is, or holds as a collection."""
    if isinstance(node, (ast.Tuple, ast.List, ast.Set)):
        return set().union(*(names_in(each) for each in node.elts))
    return {node.value} & NAMES if isinstance(node, ast.Constant) and isinstance(node.value, str) else set()


def by_kind(text: str) -> Iterator[tuple[int, set[str]]]:
    """Lines where Python code has a table or a branch by kind: keys of a dict, collections, comparisons, cases."""
    for node in ast.walk(ast.parse(text)):
        found: set[str] = set()
        if isinstance(node, ast.Dict):
            found = set().union(*(names_in(key) for key in node.keys))
        elif isinstance(node, (ast.Tuple, ast.List, ast.Set)):
            found = names_in(node)
        elif isinstance(node, ast.Compare):
            found = set().union(*(names_in(each) for each in (node.left, *node.comparators)))
        elif isinstance(node, ast.MatchValue):
            found = names_in(node.value)
        elif isinstance(node, ast.Call):
            at_start = isinstance(node.func, ast.Attribute) and node.func.attr in ("startswith", "endswith")
            keywords = {word.arg for word in node.keywords if word.arg} & set(VIEW_COLORS)
            found = set().union(keywords, *(names_in(each) for each in node.args if at_start))
        if found:
            yield node.lineno, found


def test_no_other_module_has_a_table_or_a_branch_by_kind() -> None:
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.relative_to(PACKAGE).as_posix() not in KNOWING:
            places = [f"{path}:{line} {sorted(names)}" for line, names in by_kind(path.read_text("utf8"))]
            assert not places, places


@pytest.mark.parametrize(
    "text",
    [
        'widths = {"sv": 6, "sh": 3}',
        "widths = dict(sv=6, sh=3)",
        'if kind == "sh": pass',
        'terms = 1 if kind != "sh" else 0',
        'if kind in ("sb", "sg"): pass',
        'SHAPES = ("sv_sites", "sv_log_tau")',
        'Kind = Literal["sv", "sh"]',
        'match kind:\n    case "sv":\n        pass',
        'if name.startswith("sv"): pass',
    ],
)
def test_tables_and_branches_by_kind_are_found(text: str) -> None:
    assert list(by_kind(text))


def test_what_names_one_kind_is_no_table() -> None:
    assert not list(by_kind('scene = f("sv")\nkind: str = "sv"\nnames = VIEW_COLORS["sv"].names'))


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
        assert len(parameter.limit) in (1, parameter.shape[-1]) and 0 < parameter.share <= 1
        assert hasattr(LearningRates(), parameter.rate)
    assert len(entry.lean_limit) in (1, entry.lean_width)
    if entry.sites is None:  # a lean colour is then the parameters themselves
        first, second = entry.parameters
        assert first.shape == (3,) and second.width == entry.lean_width and second.limit == entry.lean_limit


@pytest.mark.parametrize("kind", list(VIEW_COLORS))
def test_a_base_of_one_shows_its_unit_and_whole_numbers_of_terms_are_taken(kind: str) -> None:
    entry = VIEW_COLORS[kind]
    lean = {"view_base": torch.ones(1, 3), "view_span": torch.zeros(1, 2).int()}
    lean["view_terms"] = torch.zeros(max(entry.lean_counts) + 1, entry.lean_width)
    color = ops.view_color(kind, lean, torch.rand(1, 3), torch.zeros(3))
    torch.testing.assert_close(color, torch.full((1, 3), entry.base_unit))
    for count in range(-1, max(entry.lean_counts) + 2):
        lean["view_span"] = torch.tensor([[0, count]]).int()
        if count in entry.lean_counts:
            check_lean(kind, lean, 1)
        else:
            with pytest.raises(ValueError, match="surfel 0"):
                check_lean(kind, lean, 1)


def test_every_kind_has_a_preset() -> None:
    stated = [yaml.safe_load(path.read_text("utf8")).get("scene", {}) for path in preset_dir().glob("*.yaml")]
    kinds = {scene.get("view_color", SceneConfig().view_color) for scene in stated}
    assert kinds == set(VIEW_COLORS)
