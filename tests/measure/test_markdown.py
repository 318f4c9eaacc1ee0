"""Templates escape their values and report missing ones."""

import jinja2
import pytest

from bitymi_ns.measure.markdown import rendered


def test_a_value_that_is_missing_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="content"):
        rendered("report.html.j2", generator="")


def test_markdown_is_not_escaped() -> None:
    names = ("rim", "probes", "accurate", "steps", "allowance", "picture", "nothing", "verdicts")
    cases = {"plain": "| a | b |", "texels": "<2", "alpha": "", "sweeps": ""}
    page = rendered("stability.md.j2", backend="<a>", cases=cases, **dict.fromkeys(names, "<1"))
    assert "backend `<a>`" in page and "\n\n| a | b |\n" in page and "<2" in page
