"""Run every test on the CUDA kernels: emulated on the host, and on a GPU if there is one."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch

from bitymi_ns.ops import backend
from bitymi_ns.ops.backend import emulated_cuda
from tests.required import REQUIRED, skip_without


def why_not_on_a_card() -> str | None:
    """Explain why tests cannot run on a GPU, None if they can."""
    if not torch.cuda.is_available():
        return "no CUDA device (or torch without CUDA)"
    try:
        from bitymi_ns import _cuda  # noqa: F401
    except ImportError as error:
        return f"bitymi_ns._cuda is not built: {error}"
    return None


def why_not_emulated() -> str | None:
    """Explain why tests cannot run in emulation, None if they can."""
    try:
        from bitymi_ns import _emulated  # noqa: F401
    except ImportError:
        return "built without BITYMI_EMULATED_CUDA"
    return None


CARD = ["card"] if torch.cuda.is_available() or "card" in REQUIRED else []


@pytest.fixture(params=["emulated", *CARD])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """Yield a device whose tensors go to the CUDA kernels."""
    reason = why_not_emulated() if request.param == "emulated" else why_not_on_a_card()
    if reason:
        skip_without(request.param, reason)
    if request.param == "card":
        yield torch.device("cuda")
    else:
        with emulated_cuda(seed=1):
            yield torch.device("cpu")


@pytest.fixture
def cpu():
    """Return a context in which CPU tensors go to the CPU kernels although `device` is emulated."""

    @contextmanager
    def context() -> Iterator[None]:
        before, backend._emulated = backend._emulated, False
        try:
            yield
        finally:
            backend._emulated = before

    return context


@pytest.fixture
def exactly() -> Iterator[None]:
    """Ask torch for deterministic algorithms."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
