"""The commands behind the cells: nerfstudio's own console scripts, and `bitymi` for pictures and knobs."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bitymi_ns.measure.bench.cells import without_nan
from bitymi_ns.measure.bench.matrix import Run, Stage
from bitymi_ns.measure.bench.process import CommandFailed, Cost, tool
from bitymi_ns.trust import json_of

CURVE = "training_curve.jsonl"


def seed_options(run: Run) -> list[str]:
    """Options of ns-train that make the seed hold everywhere."""
    if run.seed is None:
        return []
    options = ["--machine.seed", str(run.seed)]
    if run.row.ours:
        options += ["--pipeline.model.train.seed", str(run.seed)]
        options += ["--pipeline.datamanager.train-cameras-sampling-seed", str(run.seed)]
    return options


class Layout:
    """Where the files of a run lie below the work folder."""

    def __init__(self, work: Path, run: Run) -> None:
        self.work = work
        self.run = run

    def place(self, what: str, *parts: str) -> Path:
        """A path below one of the work folder's parts: runs, bundles, evals, pictures, knobs, logs."""
        return self.work.joinpath(what, self.run.folder, *parts)

    @property
    def config(self) -> Path:
        """config.yml of the trained run."""
        return self.place("runs", "config.yml")

    def relative(self, path: Path) -> str:
        """A path as a cell records it."""
        return path.relative_to(self.work).as_posix()


def train_command(work: Path, run: Run) -> list[str]:
    """ns-train without viewer."""
    command = [tool("ns-train"), run.row.method, "--output-dir", str(work / "runs")]
    command += ["--experiment-name", run.scene.name, "--timestamp", run.name, "--vis", "none"]
    if run.steps is not None:
        command += ["--max-num-iterations", str(run.steps)]
    command += [*seed_options(run), *run.row.options]
    if not run.scene.parser:
        return [*command, "--data", str(run.scene.data)]
    parser, *options = run.scene.parser
    return [*command, parser, "--data", str(run.scene.data), *options]


def stage_command(work: Path, stage: Stage) -> list[str]:
    """The command line of a cell."""
    at = Layout(work, stage.run)
    if stage.kind == "train":
        return train_command(work, stage.run)
    if stage.kind == "export":
        assert stage.bundle is not None
        command = [tool("ns-export"), "bitymi-atlas", "--load-config", str(at.config)]
        return [*command, "--output-dir", str(at.place("bundles", stage.form)), *stage.bundle.options]
    if stage.kind == "eval":
        config = at.config if stage.bundle is None else at.place("bundles", stage.form, "config.yml")
        result = at.place("evals", f"{stage.form}.json")
        return [tool("ns-eval"), "--load-config", str(config), "--output-path", str(result)]
    command = [tool("bitymi"), "bench", stage.kind, "--load-config", str(at.config)]
    if stage.kind == "pictures":
        return [*command, "--output-dir", str(at.place("pictures")), "--views", str(stage.count)]
    return [*command, "--output", str(at.place("knobs", "knobs.jsonl"))]


def prepare(work: Path, stage: Stage) -> Path:
    """Remove what an earlier attempt left; returns the log file of the cell."""
    at = Layout(work, stage.run)
    if stage.kind == "train":
        shutil.rmtree(at.place("runs"), ignore_errors=True)
    elif stage.kind == "export":
        shutil.rmtree(at.place("bundles", stage.form), ignore_errors=True)
    elif stage.kind == "pictures":
        shutil.rmtree(at.place("pictures"), ignore_errors=True)
    elif stage.kind == "knobs":
        at.place("knobs", "knobs.jsonl").unlink(missing_ok=True)
        at.place("knobs").mkdir(parents=True, exist_ok=True)
    else:
        at.place("evals").mkdir(parents=True, exist_ok=True)
    return at.place("logs", f"{stage.kind}-{stage.form}.log")


def read_result(work: Path, stage: Stage, cost: Cost) -> dict[str, Any]:
    """The figures of a finished command.

    train: `steps`, `seconds` and `cpu_seconds` of the training steps alone (the run's own clock: no loading,
    evaluation or saving), `surfels`, `fragments`, `curve`. export: `bytes` and `files` of the bundle, its `statistics`.
    eval: nerfstudio's `results`, means over the held-out views. pictures, knobs: what these commands wrote. Every one
    has `process_seconds`, `process_cpu_seconds` and `peak_bytes` of its whole command.

    Raises:
        CommandFailed: the command ended well and left no figures.
    """
    at = Layout(work, stage.run)
    reader: dict[str, Callable[[Layout, Stage], dict[str, Any]]] = {
        "train": _train, "export": _export, "eval": _evaluation, "pictures": _pictures, "knobs": _knobs,
    }  # fmt: skip
    try:
        figures = reader[stage.kind](at, stage)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CommandFailed(f"{stage}: the command left no figures that can be read: {error}") from error
    return without_nan({**figures, **cost.as_dict()})


def _train(at: Layout, stage: Stage) -> dict[str, Any]:
    if not stage.run.row.ours:
        return {"folder": at.relative(at.place("runs"))}
    curve = at.place("runs", CURVE)
    last = read_curve(curve)[-1]
    names = ("seconds", "cpu_seconds", "surfels")
    return {
        "steps": last["step"],
        **{name: last[name] for name in names},
        "fragments": last.get("fragments"),
        "folder": at.relative(at.place("runs")),
        "curve": at.relative(curve),
    }


def _export(at: Layout, stage: Stage) -> dict[str, Any]:
    # with torch, which the stages of other methods do without
    from bitymi_ns.bundle.read import download_bytes, read_manifest

    folder = at.place("bundles", stage.form)
    info = read_manifest(folder)
    files = {name: entry.bytes for name, entry in info.files.items()}
    return {
        "folder": at.relative(folder),
        "bytes": download_bytes(folder, info),
        "files": files,
        "format": _format(info),
        "statistics": info.statistics.model_dump(mode="json"),
    }


def _format(info: Any) -> str | None:
    """What `--format` calls it; None = there is no atlas."""
    if info.atlas is None:
        return None
    return info.atlas.format if info.surfels.columns is None else "compact"


def _evaluation(at: Layout, stage: Stage) -> dict[str, Any]:
    results = json_of(at.place("evals", f"{stage.form}.json").read_text("utf8"))["results"]
    if not isinstance(results, dict) or "psnr" not in results:
        raise ValueError("no psnr in it")
    return {"results": results}


def _pictures(at: Layout, stage: Stage) -> dict[str, Any]:
    folder = at.place("pictures")
    pictures = json_of((folder / "pictures.json").read_text("utf8"))["views"]
    return {"folder": at.relative(folder), "views": len(pictures)}


def _knobs(at: Layout, stage: Stage) -> dict[str, Any]:
    lines = at.place("knobs", "knobs.jsonl").read_text("utf8").splitlines()
    points = [json_of(line) for line in lines if line.strip()]
    if not points:
        raise ValueError("no line in knobs.jsonl")
    return {"points": points}


def read_curve(path: Path) -> list[dict[str, Any]]:
    """The points of a training curve, by step; a line that a killed run left unfinished is skipped.

    Raises:
        CommandFailed: there are none.
    """
    points = {}
    if path.is_file():
        for line in path.read_text("utf8").splitlines():
            try:
                point = json_of(line)
                points[point["step"]] = point
            except (ValueError, KeyError, TypeError):
                continue
    if not points:
        raise CommandFailed(f"{path} holds no point of a training curve")
    return [points[step] for step in sorted(points)]
