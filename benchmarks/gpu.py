#!/usr/bin/env python
"""Everything that is measured on a CUDA card, in one call: builds the kernels where they are missing, runs their tests,
then times each section on the device (median after a warm-up) and prints tables.

Each section runs in a process of its own and the page is written again as each ends: a test or a kernel that fails is a
line of the page, and what was measured before it stays.

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
import tempfile
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


def check(limit: float) -> str:
    """Runs tests/cuda on the card: one line about it, and one for each test that failed."""
    say("running tests/cuda on the card")
    command = [sys.executable, "-m", "pytest", "-q", "-rfE", "--no-header", "--tb=line", "tests/cuda"]
    try:
        done = subprocess.run(
            [*command, "-k", "not emulated"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=limit
        )
    except subprocess.TimeoutExpired:
        return f"tests/cuda: not done after {limit:.0f} s"
    lines = (done.stdout + done.stderr).strip().splitlines()
    failed = [f"\n  - {line}" for line in lines if line.startswith(("FAILED", "ERROR"))]
    return f"tests/cuda: {lines[-1].strip('= ')}" + "".join(failed)


def card(device: torch.device) -> list[str]:
    """The card, its clocks and what drives it."""
    if device.type != "cuda":
        return ["No card: kernels emulated on the host, times mean nothing."]
    properties = torch.cuda.get_device_properties(device)
    query = ["nvidia-smi", "--query-gpu=driver_version,clocks.sm,clocks.mem,clocks.max.sm,power.limit,temperature.gpu"]
    try:
        asked = subprocess.run([*query, "--format=csv,noheader"], capture_output=True, text=True, check=False).stdout
    except OSError:
        asked = ""
    return [
        f"{properties.name}, {properties.multi_processor_count} multiprocessors, "
        f"{properties.total_memory / 2**30:.0f} GiB, compute capability {properties.major}.{properties.minor}; "
        f"torch {torch.__version__}, CUDA {torch.version.cuda}.",
        f"Driver, clocks now (SM, memory), highest, power limit, temperature: {asked.strip() or 'not known'}.",
    ]


def section_of_page(name: str, arguments: argparse.Namespace, folder: Path) -> str:
    """One section in a process of its own: its Markdown, or a line that says how it ended."""
    output = folder / f"{name}.md"
    command = [sys.executable, *sys.argv, "--only", name, "--output", str(output)]
    try:
        done = subprocess.run(command, check=False, timeout=arguments.limit)
        ended = f"ended with status {done.returncode}"
    except subprocess.TimeoutExpired:
        ended = f"was stopped after {arguments.limit:.0f} s"
    text = output.read_text("utf8") if output.exists() else f"### {name}\n"
    return text if ended.endswith("status 0") else f"{text}\n\nThe section {name} {ended}."


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
    parser.add_argument(
        "--limit", type=float, default=600, help="seconds for the tests and for a section (%(default)s)"
    )
    parser.add_argument("--no-check", action="store_true", help="leave the tests out")
    parser.add_argument("--no-peers", action="store_true", help="leave gsplat out")
    parser.add_argument("--emulated", action="store_true", help="try the script without a card")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file, anew as each section ends")
    parser.add_argument("--only", help=argparse.SUPPRESS)
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
    by_name = {section.name: section for section in sections}
    if unknown := set(arguments.sections or ()) - set(by_name):
        parser.error(f"no section {', '.join(sorted(unknown))}: there are {', '.join(by_name)}")
    device = torch.device("cpu" if arguments.emulated else "cuda")

    with emulated_cuda() if arguments.emulated else nullcontext():
        bandwidth = copy_bandwidth(device)
        if arguments.only:
            if arguments.emulated:
                surfels, sizes, warm_up, runs = [60], [(40, 24)], 0, 1
            else:
                surfels, warm_up, runs = arguments.surfels, arguments.warm_up, arguments.runs
                sizes = [tuple(int(part) for part in size.split("x")) for size in arguments.sizes]
            peers = not arguments.no_peers
            options = Options(device, surfels, sizes, warm_up, runs, bandwidth, arguments.bundles, peers)
            arguments.output.write_text(by_name[arguments.only].run(options), "utf8")
            return 0

        notes = card(device)
        if not (arguments.no_check or arguments.emulated):
            notes.append(check(arguments.limit))
        notes.append(f"Copy within the device: {number(bandwidth / 1e9, 0)} GB/s, read and written bytes counted.")
        notes.append(
            f"Times: medians of about {arguments.runs} calls after {arguments.warm_up}, queued so that the host does "
            "not hold the device up, unless a column says otherwise."
        )
        parts: list[str] = []
        with tempfile.TemporaryDirectory() as folder:
            for section in sections:
                if arguments.sections and section.name not in arguments.sections:
                    continue
                if lacking := missing(section.needs, device):
                    notes.append(f"Section {section.name} left out: this build has no {', '.join(lacking)}.")
                    continue
                parts.append(section_of_page(section.name, arguments, Path(folder)))
                text = page("CUDA kernels", "\n\n".join(parts), notes)
                if arguments.output is not None:
                    publish(text, arguments.output, silent=True)
    publish(page("CUDA kernels", "\n\n".join(parts), notes), arguments.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
