"""A WebGPU device, possibly a software adapter."""

import pytest

from bitymi_ns.ops import webgpu
from tests.required import skip_without


@pytest.fixture(autouse=True, scope="session")
def device() -> None:
    """Skip tests without a WebGPU device."""
    try:
        webgpu.device.device()
    except webgpu.WebGpuUnavailable as error:
        skip_without("webgpu", str(error))
