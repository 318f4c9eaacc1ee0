"""Scripts that no other test runs find what they import."""

import sys
from collections.abc import Callable
from types import ModuleType

import pytest

from tests.scripts.conftest import ROOT


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "benchmarks").glob("*.py")))
def test_benchmarks_import(load: Callable[[str], ModuleType], name: str) -> None:
    assert load(name).__doc__


def test_targets_of_the_fuzzer_import(load: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "atheris", ModuleType("atheris"))  # it is no dependency
    assert load("fuzz_targets").TARGETS
