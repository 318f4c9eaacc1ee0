"""Run tests that take `backend` on all BACKENDS, including a GPU if available."""

from collections.abc import Iterator

import pytest
import torch

from bitymi_ns.measure.stability.errors import BACKENDS, Backend, missing
from tests.required import REQUIRED, skip_without

NAMES = sorted(name for name in BACKENDS if name != "cuda" or torch.cuda.is_available() or "cuda" in REQUIRED)


@pytest.fixture(params=NAMES)
def backend(request: pytest.FixtureRequest) -> Iterator[Backend]:
    chosen = BACKENDS[request.param]
    if why := missing(chosen):
        skip_without(chosen.name, why)
    with chosen.use():
        yield chosen
