"""Depth maps are read in threads."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from bitymi_ns.capture.depth_normal_maps import read_array


def test_headers_are_parsed_by_one_thread_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python 3.11's ast.literal_eval can fail in several threads: "AST constructor recursion depth mismatch"."""
    np.save(tmp_path / "depth.npy", np.ones((4, 6), np.float32))
    inside, parse = threading.Lock(), np.lib.format.read_array_header_1_0

    def alone(*given: object) -> object:
        assert inside.acquire(blocking=False), "two threads parse headers"
        time.sleep(0.01)
        found = parse(*given)
        inside.release()
        return found

    monkeypatch.setattr(np.lib.format, "read_array_header_1_0", alone)
    with ThreadPoolExecutor(4) as threads:
        sums = threads.map(lambda _: read_array(tmp_path / "depth.npy", lambda shape: None).sum(), range(8))
        assert set(sums) == {24.0}
