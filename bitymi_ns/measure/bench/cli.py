"""Command line of benchmark matrices: `bitymi bench local`, `bitymi bench mipnerf360`, ..."""

import os
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import tyro

from bitymi_ns.files import check_writable, write_errors_as
from bitymi_ns.trust import printable
from ..markdown import page, publish
from ..report.read import add_cells
from ..report.records import Records
from ..report.tables import NOTES, quality_markdown
from .cells import FILE, Cells
from .engine import run_chains
from .matrix import Chain, Format, PlanName, Row, chains, local_scenes, read_plan, standard_scenes
from .process import BenchError, say

FAILED, INTERRUPTED = 1, 130  # exit statuses after a failed cell and after Ctrl-C


@dataclass
class BenchRun:
    """Train, bake and evaluate a matrix of scenes, methods and seeds."""

    data: tuple[Path, ...]  # Folders of captures, or the folder of a standard data set's scenes.
    scenes: tuple[str, ...] = ()  # Only these scenes of a standard data set.
    methods: tuple[str, ...] = ("bitymi",)  # Methods of ns-train.
    plan: PlanName | None = None  # Rows to train, and bundles to bake, instead of --methods and --formats.
    extra: str = ""
    """Further options of ns-train for every run, as one word: --extra="--pipeline.model.scene.weight-bound 0"."""
    seeds: tuple[int, ...] = ()  # Train once per seed; none = once, with the method's own.
    steps: int | None = None  # Steps of a training; schedules scale with it. None = the method's own.
    formats: tuple[Format, ...] = get_args(Format)  # Bundle formats to bake each trained scene to; none = no baking.
    work: Path = Path("outputs/bench")
    """Folder of runs, bundles, logs and finished cells, which are not run again. Processes on different GPUs or
    machines may share it: each takes runs that no other is working on."""
    output: Path | None = None  # Also write the table to this Markdown file.
    suite: tyro.conf.Suppress[str] = "local"

    def chains(self) -> list[Chain]:
        """List the cells of each run of these options. Raises BenchError: an option is invalid."""
        if self.steps is not None and self.steps < 1:
            raise BenchError(f"--steps must be at least 1, not {self.steps}")
        rows = {name: Row(name) for name in self.methods}
        bundles = {name: ["--format", name] for name in self.formats}
        if self.plan:
            rows, bundles = read_plan(self.plan)
        extra = shlex.split(self.extra)
        rows = {name: Row(row.method, (*row.options, *extra)) for name, row in rows.items()}
        if self.suite != "local":
            if len(self.data) != 1:
                raise BenchError(f"--data is one folder: the one that holds the scenes of {self.suite}")
            scenes = standard_scenes(self.suite, self.data[0], self.scenes)
        elif self.scenes:
            raise BenchError("--scenes chooses scenes of a standard data set; name your captures with --data")
        else:
            scenes = local_scenes(self.data)
        return chains(scenes, rows, bundles, self.seeds, self.steps)

    def run(self) -> int:
        """Run the missing cells, print the table, and return the exit status."""
        runs, work = self.chains(), Path(os.path.expanduser(self.work)).resolve()
        cells = Cells(work / FILE)
        if self.output is not None:
            with write_errors_as(self.output, BenchError):
                check_writable(self.output)
        try:
            failures = run_chains(work, runs)
        except KeyboardInterrupt:
            finished = len(Cells(work / FILE).known)
            kept = f"{finished} finished cells are in {work}" if finished else "no cell was finished"
            say(f"interrupted; {kept}. Run the same command to continue")
            return INTERRUPTED
        for failure in failures:
            say(failure)
        cells.refresh()
        finished = [cell for chain in runs for spec in chain if (cell := cells.get(spec.key))]
        records = Records()
        add_cells(finished, cells.path, records)
        failed = [f"Failed: {line.splitlines()[0].removesuffix(', whose end is:')}." for line in failures]
        commits = [cell["made"]["commit"] for cell in finished]
        tables = quality_markdown(records.evaluations)
        publish(page(f"Benchmark: {self.plan or self.suite}", tables, [NOTES, *failed], commits), self.output)
        kept = f"Cells: {cells.path}. A page of it: bitymi report {cells.path}"
        print(printable(kept if cells.known else "No cell was finished."), file=sys.stderr)
        return FAILED if failures else 0
