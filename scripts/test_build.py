#!/usr/bin/env python
"""Run tests with another build of the CPU kernels than the installed one: scripts/test_build.py BUILD_FOLDER TEST...

With `--sanitizers`, whose libraries must be preloaded, the script restarts itself."""

import argparse
import importlib.util
import os
import subprocess
import sys
from pathlib import Path

LIBRARIES = ("libasan.so", "libubsan.so", "libstdc++.so")
"""The last one so that the sanitizer intercepts C++ exceptions of libraries loaded later."""


def preload() -> str:
    """Return LD_PRELOAD for the sanitizers."""
    compiler = os.environ.get("CXX", "c++")
    paths = []
    for name in LIBRARIES:
        printed = subprocess.run([compiler, f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        path = Path(printed.stdout.strip())
        if not path.is_absolute():
            sys.exit(f"{compiler} has no {name}: install the compiler's sanitizers")
        paths.append(str(path.resolve()))
    return ":".join(paths)


def main() -> int:
    """Load the build in place of the installed kernels, and run the tests."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("build", type=Path, help="CMake's folder")
    parser.add_argument("tests", nargs="+", help="what pytest is to run")
    parser.add_argument("--sanitizers", action="store_true", help="the build has them")
    options = parser.parse_args()
    if options.sanitizers and "BITYMI_SANITIZED" not in os.environ:
        environment = {
            **os.environ,
            "BITYMI_SANITIZED": "1",
            "LD_PRELOAD": preload(),
            # Python does not free all memory at exit
            "ASAN_OPTIONS": "detect_leaks=0:abort_on_error=0:exitcode=99",
            "UBSAN_OPTIONS": "print_stacktrace=1",
        }
        return subprocess.run([sys.executable, *sys.argv], env=environment, check=False).returncode
    (module,) = options.build.resolve().glob("_cpu.*so")
    spec = importlib.util.spec_from_file_location("bitymi_ns._cpu", module)
    assert spec is not None and spec.loader is not None
    compiled = importlib.util.module_from_spec(spec)
    sys.modules["bitymi_ns._cpu"] = compiled
    spec.loader.exec_module(compiled)
    # the emulated CUDA kernels belong to the installed build, and their fibers confuse the sanitizers
    for name in ("bitymi_ns._emulated", "bitymi_ns._cuda"):
        sys.modules[name] = None  # type: ignore[assignment]

    import pytest

    from bitymi_ns import _cpu

    assert Path(_cpu.__file__) == module, f"{_cpu.__file__} is used instead of {module}"
    print(f"{module}: {_cpu.CPU_FEATURES or 'no extensions of the instruction set'}", flush=True)
    # not captured, as a sanitizer's finding ends the process
    uncaptured = ["-x", "-s"] if options.sanitizers else []
    return pytest.main(["-q", *uncaptured, "-p", "no:cacheprovider", *options.tests])


if __name__ == "__main__":
    sys.exit(main())
