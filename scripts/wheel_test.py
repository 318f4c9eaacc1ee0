#!/usr/bin/env python
"""Build the wheel as `pip install .` does, check its contents, install it in isolation and run tests against it.

The build starts from an empty folder with only PATH, HOME and TMPDIR of the environment, without the CUDA kernels. The
wheel's virtual environment finds the dependencies of this one, but not the checkout. Tests of the kernels run with each
module that this CPU can run.
"""

import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SITE_PACKAGES = Path(sysconfig.get_path("purelib"))
KERNELS = "tests/ops/test_kernels.py"
TESTS = (
    *("tests/test_presets.py", "tests/ops/test_backend.py", KERNELS, "tests/plugin/test_registration.py"),
    *("tests/ops/test_constants.py", "tests/codec/test_streams.py", "tests/bundle/test_compact.py"),
)

WHERE = """
import sys
from pathlib import Path
import torch
import bitymi_ns
from bitymi_ns import presets
from bitymi_ns.ops.backend import module
kernels = module(torch.device("cpu"))
for place in (bitymi_ns.__file__, kernels.__file__, presets.preset_dir()):
    assert Path(place).is_relative_to(sys.prefix), f"{place} is not in {sys.prefix}"
print("This CPU runs", kernels.__name__)
"""

FIRST = """
import sys
from pathlib import Path
import pytest
read_text = Path.read_text
Path.read_text = lambda path, *words, **options: (
    "" if str(path) == "/proc/cpuinfo" else read_text(path, *words, **options)
)
from bitymi_ns.ops import backend
assert backend.cpu_module() == "_cpu"
sys.exit(pytest.main(sys.argv[1:]))
"""


def run(*command: str | Path, cwd: Path = ROOT) -> None:
    """Run a command with a minimal environment; exit if it fails."""
    variables = {name: os.environ[name] for name in ("HOME", "TMPDIR") if name in os.environ}
    variables["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    if code := subprocess.run([str(word) for word in command], cwd=cwd, env=variables, check=False).returncode:
        sys.exit(f"wheel test: exit status {code} of {' '.join(map(str, command))}")


def build(folder: Path) -> Path:
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    options = ("-q", "--no-build-isolation", "--no-deps", "--no-index")
    settings = ("cmake.define.BITYMI_CUDA=OFF", f"build-dir={folder / 'build'}")
    run(*pip, "wheel", *options, *(f"--config-settings={setting}" for setting in settings), "-w", folder, ROOT)
    (wheel,) = folder.glob("bitymi_ns-*.whl")
    return wheel


def expected() -> set[str]:
    """List the wheel's expected files, without metadata."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "bitymi_ns", "method_configs"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    files = {line.replace("method_configs/", "bitymi_ns/method_configs/") for line in listed.stdout.splitlines()}
    modules = ("_cpu", "_cpu_x86_64_v4") if platform.machine() == "x86_64" else ("_cpu",)
    compiled = {f"bitymi_ns/{name}{sysconfig.get_config_var('EXT_SUFFIX')}" for name in modules}
    return files | compiled | {"bitymi_ns/_cpu_features.py", "bitymi_ns/_cuda_build.py"}


def check_contents(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        files = {name for name in archive.namelist() if ".dist-info/" not in name}
    if files != expected():
        missing, superfluous = sorted(expected() - files), sorted(files - expected())
        sys.exit(f"wheel test: {wheel.name} lacks {missing}, and should not hold {superfluous}")
    print(f"{wheel.name}: {len(files)} files, {wheel.stat().st_size / 1e6:.1f} MB")


def install(wheel: Path, folder: Path) -> Path:
    """Create a virtual environment with the wheel and this one's packages; return its interpreter."""
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    python = folder / "bin" / "python"
    site = folder / SITE_PACKAGES.relative_to(sys.prefix)
    # .pth files of a folder that a .pth file names (the editable install's) are not read; torchvision_remedy's must be
    lines = [str(SITE_PACKAGES)] + [f"import {path.stem}" for path in SITE_PACKAGES.glob("_torchvision*.pth")]
    (site / "dependencies.pth").write_text("\n".join(lines) + "\n", encoding="utf8")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python)
    run(*pip, "install", "-q", "--no-deps", "--no-index", "--ignore-installed", wheel)
    return python


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        wheel = build(folder)
        check_contents(wheel)
        python = install(wheel, folder / "venv")
        away = folder / "away"
        shutil.copytree(ROOT / "tests", away / "tests", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copytree(ROOT / "web" / "test", away / "web" / "test")
        shutil.copy(ROOT / "pyproject.toml", away)
        run(python, "-c", WHERE, cwd=away)
        options = ("-q", "-p", "no:cacheprovider", "--disable-warnings")
        run(python, "-m", "pytest", *options, *TESTS, cwd=away)
        # the module for CPUs without AVX-512, used if the CPU is unknown
        run(python, "-c", FIRST, *options, KERNELS, cwd=away)


if __name__ == "__main__":
    main()
