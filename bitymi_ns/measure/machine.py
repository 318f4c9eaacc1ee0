"""Machine, versions and commit of measured figures."""

import functools
import importlib.metadata
import os
import platform
import subprocess
from contextlib import suppress
from pathlib import Path

import psutil


def output(command: list[str], where: Path | None = None) -> str:
    """Run a command and return its standard output; empty if it fails."""
    try:
        result = subprocess.run(command, cwd=where, capture_output=True, text=True, check=False, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return result.stdout.strip() if result.returncode == 0 else ""


@functools.cache
def commit() -> str:
    """Return the checkout's commit, with `+` if the tree is dirty; empty outside a checkout."""
    where = Path(__file__).resolve().parents[2]
    if not (where / ".git").exists():
        return ""
    return output(["git", "describe", "--always", "--dirty=+", "--exclude=*"], where)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect results."""
    installed = {"python": platform.python_version()}
    for name in ("bitymi-ns", "torch", "nerfstudio"):
        with suppress(importlib.metadata.PackageNotFoundError):
            installed[name] = importlib.metadata.version(name)
    return installed


@functools.cache
def processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text("utf8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


@functools.cache
def machine() -> str:
    """Describe the machine in one line: processor, cores, memory, GPUs, and the limit on threads."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = psutil.virtual_memory().total / 2**30
    names = output(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]).splitlines()
    gpus = f", {len(names)} x {names[0]}" if names else ""
    threads = os.environ.get("OMP_NUM_THREADS")
    limit = f", OMP_NUM_THREADS={threads}" if threads else ""
    return f"{processor()}, {cores} cores, {memory:.0f} GiB{gpus}{limit}"
