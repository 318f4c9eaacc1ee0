"""Provenance of measured figures: machine, versions, commit."""

import functools
import importlib.metadata
import os
import platform
import shutil
import subprocess
from pathlib import Path


def output(command: list[str], where: Path | None = None) -> str:
    """Run a command and return its standard output; empty if it fails."""
    try:
        result = subprocess.run(command, cwd=where, capture_output=True, text=True, check=False, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return result.stdout.strip() if result.returncode == 0 else ""


@functools.cache
def commit() -> str:
    """Return the checkout's commit, with `+` if the tree is dirty; empty outside a checkout of this project."""
    where = Path(__file__).resolve().parents[2]
    if not (where / ".git").exists():
        return ""
    return output(["git", "describe", "--always", "--dirty=+", "--exclude=*"], where)


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def gpus() -> list[str]:
    """List the names of the NVIDIA GPUs, as the driver reports them."""
    if shutil.which("nvidia-smi") is None:
        return []
    return output(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]).splitlines()


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that affect results."""
    found = {"python": platform.python_version()}
    for name in ("bitymi-ns", "torch", "nerfstudio"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


@functools.cache
def processor() -> str:
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text("utf8").splitlines()
    except OSError:
        return model
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)


@functools.cache
def machine() -> str:
    """Describe the machine in one line: processor, cores, memory, GPUs, and the limit on threads."""
    memory = ""
    try:
        memory = f", {os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"
    except (OSError, ValueError):
        pass
    names = gpus()
    cards = f", {len(names)} x {names[0]}" if names else ""
    threads = os.environ.get("OMP_NUM_THREADS")
    limit = f", OMP_NUM_THREADS={threads}" if threads else ""
    return f"{processor()}, {cores()} cores{memory}{cards}{limit}"


def software() -> str:
    return ", ".join(f"{name} {version}" for name, version in versions().items())
