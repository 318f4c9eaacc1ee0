"""Execution of a benchmark matrix's missing cells. Several processes, on different GPUs or machines, may share a
folder: runs locked by another process are skipped."""

import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bitymi_ns.files import write_errors_as
from bitymi_ns.locks import Busy, Lock
from bitymi_ns.measure.bench.cells import FILE, Cells, provenance
from bitymi_ns.measure.bench.matrix import CellSpec, Chain
from bitymi_ns.measure.bench.process import BenchError, CommandFailed, run_measured, say, tool
from bitymi_ns.measure.report.read import read_jsonl
from bitymi_ns.safe_reading import read_json

CURVE = "training_curve.jsonl"


def train_command(work: Path, run: CellSpec) -> list[str]:
    """Build the command line of ns-train, without viewer, with the run's seed for all generators."""
    command = [tool("ns-train"), run.row.method, "--output-dir", str(work / "runs")]
    command += ["--experiment-name", run.scene.name, "--timestamp", run.run_name, "--vis", "none"]
    if run.steps is not None:
        command += ["--max-num-iterations", str(run.steps)]
    if run.seed is not None:
        command += ["--machine.seed", str(run.seed)]
        if run.row.ours:
            command += ["--pipeline.model.train.seed", str(run.seed)]
            command += ["--pipeline.datamanager.train-cameras-sampling-seed", str(run.seed)]
    command += run.row.options
    parser, options = run.scene.parser[:1], run.scene.parser[1:]
    return [*command, *parser, "--data", str(run.scene.data), *options]


def command_of(work: Path, cell: CellSpec) -> list[str]:
    """Build the command line of a cell."""
    if cell.kind == "train":
        return train_command(work, cell)
    config, output = ("--load-config", str(work / cell.source)), str(work / cell.output)
    if cell.bundle is not None and cell.kind == "export":
        return [tool("ns-export"), "bitymi-atlas", *config, "--output-dir", output, *cell.bundle.options]
    pictures = str(work / cell.pictures)
    return [tool("ns-eval"), *config, "--output-path", output, "--render-output-path", pictures]


def read_result(work: Path, cell: CellSpec) -> dict[str, Any]:
    """Read the figures of a finished command.

    train: `steps`, `seconds` and `cpu_seconds` of the training steps only (no loading, evaluation or saving),
    `surfels`, `fragments`, `curve`. export: `bytes`, `files`, `format` and `statistics` of the bundle. eval:
    nerfstudio's `results`, means over the held-out views, and the folder of their `pictures`. Raises CommandFailed:
    there are no readable figures."""
    readers = {"train": _train, "export": _export, "eval": _evaluation}
    try:
        return readers[cell.kind](work, cell)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CommandFailed(f"{cell}: the command left no figures that can be read: {error}") from error


def _train(work: Path, cell: CellSpec) -> dict[str, Any]:
    if not cell.row.ours:
        return {}
    path = cell.output / CURVE
    _, curves, _ = read_jsonl(work / path)
    if not curves:
        raise ValueError(f"{work / path} holds no point of a training curve")
    figures = {name: curves[0].last(name) for name in ("seconds", "cpu_seconds", "surfels", "fragments")}
    return {"steps": curves[0].last("step"), **figures, "curve": path.as_posix()}


def _export(work: Path, cell: CellSpec) -> dict[str, Any]:
    from bitymi_ns.bundle.read import download_bytes, read_manifest  # imports torch, not needed for other methods

    info = read_manifest(work / cell.output)
    compact = info.surfels.columns is not None
    return {
        "bytes": download_bytes(work / cell.output, info),
        "files": {name: entry.bytes for name, entry in info.files.items()},
        "format": None if info.atlas is None else "compact" if compact else info.atlas.format,
        "statistics": info.statistics.model_dump(mode="json"),
    }


def _evaluation(work: Path, cell: CellSpec) -> dict[str, Any]:
    results = read_json(work / cell.output)["results"]
    if not isinstance(results, dict) or "psnr" not in results:
        raise ValueError("no psnr in it")
    return {"results": results, "pictures": cell.pictures.as_posix()}


def _needs(cell: CellSpec, other: CellSpec) -> bool:
    """Return True if `cell` depends on `other`, of the same run."""
    if other.kind == "train":
        return cell.kind != "train"
    return other.kind == "export" and cell.kind == "eval" and cell.bundle == other.bundle


def missing(chain: Chain, cells: Cells) -> list[CellSpec]:
    """List the cells of a run to execute: those not finished, and those that depend on these."""
    pending: list[CellSpec] = []
    for cell in chain:
        if cells.get(cell.key) is None or any(_needs(cell, other) for other in pending):
            pending.append(cell)
    return pending


def lock_of(work: Path, run: CellSpec) -> Lock:
    """Lock a run against other processes. Raises CommandFailed: another process holds the lock."""
    path = work / "locks" / f"{run.folder.replace('/', '--')}.lock"
    with write_errors_as(work, BenchError, ", with --work"):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            return Lock(path, say)
        except Busy as error:
            raise CommandFailed(f"{run.run}: {error}") from error


def _run_cell(work: Path, cell: CellSpec, cells: Cells, lock: Lock) -> None:
    command, output = command_of(work, cell), work / cell.output
    if cell.kind == "eval":  # the folder also holds other evaluations
        output.parent.mkdir(parents=True, exist_ok=True)
    else:
        shutil.rmtree(output, ignore_errors=True)  # output of an earlier attempt
    start = time.perf_counter()
    cost = run_measured(command, work / "logs" / cell.folder / f"{cell.kind}-{cell.form}.log", lock)
    value = {**read_result(work, cell), **cost}
    cells.add(cell.key, value, provenance(command, time.perf_counter() - start))


def _run_chain(work: Path, chain: Chain, cells: Cells, announce: Callable[[CellSpec], None]) -> list[str]:
    """Execute the missing cells of a run, except those that depend on a failed one; return a message per failure."""
    failures: list[str] = []
    broken: list[CellSpec] = []
    with lock_of(work, chain[0]) as lock:
        cells.refresh()
        for cell in missing(chain, cells):
            if any(_needs(cell, other) for other in broken):
                broken.append(cell)
                continue
            announce(cell)
            try:
                _run_cell(work, cell, cells, lock)
            except CommandFailed as error:
                broken.append(cell)
                failures.append(f"{cell} failed: {error}")
    return failures


def run_chains(work: Path, chains: Sequence[Chain]) -> list[str]:
    """Execute the missing cells of all runs. Returns a message for each failed cell and each run locked by another
    process. Raises BenchError: there is nothing to run."""
    if not any(chains):
        raise BenchError("nothing to run: there is no scene, or no method")
    cells = Cells(work / FILE)
    total = sum(map(len, chains))
    done = total - sum(len(missing(chain, cells)) for chain in chains)
    if done:
        say(f"{done} of {total} cells are finished already")

    def announce(cell: CellSpec) -> None:
        left = sum(len(missing(chain, cells)) for chain in chains)
        say(f"{cell} ({total - left + 1} of {total})")

    failures: list[str] = []
    for chain in chains:
        if not missing(chain, cells):
            continue
        try:
            failures += _run_chain(work, chain, cells, announce)
        except CommandFailed as error:
            failures.append(str(error))
    return failures
