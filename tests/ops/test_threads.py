"""Idle threads sleep: they take no CPU time between parallel regions."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("bitymi_ns._cpu")

pytestmark = pytest.mark.slow
spinning = pytest.mark.skipif(os.cpu_count() == 1, reason="one processor: there are no other threads")
counted = pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted under /proc")

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
        [sys.executable, "-c", script],
        env={**inherited, **environment},
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return [float(word) for word in done.stdout.split()]


@spinning
@counted
def test_the_import_starts_no_threads() -> None:
    before, imported, ready = printed(IMPORT)
    assert imported == before
    assert ready > imported  # the first kernel does


@spinning
@counted
def test_a_process_of_one_thread_stays_one() -> None:
    """Otherwise many such processes on a large machine would have thousands of threads."""
    _, imported, ready = printed(IMPORT, OMP_NUM_THREADS="1")
    assert ready == imported


@spinning
def test_threads_do_not_spin_once_the_kernels_are_ready() -> None:
    before, after = printed(SCRIPT)
    if before < 0.1:
        pytest.skip("this OpenMP does not spin")
    assert after < 0.5 * before


@spinning
def test_the_users_own_choice_stands() -> None:
    # other programs take processors from spinning threads and give them none: the largest values are the true ones
    rounds = [printed(SCRIPT, GOMP_SPINCOUNT="300000") for _ in range(3)]
    before, after = map(max, zip(*rounds, strict=True))
    if before < 0.1:
        pytest.skip("this OpenMP does not spin")
    assert after > 0.3 * before


VIEW = """
import torch
from bitymi_ns.ops import TooManyFragments, project, trace
from bitymi_ns.scene import Camera

def view(size):
    return project(*surfels, Camera(torch.eye(4), torch.tensor([[512.0, 0, size / 2], [0, 512, size / 2], [0, 0, 1]]),
                                    size, size), 0.2)

N = 40  # faint discs, each larger than the picture
means = torch.zeros(N, 3)
means[:, 2] = torch.linspace(3, 4, N)
surfels = (means, torch.tensor([1.0, 0, 0, 0]).repeat(N, 1), torch.full((N, 2), 2.0), torch.full((N,), -3.0),
           torch.zeros(N))
"""
FAILS = """
import resource
small = view(64)
trace(small)
large = view(1024)
use = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (use + (200 << 20), resource.RLIM_INFINITY))
failed = 0
for _ in range(3):
    try:
        trace(large)
    except MemoryError:
        failed += 1
resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)
print(failed, int(len(trace(small)) == N * 64 * 64))
"""
FORKED = """
import multiprocessing, torch
from bitymi_ns.ops import project
from bitymi_ns.scene import Camera
camera = Camera(torch.eye(4), torch.tensor([[64.0, 0, 32], [0, 64, 32], [0, 0, 1]]), 64, 64)
N = 20000
surfels = (torch.rand(N, 3) + 2, torch.rand(N, 4), torch.zeros(N, 2), torch.zeros(N), torch.zeros(N))

class Drawn(torch.utils.data.Dataset):
    def __len__(self):
        return 2
    def __getitem__(self, i):
        return project(*surfels, camera, 0.2).geom[::50].sum()  # torch's own threads do not outlive a fork

def child(queue):
    queue.put(float(Drawn()[0]))

want = float(Drawn()[0])
context = multiprocessing.get_context("fork")
queue = context.Queue()
process = context.Process(target=child, args=(queue,))
process.start()
got = queue.get(timeout=60)
process.join()
loaded = [float(x) for x in torch.utils.data.DataLoader(Drawn(), num_workers=2, timeout=60)]
print(*(int(abs(each / want - 1) < 1e-5) for each in (got, *loaded)))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits its address space")
@pytest.mark.skipif("BITYMI_SANITIZED" in os.environ, reason="the sanitizer ends the process")
@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_kernel_without_memory_raises_and_releases_its_threads(threads: str) -> None:
    assert printed(VIEW + FAILS, OMP_NUM_THREADS=threads) == [3, 1]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_forked_processes_draw_with_one_thread() -> None:
    assert printed(FORKED, OMP_NUM_THREADS="2") == [1, 1, 1]
