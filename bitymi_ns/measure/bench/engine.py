"""Execution of a benchmark matrix's missing cells. Several processes, on different GPUs or machines, may share a
folder: runs locked by another process are skipped."""

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bitymi_ns.files import write_errors_as
from bitymi_ns.locks import Busy, Lock
from bitymi_ns.measure.bench.cells import FILE, Cells, provenance, without_nan
from bitymi_ns.measure.bench.matrix import CellSpec, Run
from bitymi_ns.measure.bench.process import BenchError, CommandFailed, run_measured, say, tool
from bitymi_ns.measure.report.read import read_jsonl
from bitymi_ns.trust import json_of

CURVE = "training_curve.jsonl"
Chain = Sequence[CellSpec]  # the cells of one run; each may depend on those before it


def config_of(work: Path, run: Run) -> Path:
    """Return the path of a run's config.yml."""
    return work / "runs" / run.folder / "config.yml"


def output_of(work: Path, stage: CellSpec) -> Path:
    """Return the output path of a cell: a folder, or the file of an evaluation."""
    run = stage.run.folder
    return {
        "train": work / "runs" / run,
        "export": work / "bundles" / run / stage.form,
        "eval": work / "evals" / run / f"{stage.form}.json",
    }[stage.kind]


def train_command(work: Path, run: Run) -> list[str]:
    """Build the command line of ns-train, without viewer, with the run's seed for all generators."""
    command = [tool("ns-train"), run.row.method, "--output-dir", str(work / "runs")]
    command += ["--experiment-name", run.scene.name, "--timestamp", run.name, "--vis", "none"]
    if run.steps is not None:
        command += ["--max-num-iterations", str(run.steps)]
    if run.seed is not None:
        command += ["--machine.seed", str(run.seed)]
        if run.row.ours:
            command += ["--pipeline.model.train.seed", str(run.seed)]
            command += ["--pipeline.datamanager.train-cameras-sampling-seed", str(run.seed)]
    command += run.row.options
    parser, *options = run.scene.parser or ("",)
    return [*command, *filter(None, [parser]), "--data", str(run.scene.data), *options]


def stage_command(work: Path, stage: CellSpec) -> list[str]:
    """Build the command line of a cell."""
    if stage.kind == "train":
        return train_command(work, stage.run)
    config, output = config_of(work, stage.run), str(output_of(work, stage))
    if stage.kind == "export":
        assert stage.bundle is not None
        command = [tool("ns-export"), "bitymi-atlas", "--load-config", str(config)]
        return [*command, "--output-dir", output, *stage.bundle.options]
    if stage.bundle is not None:
        config = work / "bundles" / stage.run.folder / stage.form / "config.yml"
    pictures = str(output_of(work, stage).with_suffix(""))
    return [tool("ns-eval"), "--load-config", str(config), "--output-path", output, "--render-output-path", pictures]


def read_result(work: Path, stage: CellSpec) -> dict[str, Any]:
    """Read the figures of a finished command.

    train: `steps`, `seconds` and `cpu_seconds` of the training steps only (no loading, evaluation or saving),
    `surfels`, `fragments`, `curve`. export: `bytes`, `files`, `format` and `statistics` of the bundle. eval:
    nerfstudio's `results`, means over the held-out views, and the folder of their `pictures`. Raises CommandFailed:
    there are no readable figures."""
    readers = {"train": _train, "export": _export, "eval": _evaluation}
    try:
        return without_nan(readers[stage.kind](output_of(work, stage), stage))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CommandFailed(f"{stage}: the command left no figures that can be read: {error}") from error


def _train(folder: Path, stage: CellSpec) -> dict[str, Any]:
    if not stage.run.row.ours:
        return {}
    _, curves, _ = read_jsonl(folder / CURVE)
    if not curves:
        raise ValueError(f"{folder / CURVE} holds no point of a training curve")
    figures = {name: curves[0].last(name) for name in ("seconds", "cpu_seconds", "surfels", "fragments")}
    return {"steps": curves[0].last("step"), **figures, "curve": f"runs/{stage.run.folder}/{CURVE}"}


