#!/usr/bin/env python
"""Transfer the package to a bare machine with a GPU, and run tests and benchmarks there.

`card.py stage FILE.tar --python python3.12` archives the wheel for that Python and GPU, with its dependencies and
nerfstudio, except torch and numpy. `card.py run ORDER... --stage FILE.tar --output RESULTS` unpacks them on the machine
and runs the orders."""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CARRIED = ("bitymi_ns", "benchmarks", "tests", "method_configs", "pyproject.toml", "csrc", "docs", "README.md")
NEEDED = ("ispc_texcomp", "flip-evaluator", "torchmetrics", "lightning-utilities", "typing-extensions")
NEEDED += ("wgpu", "cffi", "pycparser", "rendercanvas", "nerfstudio", "tyro", "docstring-parser", "typeguard")
NEEDED += ("pycolmap", "pillow-heif")
"""Wheels missing on machines with torch and the usual scientific packages, in the versions of constraints.txt."""
TOOLS = ("scikit-build-core", "nanobind", "cmake", "ninja", "numpy")
BLOCKS = "from bitymi_ns import _cuda; print(repr(_cuda.device_problem(0)), _cuda.draws_bc7())"
SANITIZERS = ("memcheck", "racecheck", "initcheck", "synccheck")
ORDERS = ("check", "webgpu", "train", "frames")


@dataclass(frozen=True)
class Step:
    """A command with a time limit."""

    name: str  # in the summary
    command: Sequence[object]
    limit: float  # seconds


def steps_of(order: str, results: Path, data: Path, surfels: Sequence[str] = (), length: int = 30_000) -> list[Step]:
    """Build the steps of an order, with tables in `results`. `frames` also draws the bundles of `train`, which trains
    on the captures in `data` for `length` steps."""
    times = (sys.executable, "benchmarks/times.py")
    pytest = (sys.executable, "-m", "pytest", "-q", "-rfEs", "--tb=short", "-o", "faulthandler_timeout=60")
    sanitizer = ("compute-sanitizer", "--error-exitcode", "9", "--print-limit", "20", "--tool")
    bundles = results / "bundles"
    if order == "check":
        kernels = (*times, "kernels", "--device", "cuda")
        large = ("--surfels", "150000", "--size", "1297", "840", "--times", "20")
        small = ("--surfels", "300", "--size", "96", "64", "--times", "0")
        return [
            Step("block textures", [sys.executable, "-c", BLOCKS], 60),
            Step("tests", [*pytest, "tests/cuda", "-k", "not emulated"], 240),
            Step("kernels", [*kernels, *large], 90),
            *(Step(tool, [*sanitizer, tool, *kernels, *small], 150) for tool in SANITIZERS),
        ]
    if order == "webgpu":
        return [Step("webgpu tests", [*pytest, "tests/ops/webgpu"], 60)]
    if order == "frames":
        kept = sorted(file.parent for file in bundles.glob("**/bundle.json"))
        drawn = ["--surfels", *surfels, *(["--bundles", *kept] if kept else [])]
        return [Step(order, [*times, "frames", "--runs", "100", *drawn, "--output", results / "frames.md"], 200)]
    train = (sys.executable, "benchmarks/long.py")
    options = ("--runs", f"{length}/1", "--device", "cuda", "--work", results / "runs")
    steps = []
    for folder in sorted(file.parent for file in data.glob("*/transforms.json")):
        written = ("--keep", bundles / folder.name, "--output", results / f"{folder.name}-train.md")
        steps.append(Step(f"train on {folder.name}", [*train, folder, *options, *written], 600))
    return steps


def stage(arguments: argparse.Namespace) -> None:
    """Collect the wheels and LPIPS's weights in an archive."""
    kept = ROOT / "build" / f"card-{Path(arguments.python).name}"
    tools, wheels = kept / "tools", kept / "wheels"
    shutil.rmtree(wheels, ignore_errors=True)  # of other versions
    wheels.mkdir(parents=True)
    if not tools.exists():
        subprocess.run([arguments.python, "-m", "venv", str(tools)], check=True)
        subprocess.run([tools / "bin/python", "-m", "pip", "install", "-q", *TOOLS], check=True)
    pip = [str(tools / "bin/python"), "-m", "pip", "--disable-pip-version-check"]
    architectures = f"cmake.define.BITYMI_CUDA_ARCHITECTURES={arguments.architectures}"
    settings = ("cmake.define.BITYMI_CUDA=ON", architectures, f"build-dir={kept / 'build'}")
    options = [f"--config-settings={setting}" for setting in settings]
    wheel = [*pip, "wheel", "-q", "--no-build-isolation", "--no-deps", "-w", str(wheels), str(ROOT)]
    subprocess.run([*wheel, *options], check=True)
    fetched = [*pip, "download", "-q", "--only-binary", ":all:", "-d", str(wheels), "-c", f"{ROOT}/constraints.txt"]
    subprocess.run([*fetched, "pydantic"], check=True)  # with its dependencies
    subprocess.run([*fetched, "--no-deps", *NEEDED], check=True)
    from bitymi_ns.plugin.run import lpips  # lazily: `run` starts without this package

    lpips.load("alex")
    shutil.copy(lpips.weights_path("alex"), wheels)
    subprocess.run(["tar", "-C", wheels, "-cf", arguments.archive.absolute(), "."], check=True)


