"""Run nerfstudio's commands on a capture and tabulate time and memory: train, resume, evaluate, export, evaluate and
render the bundle.

A bare machine lacks packages that nerfstudio imports but this plugin does not use. `STAND_INS` are replaced by modules
whose use is an error, also on machines that have the packages, so that a run shows that none is needed.
"""

import contextlib
import itertools
import json
import os
import re
import runpy
import shlex
import shutil
import statistics
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from harness import Arguments, number, publish, say, table

from bitymi_ns.measure.bench.process import CommandFailed, run_measured

STAND_INS = ("IPython", "av", "fpsample", "gsplat", "open3d", "pathos", "pillow_heif", "plotly", "pymeshlab")
STAND_INS += ("rawpy", "tensorly", "xatlas", "yourdfpy")
IGNORED = ("IPython.get_ipython", "pillow_heif.register_heif_opener", "tensorly.set_backend")  # called at import time

SITE = '''"""Stand-ins, not the packages of these names: an attribute is a class, and to make one of it an error."""

import importlib.abc
import importlib.util
import sys
import types


class Absent(type):
    def __getattr__(cls, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return Absent(name, (), {"__module__": f"{cls.__module__}.{cls.__name__}"})

    def __call__(cls, *arguments, **options):
        name = f"{cls.__module__}.{cls.__name__}"
        if name not in IGNORED:
            raise RuntimeError(f"{name} is a stand-in: the package is not on this machine")


class Module(types.ModuleType):
    __path__ = []

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return Absent(name, (), {"__module__": self.__name__})


class Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    def find_spec(self, name, path=None, target=None):
        stands = name.partition(".")[0] in NAMES
        return importlib.util.spec_from_loader(name, self, is_package=True) if stands else None

    def create_module(self, spec):
        return Module(spec.name)

    def exec_module(self, module):
        pass


sys.meta_path.insert(0, Finder())
'''


