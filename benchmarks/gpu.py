#!/usr/bin/env python
"""Time the CUDA kernels on a card, section by section (median after a warm-up), and print tables.

Needs the core packages alone (torch, numpy); nerfstudio is not used. gsplat is timed beside ours where it can be
imported. `--emulated` runs the host's emulation of the kernels on tiny scenes, to try the script without a card; its
times mean nothing.
"""

import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import gpu_baked
import gpu_operations
import torch
from common import arguments_of, number, page, publish
from harness import Options, copy_bandwidth

from bitymi_ns.ops.backend import emulated_cuda

SECTIONS = {"baked": gpu_baked.frames, "operations": gpu_operations.operations, "steps": gpu_operations.steps}


def card(device: torch.device) -> list[str]:
    """The card, its clocks and its driver."""
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


def main() -> int:
    """Command line."""
    parser = arguments_of(__doc__)
    parser.add_argument("--surfels", nargs="+", type=int, default=[50_000, 150_000, 500_000], help="of the scenes")
    parser.add_argument("--sizes", nargs="+", default=["1297x840", "1920x1080"], metavar="WxH", help="(%(default)s)")
    parser.add_argument("--bundles", nargs="+", type=Path, default=[], help="baked scenes to draw as well")
    parser.add_argument("--warm-up", type=int, default=10)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--sections", nargs="+", choices=list(SECTIONS), default=list(SECTIONS))
    parser.add_argument("--no-peers", action="store_true", help="leave gsplat out")
    parser.add_argument("--emulated", action="store_true", help="try the script without a card")
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file, anew as each section ends")
    arguments = parser.parse_args()
    if not (arguments.emulated or torch.cuda.is_available()):
        parser.error("no CUDA device was found (or torch is a CPU build); --emulated tries the script without")
    device = torch.device("cpu" if arguments.emulated else "cuda")
    surfels, sizes = arguments.surfels, [tuple(int(part) for part in size.split("x")) for size in arguments.sizes]
    warm_up, runs = arguments.warm_up, arguments.runs
    if arguments.emulated:
        surfels, sizes, warm_up, runs = [60], [(40, 24)], 0, 1
    parts: list[str] = []
    with emulated_cuda() if arguments.emulated else nullcontext():
        bandwidth = copy_bandwidth(device)
        notes = [
            *card(device),
            f"Copy within the device: {number(bandwidth / 1e9, 0)} GB/s, read and written bytes counted.",
            f"Times: medians of about {runs} calls after {warm_up}, queued so that the host does not hold the device "
            "up, unless a column says otherwise.",
        ]
        options = Options(device, warm_up, runs, surfels, sizes, bandwidth, arguments.bundles, not arguments.no_peers)
        for name in arguments.sections:
            parts.append(SECTIONS[name](options))
            publish(page("CUDA kernels", "\n\n".join(parts), notes), arguments.output, name != arguments.sections[-1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
