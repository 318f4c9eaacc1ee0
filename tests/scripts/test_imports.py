"""Scripts that no other test runs find what they import."""

from collections.abc import Callable
from types import ModuleType

import pytest

from tests.scripts.conftest import ROOT


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "benchmarks").glob("*.py")))
def test_benchmarks_import(load: Callable[[str], ModuleType], name: str) -> None:
    assert load(name).__doc__