def stand_in(folder: Path) -> dict[str, str]:
    """Write the stand-ins to a folder and return environment variables that make every Python use them."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sitecustomize.py").write_text(SITE.replace("NAMES", repr(STAND_INS)).replace("IGNORED", repr(IGNORED)))
    path = os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    programs = os.pathsep.join([os.environ["PATH"], str(Path(sys.executable).parent)])
    return {**os.environ, "PATH": programs, "PYTHONPATH": path, "COLUMNS": "200", "BITYMI_NO_DOWNLOAD": "1"}


def card_memory() -> float | None:
    """Read the memory in use on the first GPU, MB; None without a GPU."""
    command = ["nvidia-smi", "--query-gpu=memory.used", "--format=csv,noheader,nounits", "--id=0"]
    with contextlib.suppress(OSError, ValueError):
        return float(subprocess.run(command, capture_output=True, text=True, check=False).stdout)
    return None


@contextlib.contextmanager
def watched() -> Iterator[list[float]]:
    """Sample the GPU memory in use five times a second."""
    seen: list[float] = []
    over = threading.Event()

    def watch() -> None:
        while (used := card_memory()) is not None:
            seen.append(used)
            if over.wait(0.2):
                return

    thread = threading.Thread(target=watch)
    thread.start()
    yield seen
    over.set()
    thread.join()


class Commands:
    """Sequential commands in a folder, with their costs in `rows`.

    Args:
        after: called after each command, so that an interrupted run leaves its results.
    """

    def __init__(self, folder: Path, environment: dict[str, str], after: Callable[[], None] = lambda: None) -> None:
        self.rows: list[tuple[str, dict[str, float] | None, float | None]] = []
        """Command, cost of `run_measured` (None: failed), peak GPU memory of all programs, MB (None: no GPU)."""
        self._folder, self._environment, self._after = folder, environment, after

    def run(self, *words: object) -> bool:
        """Run a command and return True on success."""
        typed, log = [str(word) for word in words], self._folder / f"{len(self.rows)}.log"
        cost = None
        with watched() as used:
            try:
                cost = run_measured(typed, log, cwd=self._folder, env=self._environment)
            except CommandFailed as error:
                say(str(error))
        self.rows.append((shlex.join(typed), cost, max(used, default=None)))
        say(f"{'failed' if cost is None else 'ended'}: {self.rows[-1][0][:150]}")
        self._after()
        return cost is not None


WAITS_STEPS = 60  # length of the run in which synchronisations are counted


def waits(words: Sequence[str]) -> None:
    """Train in this process and print how often torch synchronises with the GPU in the median step of the second half
    of the run, a step without evaluation. The compiled module waits once more per step, to read the number of pairs."""
    import torch

    from bitymi_ns.train.step import Training

    counted: list[int] = []
    begin = Training.begin

    def counting(self: Training, step: int) -> None:
        counted.append(len(caught))
        begin(self, step)

    Training.begin = counting  # type: ignore[method-assign]
    sys.argv = ["ns-train", *words]
    with warnings.catch_warnings(record=True) as caught:
        warnings.filterwarnings("always", ".*synchronizing")
        torch.cuda.set_sync_debug_mode("warn")
        runpy.run_module("nerfstudio.scripts.train", run_name="__main__")
    late = counted[len(counted) // 2 :]
    print(f"waits per step: {statistics.median(b - a for a, b in itertools.pairwise(late)):.1f}")


def all_commands(capture: Path, folder: Path, steps: int, options: Sequence[str], commands: Commands) -> None:
    """Run all commands; each uses the results of those before it in `folder`."""
    train = ["ns-train", "bitymi", "--data", capture, "--output-dir", "outputs", "--experiment-name", "capture"]
    train += ["--max-num-iterations", steps, "--vis", "tensorboard"]
    runs, bundle = folder / "outputs/capture/bitymi", folder / "bundle/config.yml"
    half = max(1, steps // 2)
    kept = ("--timestamp", "whole", "--steps-per-save", half, "--save-only-latest-checkpoint", "False")
    if not commands.run(*train, *kept, *options):
        return
    checkpoint = ("--load-dir", runs / "whole/nerfstudio_models", "--load-step", half)
    commands.run(*train, "--timestamp", "resumed", *checkpoint, *options)
    config = runs / "whole/config.yml"
    commands.run("ns-eval", "--load-config", config, "--output-path", "trained.json")
    if commands.run("ns-export", "bitymi-atlas", "--load-config", config, "--output-dir", "bundle"):
        commands.run("ns-eval", "--load-config", bundle, "--output-path", "baked.json")
        names = ("--rendered-output-names", "rgb", "depth")
        commands.run("ns-render", "dataset", "--load-config", bundle, "--output-path", "maps", *names)
    if commands.rows[0][2] is not None:
        short = (*train[1:], "--timestamp", "waits", "--max-num-iterations", WAITS_STEPS, *options)
        commands.run(sys.executable, Path(__file__).with_name("times.py"), "nerfstudio", "--waits", *short)


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
    if words[:1] == ["--waits"]:
        waits(words[1:])
        return 0
    parser.add_argument("data", type=Path, help="folder of an undistorted capture with transforms.json")
    parser.add_argument("--steps", type=int, default=3000, help="length of the run (%(default)s)")
    parser.add_argument("--folder", type=Path, required=True, help="of runs, bundle and log; emptied first")
    parser.add_output()
    parser.add_argument("--options", nargs="...", default=[], help="of ns-train, at the end")
    arguments = parser.parse_args(words)
    folder, capture = arguments.folder.resolve(), arguments.data.resolve()
    shutil.rmtree(folder, ignore_errors=True)
    title = f"nerfstudio on {capture.name}, {arguments.steps} steps"

    def write() -> None:
        logs = "".join(path.read_text() for path in folder.glob("*.log"))
        notes = [f"Stand-ins for {', '.join(STAND_INS)}."]
        for per_step in re.findall(r"waits per step: ([\d.]+)", logs):
            notes.append(f"Waits of the host for the card per step, nerfstudio's own included: {per_step}.")
        publish(title, tables(folder, commands), notes, arguments.output)

    commands = Commands(folder, stand_in(folder / "stand-ins"), write)
    all_commands(capture, folder, arguments.steps, arguments.options, commands)
    return int(any(cost is None for _, cost, _ in commands.rows))
