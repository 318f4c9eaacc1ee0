#!/usr/bin/env python
"""What opening a bundle takes, in a process that does nothing else, as a line of JSON.

load_ms  CPU milliseconds, least of three, files in the system's cache
peak_mb  most memory while it is loaded, above what the process had before; kept_mb: what it keeps. 10^6 bytes
"""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from pathlib import Path

import torch
from common import cpu_milliseconds

from bitymi_ns.bundle import read_bundle


def memory(name: str) -> float:
    """A line of the system's status of this process, MB."""
    status = Path("/proc/self/status").read_text("ascii")
    line = next(line for line in status.splitlines() if line.startswith(name))
    return int(line.split()[1]) * 1024 / 1e6


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bundle", type=Path, help="folder or file")
    folder = parser.parse_args().bundle
    torch.set_num_threads(1)
    before = memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", "ascii")  # the peak starts here
    bundle = read_bundle(folder)
    peak, after = memory("VmHWM") - before, memory("VmRSS") - before
    del bundle
    _, milliseconds = cpu_milliseconds(partial(read_bundle, folder), 3)
    print(json.dumps({"load_ms": milliseconds, "peak_mb": peak, "kept_mb": after}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
