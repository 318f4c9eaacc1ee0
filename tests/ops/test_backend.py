"""Selection of the best CPU kernels that this CPU can run, or none."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from bitymi_ns import _cpu_features
from bitymi_ns.ops import backend

BUILT = {"_cpu": "fma avx2", "_cpu_x86_64_v4": "fma avx2 avx512f"}

OLD_CPU = """
import sys
from pathlib import Path
read_text = Path.read_text
Path.read_text = lambda path, *words, **options: read_text(
    Path(sys.argv[1]) if str(path) == "/proc/cpuinfo" else path, *words, **options
)
from bitymi_ns.errors import KernelsUnavailable
try:
    import bitymi_ns.ops
except KernelsUnavailable as error:
    print(error)
print([name for name in sys.modules if name.startswith("bitymi_ns._cpu")])
"""


@pytest.fixture
def cpuinfo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A stub of /proc/cpuinfo, with the modules of a wheel."""
    monkeypatch.setattr(backend, "CPUINFO", tmp_path / "cpuinfo")
    monkeypatch.setattr(_cpu_features, "FEATURES", BUILT)
    backend.cpu_module.cache_clear()
    yield tmp_path / "cpuinfo"
    backend.cpu_module.cache_clear()


def test_the_record_is_that_of_the_module() -> None:
    module = backend.module(torch.device("cpu"))
    if Path(module.__file__).parent != Path(_cpu_features.__file__).parent:
        pytest.skip("another build in the place of the installed one (scripts/test_build.py)")
    assert _cpu_features.FEATURES[backend.cpu_module()] == module.CPU_FEATURES


@pytest.mark.slow
@pytest.mark.skipif(not _cpu_features.FEATURES["_cpu"], reason="compiled for every CPU of its kind")
def test_an_old_cpu_gets_a_message_and_nothing_is_loaded(tmp_path: Path) -> None:
    *had, lacked = _cpu_features.FEATURES["_cpu"].split()
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"processor\t: 0\nflags\t\t: fpu sse2 {' '.join(had)}\n\nprocessor\t: 1\n")
    done = subprocess.run([sys.executable, "-c", OLD_CPU, cpuinfo], capture_output=True, text=True, check=True)
    message, loaded = done.stdout.splitlines()
    assert f"compiled for a CPU with {lacked}, which this one lacks: install" in message
    assert loaded == "['bitymi_ns._cpu_features']"


@pytest.mark.parametrize(
    ("flags", "module"), [("fpu fma avx2", "_cpu"), ("fpu fma avx2 avx512f avx512bw", "_cpu_x86_64_v4")]
)
def test_the_last_module_that_the_cpu_can_run_is_taken(cpuinfo: Path, flags: str, module: str) -> None:
    cpuinfo.write_text(f"flags\t\t: {flags}\n")
    assert backend.cpu_module() == module


@pytest.mark.parametrize("text", [None, "processor\t: 0\nFeatures\t: fp asimd\n"], ids=["no file", "no flags"])
def test_where_nothing_is_known_about_the_cpu_the_first_is_taken(cpuinfo: Path, text: str | None) -> None:
    if text is not None:
        cpuinfo.write_text(text)
    assert backend.cpu_module() == "_cpu"
