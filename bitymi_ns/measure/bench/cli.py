"""The command line of a matrix: `bitymi bench local`, `bitymi bench mipnerf360`, ..."""

from __future__ import annotations

import os
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from bitymi_ns.files import check_writable, explained, write_file
from bitymi_ns.measure.bench.engine import open_cells, run_chains
from bitymi_ns.measure.bench.matrix import Matrix, Row, SceneSpec
from bitymi_ns.measure.bench.process import BenchError, say
from bitymi_ns.measure.bench.progress import Display
from bitymi_ns.measure.bench.suites import FORMATS, format_bundles, local_scenes, read_plan, standard_scenes, suites
from bitymi_ns.measure.bench.tables import results_page
from bitymi_ns.trust import printable

# A switch without its --no- twin, where this tyro knows how.
Flag = tyro.conf.FlagCreatePairsOff[bool] if hasattr(tyro.conf, "FlagCreatePairsOff") else bool

FAILED, INTERRUPTED = 1, 130
"""Exit statuses when a cell failed, and after Ctrl-C."""


@dataclass
class BenchRun:
    """Train, bake and evaluate a matrix of scenes, methods and seeds."""

    data: tuple[Path, ...]
    """local: folders of captures. A standard data set: the folder that holds its scenes."""
    scenes: tuple[str, ...] = ()
    """Only these scenes of a standard data set."""
    methods: tuple[str, ...] = ("bitymi",)
    """Methods of ns-train."""
    plan: str | None = None
    """Rows to train instead of --methods: ablation, atlas, overdraw, paper, resolution, or
    a YAML file of that form."""
    extra: str = ""
    """Further options of ns-train for every run, as one word: --extra="--pipeline.model.scene.weight-bound 0"."""
    seeds: tuple[int, ...] = ()
    """Train once for each of these seeds; none = once, with the method's own."""
    steps: int | None = None
    """Steps of a training; the schedules follow. None = the method's own for this machine."""
    formats: tuple[str, ...] = FORMATS
    """Formats of bundles that each trained scene is baked into; none = no baking."""
    pictures: int = 2
    """Worst held-out views of each run that are drawn with their decomposition and errors; 0 = none."""
    knobs: Flag = False
    """Also measure what each quality knob costs and saves, for every run."""
    work: Path = Path("outputs/bench")
    """Folder of runs, bundles, logs and finished cells; what is finished there is not done again."""
    output: Path | None = None
    """Also write the table to this Markdown file."""
    cluster: Literal["none", "local", "slurm"] = "none"
    """Spread the runs with submitit: as processes of this machine, or by Slurm (pip install 'bitymi-ns[cluster]')."""
    jobs: int = 1
    """With --cluster: runs at a time."""
    gpus: tuple[int, ...] = ()
    """With --cluster local: GPUs by number, one for each run at a time."""
    job_options: tuple[str, ...] = ()
    """With --cluster: options of a job, as in timeout_min=600 slurm_partition=gpu gpus_per_node=1."""
    suite: tyro.conf.Suppress[str] = "local"

    def _scenes(self) -> list[SceneSpec]:
        if self.suite == "local":
            if self.scenes:
                raise BenchError("--scenes chooses scenes of a standard data set; name your captures with --data")
            return local_scenes(self.data)
        if len(self.data) != 1:
            raise BenchError(f"--data is one folder: the one that holds the scenes of {self.suite}")
        return standard_scenes(suites()[self.suite], self.data[0], self.scenes)

    def matrix(self) -> Matrix:
        """What is to be measured.

        Raises:
            BenchError: an option makes no sense; the message says which.
        """
        if self.steps is not None and self.steps < 1:
            raise BenchError(f"--steps must be at least 1, not {self.steps}")
        if self.pictures < 0 or self.jobs < 1:
            raise BenchError("--pictures must not be negative, and --jobs at least 1")
        if self.cluster == "none" and (self.jobs > 1 or self.gpus or self.job_options):
            raise BenchError("--jobs, --gpus and --job-options are for --cluster local or --cluster slurm")
        if self.plan is None:
            rows, bundles = [Row(name, name) for name in self.methods], None
        else:
            rows, bundles = read_plan(self.plan)
        extra = tuple(shlex.split(self.extra))
        if not rows:
            raise BenchError("nothing to run: give --methods or --plan")
        rows = [Row(row.name, row.method, (*row.options, *extra)) for row in rows]
        bundles = format_bundles(self.formats) if bundles is None else bundles
        return Matrix(self._scenes(), rows, self.seeds, self.steps, bundles, self.pictures, self.knobs)

    def run(self) -> int:
        """Do what is missing, then print the table; returns the exit status."""
        matrix, work = self.matrix(), Path(os.path.expanduser(self.work)).resolve()
        chains, cells = matrix.chains(), open_cells(work)
        if self.output is not None:
            with explained(self.output, BenchError):
                check_writable(self.output)
        workers = 1 if self.cluster == "none" else len(self.gpus) or self.jobs
        try:
            with Display(chains, cells, workers) as display:
                if self.cluster == "none":
                    failures = run_chains(work, chains, display)
                else:
                    from bitymi_ns.measure.bench.spread import job_options, spread

                    options = job_options(self.job_options)
                    failures = spread(work, chains, self.cluster, display, self.jobs, self.gpus, options)
        except KeyboardInterrupt:
            done = len(open_cells(work))
            kept = f"{done} finished cells are in {work}" if done else "no cell was finished"
            say(f"interrupted; {kept}. The same command goes on")
            return INTERRUPTED
        for failure in failures:
            say(failure)
        cells.refresh()
        text = results_page(f"Benchmark: {self.plan or self.suite}", matrix, cells, failures)
        print(printable(text))
        if self.output is not None:
            self.output.parent.mkdir(parents=True, exist_ok=True)
            with explained(self.output, BenchError):
                write_file(self.output, text.encode("utf8"))
        if len(cells):
            print(printable(f"Cells: {cells.path}. A page of it: bitymi report {cells.path}"), file=sys.stderr)
        else:
            print("No cell was finished.", file=sys.stderr)
        return FAILED if failures else 0
