"""Depth maps are read in threads."""

import gc
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from bitymi_ns.capture.maps import read_array


class Cycle:
    """Garbage whose finalizer lets other threads run."""

    def __init__(self) -> None:
        self.own = self

    def __del__(self) -> None:
        sum(range(50))


@pytest.fixture
def many_switches() -> Iterator[None]:
    """Let threads switch, and garbage be collected, as often as they can."""
    interval, threshold = sys.getswitchinterval(), gc.get_threshold()
    sys.setswitchinterval(1e-6)
    gc.set_threshold(5, 2, 2)
    yield
    gc.set_threshold(*threshold)
    sys.setswitchinterval(interval)


def test_headers_are_read_in_several_threads(tmp_path: Path, many_switches: None) -> None:
    np.save(tmp_path / "depth.npy", np.ones((4, 6), np.float32))

    def read(_: int) -> float:
        Cycle()
        return float(read_array(tmp_path / "depth.npy", lambda shape: None).sum())

    with ThreadPoolExecutor(8) as threads:
        assert set(threads.map(read, range(1000))) == {24.0}
