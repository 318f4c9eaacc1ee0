"""Runs of a matrix on several machines or GPUs, through submitit (Slurm, or processes of this machine)."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from bitymi_ns.measure.bench.engine import Chain, Watcher, missing, open_cells, run_chain
from bitymi_ns.measure.bench.process import BenchError

Cluster = Literal["slurm", "local"]
MINUTES = 3 * 24 * 60
"""Time limit of a job, unless another is given as timeout_min."""
POLL = 2.0
"""Seconds between two looks at the jobs."""


def submitit() -> Any:
    """The engine that jobs are handed to.

    Raises:
        BenchError: it is not installed.
    """
    try:
        import submitit as module
    except ImportError as error:
        raise BenchError("spreading runs needs submitit: pip install 'bitymi-ns[cluster]'") from error
    return module


def job_options(words: Sequence[str]) -> dict[str, Any]:
    """Options of a job from NAME=VALUE words, as submitit's `update_parameters` takes them.

    Raises:
        BenchError: a word is of another form.
    """
    options: dict[str, Any] = {}
    for word in words:
        name, separator, value = word.partition("=")
        if not separator or not name.isidentifier():
            raise BenchError(f"--job-options takes words like timeout_min=600 slurm_partition=gpu, not {word!r}")
        options[name] = int(value) if value.lstrip("-").isdigit() else value
    return options


def run_job(work: Path, chain: Chain, gpu: int | None) -> list[str]:
    """What a job does: one run, which sees one GPU where it was given one."""
    if gpu is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = str(gpu)
    return run_chain(work, chain)


def _submit(module: Any, cluster: Cluster, work: Path, chain: Chain, options: dict[str, Any], gpu: int | None) -> Any:
    executor = module.AutoExecutor(folder=work / "jobs" / "%j", cluster=cluster)
    try:
        executor.update_parameters(**{"timeout_min": MINUTES, "name": "bitymi-bench", **options})
        return executor.submit(run_job, work, chain, gpu)
    except (NameError, TypeError, ValueError, RuntimeError, module.core.utils.FailedJobError) as error:
        raise BenchError(f"submitit does not take the job: {' '.join(str(error).split())}") from error


def _outcome(job: Any, chain: Chain) -> list[str]:
    try:
        return job.result()
    except Exception as error:  # whatever the engine or the job raised: the other jobs go on
        lines = [line for line in str(error).splitlines() if line.strip()]
        return [
            f"{chain[0].run}: the job failed: {lines[-1] if lines else type(error).__name__}; see {job.paths.folder}"
        ]


def spread(
    work: Path,
    chains: Sequence[Chain],
    cluster: Cluster,
    watcher: Watcher,
    jobs: int,
    gpus: Sequence[int] = (),
    options: dict[str, Any] | None = None,
) -> list[str]:
    """Do every run that is not finished as a job; all jobs write to the same cells.jsonl, so `work` must be on a file
    system that they share.

    Args:
        work: folder of runs and finished cells.
        chains: the cells of every run.
        cluster: slurm; local = processes of this machine.
        watcher: told about each cell that turns up.
        jobs: how many at a time (Slurm has its own queue: there it bounds what is in that queue).
        gpus: local: GPUs by number, one per job, and as many jobs at a time as there are GPUs.
        options: of a job (timeout_min, slurm_partition, ...).

    Returns:
        One message for every run or cell that failed.

    Raises:
        BenchError: submitit is not there or does not take the jobs.
    """
    module = submitit()
    cells = open_cells(work)
    waiting = [chain for chain in chains if missing(chain, cells)]
    todo = {id(chain): missing(chain, cells) for chain in waiting}
    obsolete = {stage: cells.get(stage.key) for stages in todo.values() for stage in stages}
    slots: list[int | None] = list(gpus) or [None] * max(1, jobs)
    running: dict[int, tuple[Any, Chain, int | None]] = {}
    failures: list[str] = []
    try:
        while waiting or running:
            while waiting and slots:
                chain, slot = waiting.pop(0), slots.pop(0)
                job = _submit(module, cluster, work, chain, options or {}, slot)
                running[id(chain)] = (job, chain, slot)
                watcher.started(todo[id(chain)][0])
            cells.refresh()
            for name, (job, chain, slot) in list(running.items()):
                ended = job.done()
                if ended:
                    failures += _outcome(job, chain)
                    cells.refresh()
                for stage in list(todo[name]):
                    line = cells.get(stage.key)
                    if line is None or line is obsolete[stage]:
                        continue
                    todo[name].remove(stage)
                    watcher.finished(stage, float(line.get("made", {}).get("seconds", 0.0)))
                    if todo[name] and not ended:
                        watcher.started(todo[name][0])
                if ended:
                    for stage in todo[name]:
                        watcher.failed(stage, "the job ended")
                    del running[name]
                    slots.append(slot)
            if running:
                time.sleep(POLL)
    except BaseException:
        for job, _, _ in running.values():
            job.cancel(check=False)
        raise
    return failures
