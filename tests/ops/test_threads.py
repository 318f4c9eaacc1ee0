"""Idle threads sleep: they take no CPU time between parallel regions."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("bitymi_ns._cpu")

spinning = pytest.mark.skipif(os.cpu_count() == 1, reason="one processor: there are no other threads")

SCRIPT = """
import time, torch
x = torch.rand(200_000)
def cpu_seconds():
    start = time.process_time()
    for _ in range(40):
        x * 2  # a parallel region of torch's, then nothing to do
        time.sleep(0.002)
    return time.process_time() - start
x * 2
before = cpu_seconds()
from bitymi_ns.ops.backend import module
module(torch.device("cpu"))
print(before, cpu_seconds())
"""
IMPORT = """
import os, torch
def threads():
    return len(os.listdir("/proc/self/task"))
before = threads()
import bitymi_ns._cpu
import bitymi_ns.ops
imported = threads()
from bitymi_ns.ops.backend import module
module(torch.device("cpu"))
print(before, imported, threads())
"""


def printed(script: str, **environment: str) -> list[float]:
    """Run a script in a new process; returns the numbers it prints."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("OMP_", "GOMP_"))}
    done = subprocess.run(
        [sys.executable, "-c", script], env={**inherited, **environment}, capture_output=True, text=True, check=True
    )
    return [float(word) for word in done.stdout.split()]


def processor_time(**environment: str) -> tuple[float, float]:
    """Measure the CPU seconds of idling in a new process, before and after kernels are set up."""
    before, after = printed(SCRIPT, **environment)
    return before, after


@spinning
@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted under /proc")
def test_the_import_starts_no_threads() -> None:
    before, imported, ready = printed(IMPORT)
    assert imported == before
    assert ready > imported  # the first kernel does


@spinning
@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted under /proc")
def test_a_process_of_one_thread_stays_one() -> None:
    """Otherwise many such processes on a large machine would have thousands of threads."""
    _, imported, ready = printed(IMPORT, OMP_NUM_THREADS="1")
    assert ready == imported


@spinning
def test_threads_do_not_spin_once_the_kernels_are_ready() -> None:
    before, after = processor_time()
    if before < 0.1:
        pytest.skip("this OpenMP does not spin")
    assert after < 0.5 * before


@spinning
def test_the_users_own_choice_stands() -> None:
    # other programs take processors from spinning threads and give them none: the largest values are the true ones
    rounds = [processor_time(GOMP_SPINCOUNT="300000") for _ in range(3)]
    before, after = map(max, zip(*rounds, strict=True))
    if before < 0.1:
        pytest.skip("this OpenMP does not spin")
    assert after > 0.3 * before