def unpack(archive: Path, work: Path) -> dict[str, str]:
    """Install the wheels, copy the checkout with their compiled modules, and return the environment."""
    site = work / "site"
    subprocess.run(["tar", "-C", work, "-xf", archive.absolute()], check=True)
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps", "--no-compile", "--target"]
    subprocess.run([*command, site, *work.glob("*.whl")], check=True)
    tree = work / "tree"
    tree.mkdir()
    for name in CARRIED:
        source = ROOT / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, tree / name)
    for compiled in [*(site / "bitymi_ns").glob("*.so"), site / "bitymi_ns/_cpu_features.py"]:
        shutil.copy(compiled, tree / "bitymi_ns")
    shutil.rmtree(site / "bitymi_ns")
    cache = work / "cache/bitymi-ns"
    cache.mkdir(parents=True)
    for file in work.glob("*.npz"):
        shutil.copy(file, cache)
    return {
        **os.environ,
        "PATH": f"{site / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": os.pathsep.join([str(tree), str(site), *filter(None, [os.environ.get("PYTHONPATH")])]),
        "XDG_CACHE_HOME": str(cache.parent),
        "BITYMI_TESTS_REQUIRE": "card",  # else tests/cuda would be skipped without a GPU
    }


def run_step(step: Step, tree: Path, environment: dict[str, str], logs: Path, deadline: float) -> str:
    """Run a step with a log, and return its line of the summary."""
    start = time.perf_counter()
    limit = min(step.limit, deadline - time.monotonic())
    if limit < 5:
        return f"| {step.name} | not begun: no time left | |"
    command, text = [str(word) for word in step.command], logs / f"{step.name}.txt"
    limited = ["timeout", "--signal=KILL", str(limit), *command]  # with all its children
    with tempfile.TemporaryDirectory() as folder, text.open("w") as log:
        environment = {**environment, "TMPDIR": folder, "PYTHONUNBUFFERED": "1"}
        print(*command, file=log, flush=True)
        done = subprocess.run(limited, cwd=tree, env=environment, stdout=log, stderr=subprocess.STDOUT, check=False)
    late = time.perf_counter() - start >= limit  # killed earlier, it ran out of memory
    result = "stopped" if late and done.returncode == -signal.SIGKILL else str(done.returncode)
    last = text.read_text(errors="replace").strip().splitlines()[-1].replace("|", "/")
    result += "" if result == "0" else f": {last}"
    return f"| {step.name} | {result} | {time.perf_counter() - start:.0f} |"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    commands = parser.add_subparsers(dest="command", required=True)
    staging = commands.add_parser("stage", help="make the archive of wheels")
    staging.add_argument("archive", type=Path)
    staging.add_argument("--python", default=sys.executable, help="a Python of the machine's version (%(default)s)")
    staging.add_argument("--architectures", default="90", help="compute capabilities of its card (%(default)s)")
    running = commands.add_parser("run", help="run orders on the machine")
    running.add_argument("orders", nargs="+", metavar="ORDER", choices=ORDERS, help=", ".join(ORDERS))
    running.add_argument("--stage", type=Path, required=True, help="the archive")
    running.add_argument("--data", type=Path, default=Path(), help="folder of the captures")
    running.add_argument("--output", type=Path, required=True)
    running.add_argument("--surfels", nargs="+", default=["50000", "150000", "500000"], help="scenes of the tables")
    running.add_argument("--steps", type=int, default=30_000, help="of the runs of `train` (%(default)s)")
    running.add_argument("--seconds", type=float, default=570, help="for all of it (%(default)s)")
    arguments = parser.parse_args()
    if arguments.command == "stage":
        stage(arguments)
        return 0
    deadline = time.monotonic() + arguments.seconds
    results = arguments.output.resolve()
    results.mkdir(parents=True, exist_ok=True)
    lines = ["| step | exit status | s |", "|---|---|---:|"]
    with tempfile.TemporaryDirectory() as work:
        environment = unpack(arguments.stage, Path(work))
        for order in arguments.orders:
            for step in steps_of(order, results, arguments.data.resolve(), arguments.surfels, arguments.steps):
                lines.append(run_step(step, Path(work) / "tree", environment, results, deadline))
                print(lines[-1], flush=True)
                (results / "summary.md").write_text("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
