"""The kernels are not loaded on a CPU that lacks what they were compiled for."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bitymi_ns import _cpu, _cpu_features
from bitymi_ns.ops import backend

needs_features = pytest.mark.skipif(not _cpu_features.FEATURES, reason="compiled for every CPU of its kind")

OLD_CPU = """
import sys
from pathlib import Path
import torch
from bitymi_ns.ops import backend
backend.CPUINFO = Path(sys.argv[1])
try:
    backend.module(torch.device("cpu"))
except RuntimeError as error:
    print(error)
print("bitymi_ns._cpu" in sys.modules)
"""


@pytest.fixture
def cpuinfo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """What stands for /proc/cpuinfo."""
    monkeypatch.setattr(backend, "CPUINFO", tmp_path / "cpuinfo")
    backend.why_not_cpu.cache_clear()
    yield tmp_path / "cpuinfo"
    backend.why_not_cpu.cache_clear()


def test_the_record_is_that_of_the_module() -> None:
    assert _cpu_features.FEATURES == _cpu.FEATURES


@needs_features
def test_an_old_cpu_gets_a_message_before_the_module_is_loaded(cpuinfo: Path) -> None:
    had, lacked = _cpu_features.FEATURES.split()[:-1], _cpu_features.FEATURES.split()[-1]
    cpuinfo.write_text(f"processor\t: 0\nflags\t\t: fpu sse2 {' '.join(had)}\n\nprocessor\t: 1\n")
    command = [sys.executable, "-c", OLD_CPU, str(cpuinfo)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    message, loaded = done.stdout.splitlines()
    assert f"compiled for a CPU with {lacked}, which this one lacks: install" in message and loaded == "False"


def test_this_cpu_is_accepted(cpuinfo: Path) -> None:
    cpuinfo.write_text(f"flags\t\t: fpu {_cpu_features.FEATURES}\n")
    assert backend.why_not_cpu() is None


@pytest.mark.parametrize("text", [None, "processor\t: 0\nFeatures\t: fp asimd\n"], ids=["no file", "no flags"])
def test_what_cannot_be_known_is_no_reason(cpuinfo: Path, text: str | None) -> None:
    if text is not None:
        cpuinfo.write_text(text)
    assert backend.why_not_cpu() is None
