"""Run the cells of a matrix that are not finished. Processes may share a folder, each on another GPU or machine: a run
that another process holds is left to it."""

import shutil
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bitymi_ns.files import Busy, Lock, reason
from bitymi_ns.measure.bench.cells import FILE, Cells, provenance, without_nan
from bitymi_ns.measure.bench.matrix import Run, Stage
from bitymi_ns.measure.bench.process import BenchError, CommandFailed, run_measured, say, tool
from bitymi_ns.trust import json_of

CURVE = "training_curve.jsonl"
Chain = Sequence[Stage]  # the cells of one run; each may need those before it


class Layout:
    """Paths of a run below the work folder."""

    def __init__(self, work: Path, run: Run) -> None:
        self.work, self.run = work, run

    def path(self, what: str, *parts: str) -> Path:
        """A path of the run below runs, bundles, evals, pictures or logs."""
        return self.work.joinpath(what, self.run.folder, *parts)

    @property
    def config(self) -> Path:
        """config.yml of the trained run."""
        return self.path("runs", "config.yml")

    def relative(self, path: Path) -> str:
        """A path as a cell records it."""
        return path.relative_to(self.work).as_posix()


def train_command(work: Path, run: Run) -> list[str]:
    """Command line of ns-train without viewer; a seed is set wherever one is read."""
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


def stage_command(work: Path, stage: Stage) -> list[str]:
    """Command line of a cell."""
    at = Layout(work, stage.run)
    if stage.kind == "train":
        return train_command(work, stage.run)
    if stage.kind == "export":
        assert stage.bundle is not None
        command = [tool("ns-export"), "bitymi-atlas", "--load-config", str(at.config)]
        return [*command, "--output-dir", str(at.path("bundles", stage.form)), *stage.bundle.options]
    if stage.kind == "eval":
        config = at.config if stage.bundle is None else at.path("bundles", stage.form, "config.yml")
        result = at.path("evals", f"{stage.form}.json")
        return [tool("ns-eval"), "--load-config", str(config), "--output-path", str(result)]
    command = [tool("bitymi"), "bench", "pictures", "--load-config", str(at.config)]
    return [*command, "--output-dir", str(at.path("pictures")), "--views", str(stage.count)]


def prepare(work: Path, stage: Stage) -> Path:
    """Remove what an earlier attempt left; returns the log file of the cell."""
    at = Layout(work, stage.run)
    folder = {
        "train": at.path("runs"),
        "export": at.path("bundles", stage.form),
        "eval": at.path("evals"),
        "pictures": at.path("pictures"),
    }[stage.kind]
    if stage.kind == "eval":  # its folder holds the results of other evaluations
        folder.mkdir(parents=True, exist_ok=True)
    else:
        shutil.rmtree(folder, ignore_errors=True)
    return at.path("logs", f"{stage.kind}-{stage.form}.log")


def read_result(work: Path, stage: Stage) -> dict[str, Any]:
    """Read the figures that a finished command left.

    train: `steps`, `seconds` and `cpu_seconds` of the training steps alone (no loading, evaluation or saving),
    `surfels`, `fragments`, `curve`. export: `bytes` and `files` of the bundle, its `statistics`. eval: nerfstudio's
    `results`, means over the held-out views. pictures: what that command wrote.

    Raises:
        CommandFailed: there are none.
    """
    at = Layout(work, stage.run)
    reader: dict[str, Callable[[Layout, Stage], dict[str, Any]]] = {
        "train": _train, "export": _export, "eval": _evaluation, "pictures": _pictures,
    }  # fmt: skip
    try:
        return without_nan(reader[stage.kind](at, stage))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CommandFailed(f"{stage}: the command left no figures that can be read: {error}") from error


def _train(at: Layout, stage: Stage) -> dict[str, Any]:
    folder = {"folder": at.relative(at.path("runs"))}
    if not stage.run.row.ours:
        return folder
    curve = at.path("runs", CURVE)
    last = read_curve(curve)[-1]
    figures = {name: last[name] for name in ("seconds", "cpu_seconds", "surfels")}
    curve_path = {"curve": at.relative(curve)}
    return {"steps": last["step"], **figures, "fragments": last.get("fragments"), **folder, **curve_path}


def _export(at: Layout, stage: Stage) -> dict[str, Any]:
    from bitymi_ns.bundle.read import download_bytes, read_manifest  # imports torch, which other methods do without

    folder = at.path("bundles", stage.form)
    info = read_manifest(folder)
    compact = info.surfels.columns is not None
    return {
        "folder": at.relative(folder),
        "bytes": download_bytes(folder, info),
        "files": {name: entry.bytes for name, entry in info.files.items()},
        "format": None if info.atlas is None else "compact" if compact else info.atlas.format,
        "statistics": info.statistics.model_dump(mode="json"),
    }


def _evaluation(at: Layout, stage: Stage) -> dict[str, Any]:
    results = json_of(at.path("evals", f"{stage.form}.json").read_text("utf8"))["results"]
    if not isinstance(results, dict) or "psnr" not in results:
        raise ValueError("no psnr in it")
    return {"results": results}


