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
    assert 'WHY_NOT = r"""it was built with BITYMI_CUDA=OFF: leave' in (tmp_path / "_cuda_build.py").read_text("utf8")


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


OLD, NEW = "compute_50 compute_75 compute_86 compute_90", "compute_75 compute_90 compute_103 compute_120"
REFUSED = (
    "a.h:132:2: error: #error -- unsupported GNU version! later than 11! The nvcc flag -allow can be used. At risk."
)
REFUSES = f"case $2 in g++-11) exit 0;; *) echo '{REFUSED}' >&2; exit 1;; esac"
FAILS = "echo 'fatal error: no lib' >&2; exit 1"


@pytest.mark.parametrize(
    ("nvcc", "known", "compiles", "cards", "archs", "said"),
    [
        (None, "", "", None, "", "no nvcc was found when it was built: install the CUDA toolkit (11.8 to 13)"),
        ("11.4", OLD, "", None, "", "nvcc 11.4 (BIN/nvcc) is too old or does not run"),
        ("", OLD, "", None, "", "(BIN/nvcc) is too old or does not run"),
        ("11.8", OLD, "", None, "75;86;90", ""),
        ("13.0", NEW, "", None, "75;90;120", ""),
        ("13.0", NEW, "", "9.0\\n9.0", "90", ""),
        ("13.0", NEW, "", "[N/A]", "75;90;120", ""),
        ("13.0", NEW, "", "10.3\\n7.5", "75;103", ""),
        ("11.8", OLD, "", "12.0", "90", "capability 120 is newer than nvcc 11.8 (BIN/nvcc): the driver"),
        ("11.8", OLD, "", "6.1", "", "a GPU of compute capability 61 cannot be used: the kernels need 75"),
        ("11.8", OLD, "", "6.1\\n8.6", "86", "a GPU of compute capability 61 cannot be used"),
        ("11.8", OLD, REFUSES, "8.6", "86", "host g++-11"),
        ("11.8", OLD, REFUSES.replace("g++-11", "no"), "8.6", "", "unsupported GNU version! later than 11: install"),
        ("11.8", OLD, FAILS, "8.6", "", "cannot compile with BIN/g++: fatal error: no lib: install a g++"),
    ],
)  # fmt: skip
def test_what_cuda_kernels_are_built_for_or_why_not(
    tmp_path: Path, nvcc: str | None, known: str, compiles: str, cards: str | None, archs: str, said: str
) -> None:
    answers = f"""case $1 in
        --version) echo 'Cuda compilation tools, {nvcc and f"release {nvcc}"}, V1';;
        --list-gpu-arch) printf '%s\\n' {known};;
        -ccbin) {compiles.replace("*/g++-11", "g++-11")};;
    esac"""
    smi = "exit 9" if cards is None else f"printf '{cards}\\n'"
    for name, script in (("nvcc", answers), ("nvidia-smi", smi), ("g++", ""), ("g++-11", "")):
        if name != "nvcc" or nvcc is not None:
            (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
            (tmp_path / name).chmod(0o755)
    result = "${why}|${note}|host ${CMAKE_CUDA_HOST_COMPILER}|${BITYMI_CUDA_ARCHITECTURES}"
    script = tmp_path / "find.cmake"
    script.write_text(f'include("{ROOT}/cmake/find_cuda.cmake")\nfind_cuda()\nmessage("{result}")\n')
    elsewhere = "/usr/local/cuda/bin;/usr/local/bin;/usr/bin;/opt/cuda/bin"
    options = [f"-DCMAKE_CXX_COMPILER={tmp_path}/g++", f"-DCMAKE_IGNORE_PATH={elsewhere}", "-DBITYMI_CUDA=AUTO"]
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin"}
    command = [str(CMAKE), *options, "-P", str(script)]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    found = done.stderr.replace(str(tmp_path), "BIN").strip()
    assert said in found and found.rpartition("|")[2] == archs
    assert archs or not found.startswith("|")  # a reason


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
    assert b"compute capabilities 80, 90, and this GPU has" in (tmp_path / compiled).read_bytes()
