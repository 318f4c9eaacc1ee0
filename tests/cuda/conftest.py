"""Run every test on the CUDA kernels: emulated on the host, and on a GPU if there is one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from typing import TypeVar

import pytest
import torch

from bitymi_ns.ops import backend, trace_cuda
from bitymi_ns.ops.backend import emulated_cuda
from tests.required import REQUIRED, skip_without


def why_not_on_a_card() -> str | None:
    """Explain why tests cannot run on a GPU, None if they can."""
    if not torch.cuda.is_available():
        return "no CUDA device (or torch without CUDA)"
    return None if find_spec("bitymi_ns._cuda") else "bitymi_ns._cuda is not built"


def why_not_emulated() -> str | None:
    """Explain why tests cannot run in emulation, None if they can."""
    return None if find_spec("bitymi_ns._emulated") else "built without BITYMI_EMULATED_CUDA"


HERE = torch.device("cpu")
T = TypeVar("T")
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
def both(device: torch.device, cpu):
    """Return a function that calls another for `device`, then for the CPU and its kernels."""

    def call(of: Callable[[torch.device], T]) -> tuple[T, T]:
        got = of(device)
        with cpu():
            return got, of(HERE)

    return call


def in_orders(device: torch.device, of: Callable[[], T], count: int = 4) -> list[T]:
    """Call a function several times, in emulation with another order of threads each time."""
    results = []
    for seed in range(count):
        with emulated_cuda(seed) if device == HERE else nullcontext():
            results.append(of())
    return results


def only_short_lists(monkeypatch: pytest.MonkeyPatch, fit: int, capacity: int) -> None:
    """Let lists longer than `fit` find no memory, although there seems to be room for `capacity` fragments."""
    empty_list = trace_cuda.empty_list

    def short_ones(geom: torch.Tensor, count: int) -> dict[str, torch.Tensor]:
        if count > fit:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory")
        return empty_list(geom, count)

    monkeypatch.setattr(trace_cuda, "empty_list", short_ones)
    monkeypatch.setattr(trace_cuda, "fragment_capacity", lambda geom: capacity)


@pytest.fixture
def exactly() -> Iterator[None]:
    """Ask torch for deterministic algorithms."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