def _pictures(at: Layout, stage: Stage) -> dict[str, Any]:
    folder = at.path("pictures")
    return {"folder": at.relative(folder), "views": len(json_of((folder / "pictures.json").read_text("utf8"))["views"])}


def read_curve(path: Path) -> list[dict[str, Any]]:
    """Read the points of a training curve, by step; a line that a killed run left unfinished is skipped.

    Raises:
        CommandFailed: there are none.
    """
    points = {}
    for line in path.read_text("utf8").splitlines() if path.is_file() else []:
        try:
            point = json_of(line)
            points[point["step"]] = point
        except (ValueError, KeyError, TypeError):
            continue
    if not points:
        raise CommandFailed(f"{path} holds no point of a training curve")
    return [points[step] for step in sorted(points)]


def open_cells(work: Path) -> Cells:
    """The finished cells of a work folder."""
    return Cells(work / FILE)


def _needs(stage: Stage, other: Stage) -> bool:
    """True if `stage` cannot be done without `other`, of the same run."""
    if other.kind == "train":
        return stage.kind != "train"
    return other.kind == "export" and stage.kind == "eval" and stage.bundle == other.bundle


def missing(chain: Chain, cells: Cells) -> list[Stage]:
    """The cells of a run that are to be done: those without a line, and those that need one of these.

    A training that is done again makes the evaluations of the earlier one obsolete.
    """
    pending: list[Stage] = []
    for stage in chain:
        if cells.get(stage.key) is None or any(_needs(stage, other) for other in pending):
            pending.append(stage)
    return pending


@contextmanager
def locked(work: Path, run: Run) -> Iterator[Lock]:
    """Hold a run, so that no other process works in its folders.

    Raises:
        CommandFailed: another process holds it.
    """
    path = work / "locks" / f"{run.folder.replace('/', '--')}.lock"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = Lock(path, say)
    except Busy as error:
        raise CommandFailed(f"{run}: {error}") from error
    except OSError as error:
        raise BenchError(f"{work} cannot be written: {reason(error, work)}, with --work") from error
    with lock:
        yield lock


def _run_stage(work: Path, stage: Stage, cells: Cells, lock: Lock) -> None:
    command = stage_command(work, stage)
    start = time.perf_counter()
    cost = run_measured(command, prepare(work, stage), lock)
    value = {**read_result(work, stage), **cost}
    cells.add(stage.key, value, provenance(command, time.perf_counter() - start))


def _run_chain(work: Path, chain: Chain, cells: Cells, told: Callable[[Stage], None]) -> list[str]:
    """Do the missing cells of a run in order, but none that needs a cell that failed; returns a message per failure."""
    failures: list[str] = []
    broken: list[Stage] = []
    with locked(work, chain[0].run) as lock:
        cells.refresh()
        for stage in missing(chain, cells):
            if any(_needs(stage, other) for other in broken):
                broken.append(stage)
                continue
            told(stage)
            try:
                _run_stage(work, stage, cells, lock)
            except CommandFailed as error:
                broken.append(stage)
                failures.append(f"{stage} failed: {error}")
    return failures


def run_chains(work: Path, chains: Sequence[Chain]) -> list[str]:
    """Do the missing cells of run after run.

    Args:
        work: folder of runs and finished cells.
        chains: the cells of each run.

    Returns:
        One message for every cell that failed and every run that another process holds.

    Raises:
        BenchError: there is nothing to run.
    """
    if not any(chains):
        raise BenchError("nothing to run: there is no scene, or no method")
    cells = open_cells(work)
    total = sum(map(len, chains))
    done = total - sum(len(missing(chain, cells)) for chain in chains)
    if done:
        say(f"{done} of {total} cells are finished already")

    def told(stage: Stage) -> None:
        left = [other for chain in chains for other in missing(chain, cells)]
        say(f"{stage} ({total - len(left) + 1} of {total}{time_left(left, cells)})")

    failures: list[str] = []
    for chain in chains:
        if not missing(chain, cells):
            continue
        try:
            failures += _run_chain(work, chain, cells, told)
        except CommandFailed as error:
            failures.append(str(error))
    return failures


def time_left(stages: Iterable[Stage], cells: Cells) -> str:
    """Estimate the time that cells take from the mean of finished ones of the same kind, scene and number of steps,
    else of the same kind; empty while a kind has none."""
    known: dict[tuple, list[float]] = {}
    for cell in cells:
        key, seconds = cell["key"], cell.get("made", {}).get("seconds")
        if isinstance(seconds, (int, float)):
            kind = (key.get("cell"), key.get("bundle"))
            for of in (kind, (*kind, key.get("scene"), key.get("steps"))):
                known.setdefault(of, []).append(float(seconds))
    total = 0.0
    for stage in stages:
        kind = (stage.kind, stage.bundle.name if stage.bundle else None)
        alike = known.get((*kind, stage.run.scene.name, stage.run.steps)) or known.get(kind)
        if not alike:
            return ""
        total += statistics.fmean(alike)
    return f", about {total / 60:.0f} min left" if total < 5400 else f", about {total / 3600:.1f} h left"
