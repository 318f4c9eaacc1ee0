#!/usr/bin/env python
"""Runs tests with the sanitized build of the CPU kernels: scripts/sanitize.py BUILD_FOLDER TEST...

The sanitizers' libraries have to be in the process before Python is, so this starts itself again with them.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

LIBRARIES = ("libasan.so", "libubsan.so")


def preload() -> str:
    """Paths of the sanitizers' libraries of the compiler that is used."""
    compiler = os.environ.get("CXX", "c++")
    paths = []
    for name in LIBRARIES:
        found = subprocess.run([compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        path = Path(found.stdout.strip())
        if not path.is_absolute():
            sys.exit(f"{compiler} has no {name}: install the sanitizers of the compiler (gcc brings them)")
        paths.append(str(path.resolve()))
    # the sanitizer catches C++ exceptions of libraries that are loaded later only if this is there first
    stdcpp = subprocess.run([compiler, "-print-file-name=libstdc++.so"], capture_output=True, text=True, check=True)
    return ":".join([*paths, str(Path(stdcpp.stdout.strip()).resolve())])


def main() -> int:
    """Command line."""
    build, *tests = sys.argv[1:]
    if "BITYMI_SANITIZED" not in os.environ:
        environment = {
            **os.environ,
            "BITYMI_SANITIZED": "1",
            "LD_PRELOAD": preload(),
            # Python itself frees little at its end
            "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:exitcode=99",
            "UBSAN_OPTIONS": "print_stacktrace=1",
        }
        return subprocess.run([sys.executable, *sys.argv], env=environment, check=False).returncode
    (module,) = Path(build).resolve().glob("_cpu*.so")
    spec = importlib.util.spec_from_file_location("bitymi_ns._cpu", module)
    assert spec is not None and spec.loader is not None
    compiled = importlib.util.module_from_spec(spec)
    sys.modules["bitymi_ns._cpu"] = compiled
    spec.loader.exec_module(compiled)
    # The CUDA kernels on the host are not built with the sanitizers, and their fibers confuse them: left out.
    for name in ("bitymi_ns._emulated", "bitymi_ns._cuda"):
        sys.modules[name] = None  # type: ignore[assignment]

    import pytest

    from bitymi_ns import _cpu

    assert Path(_cpu.__file__) == module, f"{_cpu.__file__} is used instead of the sanitized module"
    # uncaptured: a finding ends the process and would take its report along
    return pytest.main(["-q", "-x", "-s", "-p", "no:cacheprovider", *tests])


if __name__ == "__main__":
    sys.exit(main())
