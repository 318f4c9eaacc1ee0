"""Settings of all tests."""

import gc
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

os.environ.setdefault("BITYMI_NO_DOWNLOAD", "1")  # no downloads, also in child processes


class _MissingEncoder(ModuleType):
    """Stub for the missing BC7 encoder (Python 3.10), which skips tests that use it."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        pytest.skip("ispc_texcomp, BC7's encoder, is not installed")


if importlib.util.find_spec("ispc_texcomp") is None:
    sys.modules["ispc_texcomp"] = _MissingEncoder("ispc_texcomp")


FIRST = ("e2e", "view")
"""Folders with the slowest files, run first so that no worker is left alone with them."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run the slow files first when workers share the tests."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.path.parent.name not in FIRST)


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ray-traced room as a capture: 12 views of 48 x 36 pixels with 200 points. Not to be changed."""
    from bitymi_ns.sample import generate

    return generate(tmp_path_factory.mktemp("captures") / "room", views=12, width=48, height=36, seed=0, points=200)


def pytest_collection_finish() -> None:
    """Exclude imported modules and collected tests from garbage collection, which large tests trigger often."""
    gc.collect()
    gc.freeze()
