"""CMake's detection of the machine: CPU and GPU architectures to compile for."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BIN = Path(sys.executable).parent
CMAKE, NINJA = (shutil.which(name, path=BIN) or shutil.which(name) for name in ("cmake", "ninja"))

pytestmark = pytest.mark.skipif(not (CMAKE and NINJA), reason="cmake or ninja is not installed")


def configure(folder: Path, **definitions: str) -> str:
    definitions = {"Python_EXECUTABLE": sys.executable, "CMAKE_MAKE_PROGRAM": str(NINJA), **definitions}
    options = [f"-D{name}={value}" for name, value in definitions.items()]
    command = [str(CMAKE), "-S", str(ROOT), "-B", str(folder), "-G", "Ninja", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def cpu_features(folder: Path) -> dict[str, set[str]]:
    """Read from a build folder which CPU features each module needs."""
    names: dict[str, dict[str, str]] = {}
    exec((folder / "_cpu_features.py").read_text("utf8"), names)
    return {name: set(features.split()) for name, features in names["FEATURES"].items()}


def march(folder: Path) -> set[str]:
    """List the CPUs that a build folder's files are compiled for."""
    words = (folder / "compile_commands.json").read_text("utf8").split()
    return {word.removeprefix("-march=") for word in words if word.startswith("-march=")}


@pytest.fixture(scope="module")
def x86() -> None:
    if "x86_64" not in subprocess.run(["uname", "-m"], capture_output=True, text=True, check=True).stdout:
        pytest.skip("not an x86-64 machine")


AVX2 = set("pni ssse3 sse4_1 sse4_2 popcnt abm movbe bmi1 bmi2 f16c fma avx avx2".split())
AVX512 = AVX2 | {"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"}


def test_a_wheel_has_kernels_for_avx2_and_for_avx512(x86: None, tmp_path: Path) -> None:
    configure(tmp_path, SKBUILD_STATE="wheel", BITYMI_CUDA="OFF")
    assert march(tmp_path) == {"x86-64-v3", "x86-64-v4"}
    assert cpu_features(tmp_path) == {"_cpu": AVX2, "_cpu_x86_64_v4": AVX512}


def test_in_place_the_kernels_are_compiled_for_this_cpu(x86: None, tmp_path: Path) -> None:
    configure(tmp_path, SKBUILD_STATE="editable", BITYMI_CUDA="OFF")
    flags = next(line for line in Path("/proc/cpuinfo").read_text("utf8").splitlines() if line.startswith("flags"))
    features = cpu_features(tmp_path)
    assert march(tmp_path) == {"native"} and features.keys() == {"_cpu"}
    assert features["_cpu"] and features["_cpu"] <= set(flags.split())


def test_the_cpu_can_be_chosen(x86: None, tmp_path: Path) -> None:
    configure(tmp_path, SKBUILD_STATE="wheel", BITYMI_CUDA="OFF", BITYMI_MARCH="x86-64")
    assert march(tmp_path) == {"x86-64"} and cpu_features(tmp_path) == {"_cpu": set()}


def test_other_processors_get_the_compilers_default(tmp_path: Path) -> None:
    processor = {"CMAKE_SYSTEM_NAME": "Linux", "CMAKE_SYSTEM_PROCESSOR": "aarch64"}
    configure(tmp_path, SKBUILD_STATE="wheel", BITYMI_CUDA="OFF", **processor)
    assert march(tmp_path) == set() and cpu_features(tmp_path).keys() == {"_cpu"}


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("nvcc"), reason="no CUDA compiler")
def test_cuda_kernels_for_two_kinds_of_cards(tmp_path: Path) -> None:
    said = configure(tmp_path, BITYMI_CUDA="ON", BITYMI_CUDA_ARCHITECTURES="80;90")
    assert "CUDA kernels for 80, 90" in said
    built = (tmp_path / "build.ninja").read_text("utf8")
    assert "code=[sm_80]" in built and "code=[compute_90,sm_90]" in built
    compiled = "CMakeFiles/bitymi_cuda.dir/csrc/cuda/device_check.cu.o"
    done = subprocess.run([str(NINJA), "-C", str(tmp_path), compiled], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert b"compute capabilities 80, 90, and this card has" in (tmp_path / compiled).read_bytes()
