"""What the benchmarks share: nerfstudio's commands as measured subprocesses, finished cells on disk, tables."""

from __future__ import annotations

import argparse
import datetime
import hashlib
import importlib.metadata
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

DEFAULT_WORK = Path("outputs/benchmarks")
"""Where runs, bundles, logs and finished cells go when --work is not given; git ignores it."""
FORMATS = ("fp16", "uint8", "bc7")
"""Atlas formats of `ns-export bitymi-atlas`."""
CURVE = "training_curve.jsonl"
TAIL = 25
"""Lines of a failed command's log that are shown."""


class CommandFailed(RuntimeError):
    """A command ended with a non-zero status; the message has the end of its log."""


# commands


@dataclass(frozen=True)
class Cost:
    """What a process used, all its threads and the children it waited for included."""

    seconds: float
    cpu_seconds: float
    peak_bytes: int


def run_measured(command: Sequence[str], log: Path) -> Cost:
    """Run a command with its output in a file.

    OpenMP threads wait without spinning, so that CPU seconds count work. LPIPS weights are not fetched: no table here
    has that column.

    Raises:
        CommandFailed: non-zero exit status.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OMP_WAIT_POLICY": "passive"}
    environment.setdefault("BITYMI_NO_DOWNLOAD", "1")
    say(shlex.join(command))
    start = time.perf_counter()
    with open(log, "wb") as out:
        process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT
        )
        try:
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.terminate()
            process.wait()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        tail = "\n".join(log.read_text("utf8", "replace").splitlines()[-TAIL:])
        raise CommandFailed(f"{shlex.join(command)} ended with status {process.returncode}; end of {log}:\n{tail}")
    kibibytes = usage.ru_maxrss if sys.platform != "darwin" else usage.ru_maxrss / 1024
    return Cost(time.perf_counter() - start, usage.ru_utime + usage.ru_stime, int(kibibytes * 1024))


def tool(name: str) -> str:
    """A console script of this Python's environment, else the one on PATH.

    Raises:
        CommandFailed: there is none.
    """
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.is_file() else shutil.which(name)
    if found is None:
        raise CommandFailed(f"there is no {name}: run this with the Python of an environment that has nerfstudio")
    return found


# finished cells


class Cells:
    """Results that are there already: one JSON object a line, {"key": what was run, "value": what came out}."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[str, dict[str, Any]] = {}
        if path.is_file():
            for line in path.read_text("utf8").splitlines():
                try:
                    cell = json.loads(line)
                    self._known[_text(cell["key"])] = cell["value"]
                except (ValueError, KeyError, TypeError):
                    continue  # cut off when a benchmark was killed while it wrote

    def get(self, key: dict[str, Any], make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The value under `key`; made and written when it is not there."""
        text = _text(key)
        if text not in self._known:
            value = {**make(), "commit": commit()}
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a+b") as file:
                if file.tell() and not _ends_with_newline(self.path):
                    file.write(b"\n")
                file.write(json.dumps({"key": key, "value": value}).encode("utf8") + b"\n")
            self._known[text] = value
        return self._known[text]


def _text(key: dict[str, Any]) -> str:
    return json.dumps(key, sort_keys=True)


def _ends_with_newline(path: Path) -> bool:
    with open(path, "rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) == b"\n"


# runs


@dataclass(frozen=True)
class Settings:
    """One training run: what is trained on which capture, and how."""

    data: Path
    method: str = "bitymi"
    steps: int | None = None
    """Length of the run; None = the method's own for this machine."""
    extra: tuple[str, ...] = ()
    """Further options of ns-train."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "data", self.data.expanduser().resolve())

    @property
    def scene(self) -> str:
        return self.data.name

    @property
    def key(self) -> dict[str, Any]:
        return {"data": str(self.data), "method": self.method, "steps": self.steps, "extra": list(self.extra)}

    @property
    def name(self) -> str:
        """Of the run's folder: tells runs of one method on one capture apart."""
        length = "own-length" if self.steps is None else f"{self.steps}-steps"
        return f"{length}-{hashlib.sha256(_text(self.key).encode()).hexdigest()[:8]}"

    def train_command(self, outputs: Path) -> list[str]:
        """ns-train without viewer. Captures in the layout of nerf_synthetic are read by `blender-data`, with the points
        of `hull_pc.ply` where they have that file."""
        command = [tool("ns-train"), self.method, "--output-dir", str(outputs), "--experiment-name", self.scene]
        command += ["--timestamp", self.name, "--vis", "none"]
        if self.steps is not None:
            command += ["--max-num-iterations", str(self.steps)]
        command += self.extra
        if not (self.data / "transforms_train.json").is_file():
            return [*command, "--data", str(self.data)]
        points = ["--ply-path", "hull_pc.ply"] if (self.data / "hull_pc.ply").is_file() else []
        return [*command, "blender-data", "--data", str(self.data), *points]


@dataclass
class Bench:
    """Trains, bakes and evaluates in a work folder; what is finished there is not done again."""

    work: Path
    cells: Cells = field(init=False)

    def __post_init__(self) -> None:
        self.work = self.work.expanduser().resolve()
        self.cells = Cells(self.work / "cells.jsonl")

    def run_folder(self, settings: Settings) -> Path:
        return self.work / "runs" / settings.scene / settings.method / settings.name

    def train(self, settings: Settings) -> dict[str, Any]:
        """Train. `seconds` and `cpu_seconds` are those of the training steps alone (the run's own clock: no loading,
        evaluation or saving), `process_*` and `peak_bytes` those of the whole ns-train."""

        def make() -> dict[str, Any]:
            folder = self.run_folder(settings)
            shutil.rmtree(folder, ignore_errors=True)
            cost = run_measured(settings.train_command(self.work / "runs"), self._log(settings, "train"))
            last = read_curve(folder / CURVE)[-1]
            return {
                "steps": last["step"],
                "seconds": last["seconds"],
                "cpu_seconds": last["cpu_seconds"],
                "surfels": last["surfels"],
                "fragments": last.get("fragments"),
                "process_seconds": round(cost.seconds, 2),
                "process_cpu_seconds": round(cost.cpu_seconds, 2),
                "peak_bytes": cost.peak_bytes,
            }

        return self.cells.get({"cell": "train", **settings.key}, make)

    def export(self, settings: Settings, atlas: str) -> dict[str, Any]:
        """Bake a trained run into a bundle; what it costs, and its own comparison with the trained scene."""

        def make() -> dict[str, Any]:
            folder = self._bundle(settings, atlas)
            shutil.rmtree(folder, ignore_errors=True)
            config = self.run_folder(settings) / "config.yml"
            command = [tool("ns-export"), "bitymi-atlas", "--load-config", str(config), "--output-dir", str(folder)]
            cost = run_measured([*command, "--format", atlas], self._log(settings, f"export-{atlas}"))
            held_out = json.loads((folder / "bundle.json").read_text("utf8"))["statistics"].get("held_out", {})
            return {"process_seconds": round(cost.seconds, 2), "peak_bytes": cost.peak_bytes, "held_out": held_out}

        return self.cells.get({"cell": "export", "format": atlas, **settings.key}, make)

    def evaluate(self, settings: Settings, atlas: str | None = None) -> dict[str, Any]:
        """ns-eval of a trained run, or of its bundle: nerfstudio's `results`, means over the held-out views."""

        def make() -> dict[str, Any]:
            folder = self.run_folder(settings) if atlas is None else self._bundle(settings, atlas)
            form = atlas or "neural"
            result = self.work / "evals" / settings.scene / settings.method / settings.name / f"{form}.json"
            result.parent.mkdir(parents=True, exist_ok=True)
            command = [tool("ns-eval"), "--load-config", str(folder / "config.yml"), "--output-path", str(result)]
            run_measured(command, self._log(settings, f"eval-{form}"))
            return json.loads(result.read_text("utf8"))["results"]

        return self.cells.get({"cell": "eval", "format": atlas, **settings.key}, make)

    def _bundle(self, settings: Settings, atlas: str) -> Path:
        return self.work / "bundles" / settings.scene / settings.method / settings.name / atlas

    def _log(self, settings: Settings, what: str) -> Path:
        return self.work / "logs" / settings.scene / settings.method / settings.name / f"{what}.log"


def read_curve(path: Path) -> list[dict[str, Any]]:
    """The points of a training curve, by step.

    Raises:
        CommandFailed: there are none.
    """
    points = {}
    if path.is_file():
        for line in path.read_text("utf8").splitlines():
            try:
                point = json.loads(line)
                points[point["step"]] = point
            except (ValueError, KeyError, TypeError):
                continue  # cut off when the run was killed
    if not points:
        raise CommandFailed(f"{path} holds no point of a training curve")
    return [points[step] for step in sorted(points)]


# command lines


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Options of every benchmark that trains."""
    parser.add_argument("--steps", type=int, help="steps of a run; default: the method's own for this machine")
    add_output_options(parser)
    parser.add_argument(
        "--extra", nargs=argparse.REMAINDER, default=[], help="options for ns-train: all that follows, so give it last"
    )


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """Where results go."""
    parser.add_argument(
        "--work", type=Path, default=DEFAULT_WORK, help="folder of runs and finished cells (%(default)s)"
    )
    parser.add_argument("--output", type=Path, help="also write the Markdown to this file")


# tables


def number(value: float | None, digits: int = 2) -> str:
    """A number for a table, with separators of thousands; nothing for None."""
    return "" if value is None else f"{value:,.{digits}f}"


def difference(value: float, digits: int = 3) -> str:
    """A signed number for a table; no sign where it rounds to zero."""
    rounded = round(value, digits)
    return f"{rounded:+.{digits}f}" if rounded else f"{0.0:.{digits}f}"


def table(header: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int = 1) -> str:
    """A Markdown table; all columns but the first `text_columns` are flush right."""
    rule = ["---" if i < text_columns else "---:" for i in range(len(header))]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows))


def commit() -> str:
    """The checkout's commit, with `+` when the tree differs from it; empty outside a checkout."""
    where = Path(__file__).resolve().parent
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    result = subprocess.run(command, cwd=where, capture_output=True, text=True, check=False)
    return result.stdout.strip()


def machine() -> str:
    """One line about the machine and the software."""
    model = platform.processor() or platform.machine()
    memory = ""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf8").splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), model)
        memory = f", {os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB"
    except (OSError, ValueError):
        pass
    versions = ", ".join(f"{name} {version}" for name in ("torch", "nerfstudio") if (version := installed(name)))
    threads = os.environ.get("OMP_NUM_THREADS")
    limit = f", OMP_NUM_THREADS={threads}" if threads else ""
    return f"{model}, {cores()} cores{memory}; Python {platform.python_version()}, {versions}{limit}"


def installed(distribution: str) -> str:
    """Version of an installed distribution, empty when it is not there."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ""


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def command_line() -> str:
    """How this script was called."""
    return shlex.join(["python", os.path.relpath(sys.argv[0]), *sys.argv[1:]])


def page(title: str, body: str, notes: Sequence[str] = (), commits: Sequence[str] = ()) -> str:
    """A Markdown section: title, how it was made, table, notes.

    Args:
        commits: of the cells that the table shows; none = made now, by the checkout as it is.
    """
    made = sorted(set(commits)) or [commit()]
    lines = [f"## {title}", "", f"`{command_line()}`  ", f"{machine()}  "]
    lines += [f"{datetime.date.today():%Y-%m-%d}, commit {', '.join(c or 'unknown' for c in made)}", "", body]
    if notes:
        lines += ["", *(f"- {note}" for note in notes)]
    return "\n".join(lines) + "\n"


def publish(text: str, output: Path | None) -> None:
    """Print a page, and write it where asked."""
    print(text)
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(text, "utf8")


def say(text: str) -> None:
    """Progress, apart from the table."""
    print(f"[{datetime.datetime.now():%H:%M:%S}] {text}", file=sys.stderr, flush=True)
