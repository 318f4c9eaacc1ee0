"""Run nerfstudio's commands on a capture and tabulate time and memory: train, resume, evaluate, export, evaluate and
render the bundle.

A bare machine lacks packages that nerfstudio imports but this plugin does not use. `NAMES` are replaced by modules
whose use is an error, also on machines that have the packages, so that a run shows that none is needed.
"""

import contextlib
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from harness import Arguments, number, publish, say, table

from bitymi_ns.measure.bench.process import BenchError, run_measured

NAMES = ("IPython", "av", "fpsample", "gsplat", "open3d", "pathos", "pillow_heif", "plotly", "pymeshlab", "rawpy")
NAMES += ("tensorly", "xatlas", "yourdfpy")
IGNORED = ("IPython.get_ipython", "pillow_heif.register_heif_opener", "tensorly.set_backend")  # called at import time

SITE = """import importlib.abc
import importlib.util
import sys


class Absent(type):
    def __getattr__(cls, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return Absent(f"{cls.__name__}.{name}", (), {})

    def __call__(cls, *arguments, **options):
        if cls.__name__ not in IGNORED:
            raise RuntimeError(f"{cls.__name__} is a stand-in: the package is not on this machine")


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path=None, target=None):
        stands = name.partition(".")[0] in NAMES
        return importlib.util.spec_from_loader(name, self, is_package=True) if stands else None

    def create_module(self, spec):
        return Absent(spec.name, (), {})

    def exec_module(self, module):
        pass


sys.meta_path.insert(0, Finder())
"""
"""Stand-ins: an attribute is a class, and to make one of it an error."""


def stand_in(folder: Path) -> dict[str, str]:
    """Write the stand-ins to a folder and return environment variables that make every Python use them."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sitecustomize.py").write_text(SITE.replace("NAMES", repr(NAMES)).replace("IGNORED", repr(IGNORED)))
    path = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    programs = os.pathsep.join([os.environ["PATH"], str(Path(sys.executable).parent)])
    return {**os.environ, "PATH": programs, "PYTHONPATH": path, "COLUMNS": "200", "BITYMI_NO_DOWNLOAD": "1"}


@contextlib.contextmanager
def watched(folder: Path) -> Iterator[list[float]]:
    """Sample the first GPU's memory in use, MB, five times a second; the list yielded has it afterwards."""
    seen: list[float] = []
    command = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits", "--id=0", "--loop-ms=200"]
    with (folder / "card.txt").open("w+") as file, contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            stack.callback(subprocess.Popen(command, stdout=file).terminate)
        yield seen
        file.seek(0)
        seen += [float(line) for line in file if line.strip().isdigit()]


class Commands:
    """Sequential commands in a folder, with their costs in `rows`."""

    def __init__(self, folder: Path, environment: dict[str, str]) -> None:
        self.rows: list[tuple[str, dict[str, float] | None, float | None]] = []
        """Command, cost of `run_measured` (None: failed), peak GPU memory of all programs, MB (None: no GPU)."""
        self._folder, self._environment = folder, environment

    def run(self, *words: object) -> bool:
        """Run a command and return True on success."""
        typed, log = [str(word) for word in words], self._folder / f"{len(self.rows)}.log"
        cost = None
        with watched(self._folder) as used, contextlib.suppress(BenchError):
            cost = run_measured(typed, log, cwd=self._folder, env=self._environment)
        self.rows.append((shlex.join(typed), cost, max(used, default=None)))
        say(f"{'ended' if cost else 'failed, see ' + str(log)}: {self.rows[-1][0][:150]}")
        return cost is not None


def all_commands(capture: Path, folder: Path, steps: int, options: Sequence[str], commands: Commands) -> None:
    """Run all commands; each uses the results of those before it in `folder`."""
    train = ["ns-train", "bitymi", "--data", capture, "--output-dir", "outputs", "--experiment-name", "capture"]
    train += ["--max-num-iterations", steps, "--vis", "tensorboard"]
    run, bundle = folder / "outputs/capture/bitymi/whole", folder / "bundle/config.yml"
    half = max(1, steps // 2)
    kept = ("--timestamp", "whole", "--steps-per-save", half, "--save-only-latest-checkpoint", "False")
    if not commands.run(*train, *kept, *options):
        return
    checkpoint = ("--load-dir", run / "nerfstudio_models", "--load-step", half)
    commands.run(*train, "--timestamp", "resumed", *checkpoint, *options)
    config = run / "config.yml"
    commands.run("ns-eval", "--load-config", config, "--output-path", "trained.json")
    if commands.run("ns-export", "bitymi-atlas", "--load-config", config, "--output-dir", "bundle"):
        commands.run("ns-eval", "--load-config", bundle, "--output-path", "baked.json")
        names = ("--rendered-output-names", "rgb", "depth")
        commands.run("ns-render", "dataset", "--load-config", bundle, "--output-path", "maps", *names)


def tables(folder: Path, commands: Commands) -> str:
    """Tabulate costs and quality as Markdown."""
    cells = []
    for command, cost, card in commands.rows:
        took = (number(cost["process_seconds"], 1), number(cost["peak_bytes"] / 1e6, 0)) if cost else ("failed", "")
        cells.append([f"`{command}`", *took, number(card, 0)])
    quality, digits = [], {"psnr": 2, "ssim": 3, "lpips": 3, "surfels": 0}
    for name in ("trained", "baked"):
        with contextlib.suppress(OSError):
            found = json.loads((folder / f"{name}.json").read_text())["results"]
            quality.append([name, *(number(found.get(key), n) for key, n in digits.items())])
    text = table(("command", "s", "MB of host", "MB of card"), cells)
    return f"{text}\n\n{table(('', 'PSNR', 'SSIM', 'LPIPS', 'surfels'), quality)}"


def main(parser: Arguments, words: Sequence[str]) -> int:
    """Run the commands on a capture and publish their costs; return 1 if any failed."""
    parser.add_argument("data", type=Path, help="folder of an undistorted capture with transforms.json")
    parser.add_argument("--steps", type=int, default=3000, help="length of the run (%(default)s)")
    parser.add_argument("--folder", type=Path, required=True, help="of runs, bundle and log; emptied first")
    parser.add_output()
    parser.add_argument("--options", nargs="...", default=[], help="of ns-train, at the end")
    arguments = parser.parse_args(words)
    folder, capture = arguments.folder.resolve(), arguments.data.resolve()
    shutil.rmtree(folder, ignore_errors=True)
    commands = Commands(folder, stand_in(folder / "stand-ins"))
    try:
        all_commands(capture, folder, arguments.steps, arguments.options, commands)
    finally:  # an interrupted run leaves its results
        title, notes = f"nerfstudio on {capture.name}, {arguments.steps} steps", [f"Stand-ins for {', '.join(NAMES)}."]
        publish(title, tables(folder, commands), notes, arguments.output)
    return int(any(cost is None for _, cost, _ in commands.rows))
