"""Every test that takes `backend` runs on all of them; a new one is one entry of BACKENDS."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bitymi_ns.measure.stability.errors import BACKENDS, Backend, missing
from tests.required import skip_without


@pytest.fixture(params=sorted(BACKENDS))
def backend(request: pytest.FixtureRequest) -> Iterator[Backend]:
    chosen = BACKENDS[request.param]
    if why := missing(chosen):
        skip_without(chosen.name, why)
    with chosen.use():
        yield chosen