def _export(folder: Path, stage: CellSpec) -> dict[str, Any]:
    from bitymi_ns.bundle.read import download_bytes, read_manifest  # imports torch, not needed for other methods

    info = read_manifest(folder)
    compact = info.surfels.columns is not None
    return {
        "bytes": download_bytes(folder, info),
        "files": {name: entry.bytes for name, entry in info.files.items()},
        "format": None if info.atlas is None else "compact" if compact else info.atlas.format,
        "statistics": info.statistics.model_dump(mode="json"),
    }


def _evaluation(file: Path, stage: CellSpec) -> dict[str, Any]:
    results = json_of(file.read_text("utf8"))["results"]
    if not isinstance(results, dict) or "psnr" not in results:
        raise ValueError("no psnr in it")
    return {"results": results, "pictures": output_of(Path(), stage).with_suffix("").as_posix()}


def _needs(stage: CellSpec, other: CellSpec) -> bool:
    """Return True if `stage` depends on `other`, of the same run."""
    if other.kind == "train":
        return stage.kind != "train"
    return other.kind == "export" and stage.kind == "eval" and stage.bundle == other.bundle


def missing(chain: Chain, cells: Cells) -> list[CellSpec]:
    """List the cells of a run to execute: those not finished, and those that depend on these."""
    pending: list[CellSpec] = []
    for stage in chain:
        if cells.get(stage.key) is None or any(_needs(stage, other) for other in pending):
            pending.append(stage)
    return pending


@contextmanager
def locked(work: Path, run: Run) -> Iterator[Lock]:
    """Lock a run against other processes. Raises CommandFailed: another process holds the lock."""
    path = work / "locks" / f"{run.folder.replace('/', '--')}.lock"
    with write_errors_as(work, BenchError, ", with --work"):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock = Lock(path, say)
        except Busy as error:
            raise CommandFailed(f"{run}: {error}") from error
    with lock:
        yield lock


def _run_stage(work: Path, stage: CellSpec, cells: Cells, lock: Lock) -> None:
    command, output = stage_command(work, stage), output_of(work, stage)
    if stage.kind == "eval":  # the folder also holds other evaluations
        output.parent.mkdir(parents=True, exist_ok=True)
    else:
        shutil.rmtree(output, ignore_errors=True)  # output of an earlier attempt
    start = time.perf_counter()
    cost = run_measured(command, work / "logs" / stage.run.folder / f"{stage.kind}-{stage.form}.log", lock)
    value = {**read_result(work, stage), **cost}
    cells.add(stage.key, value, provenance(command, time.perf_counter() - start))


def _run_chain(work: Path, chain: Chain, cells: Cells, announce: Callable[[CellSpec], None]) -> list[str]:
    """Execute the missing cells of a run, except those that depend on a failed one; return a message per failure."""
    failures: list[str] = []
    broken: list[CellSpec] = []
    with locked(work, chain[0].run) as lock:
        cells.refresh()
        for stage in missing(chain, cells):
            if any(_needs(stage, other) for other in broken):
                broken.append(stage)
                continue
            announce(stage)
            try:
                _run_stage(work, stage, cells, lock)
            except CommandFailed as error:
                broken.append(stage)
                failures.append(f"{stage} failed: {error}")
    return failures


def run_chains(work: Path, chains: Sequence[Chain]) -> list[str]:
    """Execute the missing cells of all runs.

    Args:
        chains: the cells of each run.

    Returns:
        A message for each failed cell and each run locked by another process.

    Raises:
        BenchError: there is nothing to run.
    """
    if not any(chains):
        raise BenchError("nothing to run: there is no scene, or no method")
    cells = Cells(work / FILE)
    total = sum(map(len, chains))
    done = total - sum(len(missing(chain, cells)) for chain in chains)
    if done:
        say(f"{done} of {total} cells are finished already")

    def announce(stage: CellSpec) -> None:
        left = sum(len(missing(chain, cells)) for chain in chains)
        say(f"{stage} ({total - left + 1} of {total})")

    failures: list[str] = []
    for chain in chains:
        if not missing(chain, cells):
            continue
        try:
            failures += _run_chain(work, chain, cells, announce)
        except CommandFailed as error:
            failures.append(str(error))
    return failures
