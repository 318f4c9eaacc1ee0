"""Execution of the missing cells of a benchmark matrix, except of runs that another process has locked."""

import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bitymi_ns.files import write_errors_as
from bitymi_ns.locks import Busy, Lock
from bitymi_ns.safe_reading import read_json, reading
from ..report.read import read_jsonl
from .cells import FILE, Cells, provenance
from .matrix import Cell, Chain
from .process import BenchError, CommandFailed, run_measured, say, tool

CURVE = "training_curve.jsonl"


def train_command(work: Path, run: Cell) -> list[str]:
    """Build the command line of ns-train, without viewer, with the run's seed for all generators."""
    command = [tool("ns-train"), run.method, "--output-dir", str(work / "runs")]
    command += ["--experiment-name", run.scene, "--timestamp", Path(run.folder).name, "--vis", "none"]
    if run.steps is not None:
        command += ["--max-num-iterations", str(run.steps)]
    seeded = ["machine.seed"]
    if run.ours:
        seeded += ["pipeline.model.train.seed", "pipeline.datamanager.train-cameras-sampling-seed"]
    for option in seeded if run.seed is not None else ():
        command += [f"--{option}", str(run.seed)]
    return [*command, *run.options, *run.parser[:1], "--data", run.data, *run.parser[1:]]


def command_of(work: Path, cell: Cell) -> list[str]:
    """Build the command line of a cell."""
    if cell.cell == "train":
        return train_command(work, cell)
    config = ("--load-config", str(work / cell.parent.output / "config.yml"))
    output = str(work / cell.output)
    if cell.cell == "export":
        return [tool("ns-export"), "bitymi-atlas", *config, "--output-dir", output, *cell.export]
    pictures = ("--render-output-path", output.removesuffix(".json"))
    return [tool("ns-eval"), *config, "--output-path", output, *pictures]


def read_result(work: Path, cell: Cell) -> dict[str, Any]:
    """Read the figures of a finished command. Raises CommandFailed: there are no readable ones.

    train: `steps`, `seconds` and `cpu_seconds` of the training steps alone, `surfels`, `fragments`, `curve`. export:
    `bytes`, `files`, `format` and `statistics` of the bundle. eval: `results`, means over the held-out views, and the
    folder of their `pictures`."""
    output = work / cell.output
    with reading(output, CommandFailed):
        if cell.cell == "export":
            from bitymi_ns.bundle.read import download_bytes, read_manifest  # imports torch

            info = read_manifest(output)
            compact = info.surfels.columns is not None
            return {
                "bytes": download_bytes(output, info),
                "files": {name: entry.bytes for name, entry in info.files.items()},
                "format": None if info.atlas is None else "compact" if compact else info.atlas.format,
                "statistics": info.statistics.model_dump(mode="json"),
            }
        if cell.cell == "eval":
            results = read_json(output)["results"]
            pictures = cell.output.with_suffix("").as_posix()
            return {"results": {**results, "psnr": results["psnr"]}, "pictures": pictures}
        if not cell.ours:
            return {}
        curves = read_jsonl(output / CURVE).curves
        if not curves:
            raise ValueError(f"{CURVE} in it holds no point of a training curve")
        curve = curves[0]
        figures = {name: curve.last(name) for name in ("seconds", "cpu_seconds", "surfels", "fragments")}
        return {"steps": curve.last("step"), **figures, "curve": (cell.output / CURVE).as_posix()}


def missing(chain: Chain, cells: Cells) -> list[Cell]:
    """List the cells of a run that are not finished, and those that depend on these."""
    pending: list[Cell] = []
    for cell in chain:
        if cells.get(cell.key) is None or cell.parent in pending:
            pending.append(cell)
    return pending


def _run_cell(work: Path, cell: Cell, cells: Cells, lock: Lock) -> None:
    command, output = command_of(work, cell), work / cell.output
    if cell.cell == "eval":  # the folder also holds other evaluations
        output.parent.mkdir(parents=True, exist_ok=True)
    else:
        shutil.rmtree(output, ignore_errors=True)  # output of an earlier attempt
    start = time.perf_counter()
    cost = run_measured(command, work / "logs" / cell.folder / f"{cell.cell}-{cell.form}.log", lock)
    cells.add(cell.key, {**read_result(work, cell), **cost}, provenance(command, time.perf_counter() - start))


def run_chains(work: Path, chains: Sequence[Chain]) -> list[str]:
    """Execute the missing cells, except those that depend on a failed one. Returns a message per failed cell and per
    locked run. Raises BenchError: there is nothing to run."""
    if not any(chains):
        raise BenchError("nothing to run: there is no scene, or no method")
    cells, total, failures = Cells(work / FILE), sum(map(len, chains)), []

    def done() -> int:
        return total - sum(len(missing(chain, cells)) for chain in chains)

    if done():
        say(f"{done()} of {total} cells are finished already")
    for chain in chains:
        if not missing(chain, cells):
            continue
        broken: list[Cell] = []
        path = work / "locks" / f"{chain[0].folder.replace('/', '--')}.lock"
        with write_errors_as(work, BenchError, ", with --work"):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                lock = Lock(path, say)
            except Busy as error:
                failures.append(f"{chain[0].run}: {error}")
                continue
        with lock:
            cells.refresh()
            for cell in missing(chain, cells):
                if cell.parent in broken:
                    broken.append(cell)
                    continue
                say(f"{cell} ({done() + 1} of {total})")
                try:
                    _run_cell(work, cell, cells, lock)
                except CommandFailed as error:
                    broken.append(cell)
                    failures.append(f"{cell} failed: {error}")
    return failures
