"""Templates report missing values."""

import jinja2
import pytest

from bitymi_ns.measure.markdown import rendered


def test_a_value_that_is_missing_is_an_error() -> None:
    with pytest.raises(jinja2.UndefinedError, match="content"):
        rendered("report.html.j2", generator="")
