"""Runs as jobs of submitit: its local executor, with processes of this machine."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from bitymi_ns.measure.bench import BenchError, Matrix
from bitymi_ns.measure.bench.engine import Silent
from bitymi_ns.measure.bench.spread import job_options, run_job, spread


class Recorder(Silent):
    def __init__(self) -> None:
        self.done: list[str] = []
        self.broken: list[str] = []

    def finished(self, stage, seconds: float) -> None:
        self.done.append(str(stage))

    def failed(self, stage, reason: str) -> None:
        self.broken.append(str(stage))


@pytest.fixture
def job_python(fakes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs run a Python that has the stand-ins beside it."""
    pytest.importorskip("submitit")
    monkeypatch.setattr(sys, "executable", fakes.python(monkeypatch))
    monkeypatch.setattr("bitymi_ns.measure.bench.spread.POLL", 0.05)


@pytest.mark.usefixtures("job_python")
def test_jobs_of_the_local_executor_write_to_one_file(fakes, matrix: Matrix, tmp_path: Path) -> None:
    work, watcher = tmp_path / "work", Recorder()
    fakes.fail("ns-export /lego/ -seed1")
    failures = spread(work, matrix.chains(), "local", watcher, jobs=2)
    assert len(failures) == 1 and "export (bc7) failed" in failures[0]
    cells = [json.loads(line) for line in (work / "cells.jsonl").read_text().splitlines()]
    assert len(cells) == 22 == len(set(watcher.done)) and len(watcher.broken) == 2
    fakes.fail()
    fakes.calls()
    assert spread(work, matrix.chains(), "local", Silent(), jobs=2) == []
    assert len(fakes.calls()) == 2


def test_a_job_sees_the_gpu_that_it_was_given(
    fakes, matrix: Matrix, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert run_job(tmp_path / "work", matrix.chains()[0][:1], 3) == []
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "3"


def test_options_of_a_job() -> None:
    assert job_options(["timeout_min=60", "slurm_partition=gpu"]) == {"timeout_min": 60, "slurm_partition": "gpu"}
    with pytest.raises(BenchError, match="--job-options takes words"):
        job_options(["partition"])


def test_options_that_the_engine_does_not_know(matrix: Matrix, tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    with pytest.raises(BenchError, match="does not take the job: .*nonsense"):
        spread(tmp_path / "w", matrix.chains(), "local", Silent(), 1, options={"nonsense": 1})


def test_without_the_engine_it_is_named(matrix: Matrix, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(BenchError, match=r"pip install 'bitymi-ns\[cluster\]'"):
        spread(tmp_path / "w", matrix.chains(), "local", Silent(), 1)
