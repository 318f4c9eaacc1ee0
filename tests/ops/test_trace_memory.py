"""Memory of the CPU kernels for a long fragment list, in its own process."""

import os
import subprocess
import sys

import pytest

SCRIPT = """
import re
import torch
from bitymi_ns.ops import TooManyFragments, project, trace
from bitymi_ns.scene import Camera

def megabytes(name):
    return int(re.search(name + r":\\s+(\\d+) kB", open("/proc/self/status").read())[1]) / 1024

N, SIZE = 40, 512  # forty faint discs, each larger than the picture
means = torch.zeros(N, 3)
means[:, 2] = torch.linspace(3, 4, N)
quats = torch.tensor([1.0, 0, 0, 0]).repeat(N, 1)
surfels = (means, quats, torch.full((N, 2), 2.0), torch.full((N,), -3.0), torch.zeros(N))
camera = Camera(torch.eye(4), torch.tensor([[512.0, 0, 256], [0, 512, 256], [0, 0, 1]]), SIZE, SIZE)
projection = project(*surfels, camera, 0.2)
trace(project(*surfels, Camera(camera.viewmat, camera.K, 64, 64), 0.2))
start = megabytes("VmRSS")
try:
    trace(projection, most=1000)
except TooManyFragments as error:
    count = error.count
refused = megabytes("VmHWM")
fragments = trace(projection)
assert len(fragments) == count == N * SIZE * SIZE, (len(fragments), count)
traced = megabytes("VmRSS")
fragments = None
print(20 * count / 2**20, refused - start, traced - start, megabytes("VmRSS") - start)
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.skipif("BITYMI_SANITIZED" in os.environ, reason="the sanitizer keeps memory that was given back")
def test_fragments_that_are_not_wanted_take_no_memory() -> None:
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    length, refused, traced, after = (float(value) for value in done.stdout.split())
    assert length == 200
    assert refused < 0.3 * length, "a list that is too long is counted, not made"
    assert traced < 1.3 * length, "the kernel's own copy is given back"
    assert after < 0.3 * length
