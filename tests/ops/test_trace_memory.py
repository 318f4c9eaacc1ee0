"""Memory of the CPU kernels for a long fragment list, in its own process."""

import os
import sys

import pytest

from tests.ops.test_threads import VIEW, printed

SCRIPT = """
import re

def megabytes(name):
    return int(re.search(name + r":\\s+(\\d+) kB", open("/proc/self/status").read())[1]) / 1024

SIZE = 512
projection = view(SIZE)
trace(view(64))
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
    length, refused, traced, after = printed(VIEW + SCRIPT)
    assert length == 200
    assert refused < 0.3 * length, "a list that is too long is counted, not made"
    assert traced < 1.3 * length, "the kernel's own copy is given back"
    assert after < 0.3 * length
