"""Backends that may be missing for users but not in development."""

import os
from typing import NoReturn

import pytest

REQUIRED = os.environ.get("BITYMI_TESTS_REQUIRE", "").split()
"""Names of required backends; `make test` requires the emulated one, which `make setup` builds everywhere."""


def skip_without(name: str, why: str) -> NoReturn:
    """Skip a test for an unavailable backend, or fail it if that is required."""
    if name in REQUIRED:
        pytest.fail(f"the backend {name} is required and cannot be used: {why}", pytrace=False)
    pytest.skip(why)
