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

from harness import Arguments, Rows, number, publish, say, table

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


def run(command: Sequence[object], folder: Path, environment: dict[str, str], costs: Rows) -> bool:
    """Run a command in a folder, add its row to `costs`, and return True on success."""
    words = [str(word) for word in command]
    log, cells = folder / f"{len(costs.cells)}.log", ["failed", ""]
    with watched(folder) as used, contextlib.suppress(BenchError):
        cost = run_measured(words, log, cwd=folder, env=environment)
        cells = [number(cost["process_seconds"], 1), number(cost["peak_bytes"] / 1e6, 0)]
    done = cells[0] != "failed"
    say(f"{'ended' if done else f'failed, see {log}'}: {shlex.join(words)[:150]}")
    costs.cells.append([f"`{shlex.join(words)}`", *cells, number(max(used, default=None), 0)])
    return done


def commands(capture: Path, steps: int, options: Sequence[str]) -> list[list[object]]:
    """List the commands; each uses the results of those before it in the working folder."""
    train = ["ns-train", "bitymi", "--data", capture, "--output-dir", "outputs", "--experiment-name", "capture"]
    train += ["--max-num-iterations", steps, "--vis", "tensorboard", "--timestamp"]
    folder, half = Path("outputs/capture/bitymi/whole"), max(1, steps // 2)
    config, bundle = folder / "config.yml", "bundle/config.yml"
    kept = ("--steps-per-save", half, "--save-only-latest-checkpoint", "False")
    checkpoint = ("--load-dir", folder / "nerfstudio_models", "--load-step", half)
    return [
        [*train, "whole", *kept, *options],
        [*train, "resumed", *checkpoint, *options],
        ["ns-eval", "--load-config", config, "--output-path", "trained.json"],
        ["ns-export", "bitymi-atlas", "--load-config", config, "--output-dir", "bundle"],
        ["ns-eval", "--load-config", bundle, "--output-path", "baked.json"],
        [
            *"ns-render dataset --load-config".split(),
            bundle,
            *"--output-path maps --rendered-output-names rgb depth".split(),
        ],
    ]


def quality(folder: Path) -> str:
    """Tabulate what the evaluations of a folder found as Markdown."""
    rows, digits = [], {"psnr": 2, "ssim": 3, "lpips": 3, "surfels": 0}
    for name in ("trained", "baked"):
        with contextlib.suppress(OSError):
            found = json.loads((folder / f"{name}.json").read_text())["results"]
            rows.append([name, *(number(found.get(key), n) for key, n in digits.items())])
    return table(("", "PSNR", "SSIM", "LPIPS", "surfels"), rows)


def main(parser: Arguments, words: Sequence[str]) -> int:
    """Run the commands on a capture until one fails, and publish their costs; return 1 if one has failed."""
    parser.add_argument("data", type=Path, help="folder of an undistorted capture with transforms.json")
    parser.add_argument("--steps", type=int, default=3000, help="length of the run (%(default)s)")
    parser.add_argument("--folder", type=Path, required=True, help="of runs, bundle and log; emptied first")
    parser.add_output()
    parser.add_argument("--options", nargs="...", default=[], help="of ns-train, at the end")
    arguments = parser.parse_args(words)
    folder, capture = arguments.folder.resolve(), arguments.data.resolve()
    shutil.rmtree(folder, ignore_errors=True)
    environment, costs = stand_in(folder / "stand-ins"), Rows(("command", "s", "MB of host", "MB of card"))
    try:
        for command in commands(capture, arguments.steps, arguments.options):
            if not run(command, folder, environment, costs):
                return 1
    finally:  # an interrupted run leaves its results
        title, notes = f"nerfstudio on {capture.name}, {arguments.steps} steps", [f"Stand-ins for {', '.join(NAMES)}."]
        publish(title, f"{costs}\n\n{quality(folder)}", notes, arguments.output)
    return 0
