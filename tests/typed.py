"""Short names of types that tests take."""

import pytest

Patch, Printed = pytest.MonkeyPatch, pytest.CaptureFixture[str]
