"""What may be missing on a user's machine and not where changes are tested."""

import os
from typing import NoReturn

import pytest

REQUIRED = os.environ.get("BITYMI_TESTS_REQUIRE", "").split()
"""Names of backends; `make test` requires the emulated one, which `make setup` builds everywhere."""


def skip_without(name: str, why: str) -> NoReturn:
    """Skip a test for a backend that cannot be used; fail it where that is required."""
    if name in REQUIRED:
        pytest.fail(f"the backend {name} is required and cannot be used: {why}", pytrace=False)
    pytest.skip(why)
