#!/usr/bin/env python
"""Everything that is measured on a CUDA card, in one call: builds the kernels where they are missing, runs their tests,
then times each section with CUDA events (median after a warm-up) and prints tables.

Needs the core packages alone (torch, numpy; to build: nanobind, scikit-build-core, cmake, ninja, nvcc); nerfstudio is
not used. gsplat is timed beside ours where it can be imported. `--emulated` runs the script on the host's emulation of
the kernels with tiny scenes, to try it without a card; its times mean nothing.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import torch
from common import number, page, publish, say

ROOT = Path(__file__).resolve().parent.parent
BUILT = "BITYMI_BENCHMARK_BUILT"
"""Set in the environment once this script has built the kernels."""


def build() -> None:
    """Compiles and installs the package where it has no CUDA kernels, then starts this script anew: only a Python that
    starts after an installation finds what it installed.

    Raises:
        SystemExit: that failed, or the kernels are still missing.
    """
    if importlib.util.find_spec("bitymi_ns") and importlib.util.find_spec("bitymi_ns._cuda"):
        return
    if os.environ.get(BUILT):
        sys.exit("the build ended well and left no CUDA kernels: is nvcc on PATH?")
    start = time.perf_counter()
    say("building the CUDA kernels")
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-build-isolation", "--no-deps", "-e", str(ROOT)]
    done = subprocess.run([*command, "-Ccmake.define.BITYMI_CUDA=ON"], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"the build failed:\n{(done.stdout + done.stderr)[-4000:]}")
    say(f"built in {time.perf_counter() - start:.0f} s")
    os.environ[BUILT] = "1"
    os.execv(sys.executable, [sys.executable, *sys.argv])


def check() -> str:
    """Runs tests/cuda on the card; one line about it.

    Raises:
        SystemExit: a test failed.
    """
    say("running tests/cuda on the card")
    command = [sys.executable, "-m", "pytest", "-q", "-rN", "--no-header", "tests/cuda", "-k", "not emulated"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    lines = done.stdout.strip().splitlines()
    if done.returncode:
        sys.exit("\n".join(lines[-60:]) + done.stderr[-2000:])
    return lines[-1].strip("= ")


def card(device: torch.device) -> str:
    """The card, its driver's and torch's CUDA versions."""
    if device.type != "cuda":
        return "no card: kernels emulated on the host"
    properties = torch.cuda.get_device_properties(device)
    memory = properties.total_memory / 2**30
    return (
        f"{properties.name}, {properties.multi_processor_count} multiprocessors, {memory:.0f} GiB, "
        f"compute capability {properties.major}.{properties.minor}, CUDA {torch.version.cuda}"
    )


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument(
        "--surfels", nargs="+", type=int, default=[50_000, 150_000, 500_000], help="sizes of the scenes"
    )
    parser.add_argument(
        "--sizes", nargs="+", default=["1297x840", "1920x1080"], metavar="WxH", help="image sizes (%(default)s)"
    )
    parser.add_argument("--bundles", nargs="+", type=Path, default=[], help="baked scenes to draw as well")
    parser.add_argument("--warm-up", type=int, default=10)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--sections", nargs="+", help="those alone, by name")
    parser.add_argument("--no-check", action="store_true", help="leave the tests out")
    parser.add_argument("--emulated", action="store_true", help="try the script without a card")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")
    arguments = parser.parse_args()

    if not arguments.emulated:
        if not torch.cuda.is_available():
            parser.error("no CUDA device is to be seen (or torch is a CPU build); --emulated tries the script without")
        build()
    import gpu_appearance
    import gpu_baked
    import gpu_training
    from gpu_common import Options, Section, copy_bandwidth, missing

    from bitymi_ns.ops.backend import emulated_cuda

    sections: tuple[Section, ...] = (*gpu_baked.SECTIONS, *gpu_training.SECTIONS, *gpu_appearance.SECTIONS)
    names = [section.name for section in sections]
    if unknown := set(arguments.sections or ()) - set(names):
        parser.error(f"no section {', '.join(sorted(unknown))}: there are {', '.join(names)}")
    device = torch.device("cpu" if arguments.emulated else "cuda")
    if arguments.emulated:
        surfels, sizes, warm_up, runs = [60], [(40, 24)], 0, 1
    else:
        surfels, warm_up, runs = arguments.surfels, arguments.warm_up, arguments.runs
        sizes = [tuple(int(part) for part in size.split("x")) for size in arguments.sizes]

    with emulated_cuda() if arguments.emulated else nullcontext():
        notes = [card(device)]
        if not (arguments.no_check or arguments.emulated):
            notes.append(f"tests/cuda: {check()}")
        bandwidth = copy_bandwidth(device)
        notes.append(f"Copy within the device: {number(bandwidth / 1e9, 0)} GB/s, read and written bytes counted.")
        notes.append(f"Times: median of {runs} runs after {warm_up}, between CUDA events, launches included.")
        options = Options(device, surfels, sizes, warm_up, runs, bandwidth, arguments.bundles)
        parts = []
        for section in sections:
            if arguments.sections and section.name not in arguments.sections:
                continue
            if lacking := missing(section.needs, device):
                notes.append(f"Section {section.name} left out: this build has no {', '.join(lacking)}.")
                continue
            parts.append(section.run(options))
    publish(page("CUDA kernels", "\n\n".join(parts), notes), arguments.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
