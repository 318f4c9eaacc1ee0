"""The emulator detects deliberate kernel faults."""

from types import ModuleType

import pytest

from bitymi_ns.ops.backend import load
from tests.cuda.conftest import why_not_emulated
from tests.required import skip_without


@pytest.fixture
def emulated() -> ModuleType:
    if why := why_not_emulated():
        skip_without("emulated", why)
    return load("_emulated")


def test_nothing_is_left_in_shared_memory_by_another_block(emulated: ModuleType) -> None:
    assert emulated.stale_numbers() == 0


def test_a_barrier_that_not_all_threads_reach_is_an_error(emulated: ModuleType) -> None:
    for _ in range(2):  # the emulator stays usable
        with pytest.raises(RuntimeError, match=r"barrier_kernel: threads wait at barriers"):
            emulated.open_barrier()


def test_a_misaligned_vector_is_an_error(emulated: ModuleType) -> None:
    assert emulated.read_float4(0) == 1 and emulated.read_float4(4) == 5
    for offset in (1, 2, 3):
        with pytest.raises(RuntimeError, match=r"emulator_probe\.cpp, line \d+: a misaligned access"):
            emulated.read_float4(offset)
