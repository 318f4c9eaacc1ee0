#!/usr/bin/env python
"""Measure times: `times.py COMMAND OPTION...`; `times.py COMMAND --help` lists the options.

kernels      each CPU kernel
frames       frames of baked scenes on a GPU
cuda         CUDA kernels: each once, for sanitizers, or its time
peers        gsplat beside bundles of a capture on a GPU
nerfstudio   nerfstudio's commands on a capture, with a GPU or without
"""

import sys
from importlib import import_module

MODULES = {"kernels": "kernels", "frames": "gpu_frames", "cuda": "gpu_kernels"}
MODULES |= {"peers": "gpu_peers", "nerfstudio": "gpu_nerfstudio"}


def main() -> int:
    """Run the command that the command line names."""
    command, *words = sys.argv[1:] or [""]
    if command not in MODULES:
        print(__doc__)
        return 0 if command in ("-h", "--help") else 2
    module = import_module(MODULES[command])  # lazily: `kernels` sets a variable that torch reads when it loads
    from harness import Arguments

    return module.main(Arguments(module.__doc__, f"times.py {command}"), words) or 0


if __name__ == "__main__":
    sys.exit(main())
