"""A graphics device that draws, be it one in software."""

import pytest

from bitymi_ns.ops import webgpu
from tests.required import skip_without


@pytest.fixture(autouse=True, scope="session")
def device() -> None:
    """Skips where nothing can be drawn through WebGPU."""
    try:
        webgpu.device.device()
    except webgpu.WebGpuUnavailable as error:
        skip_without("webgpu", str(error))
