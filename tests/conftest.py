"""Settings of all tests."""

import gc
import importlib.util
import inspect
import os
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

os.environ.setdefault("BITYMI_NO_DOWNLOAD", "1")  # nothing is fetched, here or in processes that tests start

_stack = inspect.stack


def _cheap_stack(context: int = 1) -> list[Any]:
    """Replace `inspect.stack` for nerfstudio's list of external methods.

    Its import asks 26 times for the name of a caller. Each time `inspect` searches every loaded module for every frame,
    which with pytest's frames takes most of the time of collecting the tests.
    """
    frame = sys._getframe(1)
    if frame.f_globals.get("__name__") != "nerfstudio.configs.external_methods":
        return _stack(context)
    names = []
    while frame is not None:
        names.append(SimpleNamespace(function=frame.f_code.co_name))
        frame = frame.f_back
    return names


inspect.stack = _cheap_stack


class _MissingEncoder(ModuleType):
    """BC7's encoder where there is none, on Python 3.10: a test that comes to use it is skipped."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        pytest.skip("ispc_texcomp, BC7's encoder, is not installed")


if importlib.util.find_spec("ispc_texcomp") is None:
    sys.modules["ispc_texcomp"] = _MissingEncoder("ispc_texcomp")


FIRST = ("e2e", "view")
"""Folders whose files take longest: begun last, one worker would run on alone."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the slow files where workers share the tests."""
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: item.path.parent.name not in FIRST)


def pytest_collection_finish() -> None:
    """Keep what has been imported and collected out of garbage collection, which would walk it in every large test."""
    gc.collect()
    gc.freeze()
