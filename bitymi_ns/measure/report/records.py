"""What a report is made of: evaluations written by ns-eval and training curves, read from files."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

MAX_JSON_BYTES = 4 << 20
"""An ns-eval file has about a kilobyte; a larger JSON file is something else."""
MAX_JSONL_BYTES = 64 << 20
"""Largest training curve that is read."""

_BUNDLE = re.compile(r"(?<![a-z])(bundle|baked)(?![a-z])")
_BUNDLE_SUFFIX = re.compile(r"[-_]?(bundle|baked)$")
_FORMAT = re.compile(r"(?<![a-z0-9])(fp16|uint8|bc7|compact)(?![a-z0-9])")


class ReportError(Exception):
    """A report cannot be made; the message says which input is at fault and what to do."""


@dataclass(frozen=True)
class Evaluation:
    """One evaluation of a model on the held-out views.

    Attributes:
        scene: the experiment's name; evaluations are compared within one scene.
        method: method name without any mark of baking, so that a bundle shares it with its trained parent.
        baked: whether the images came from a baked bundle.
        label: the name shown in tables, unique within its scene and stage after `disambiguate`.
        results: finite numbers by name (psnr, ssim, render_ms, atlas_bytes, ...).
        checkpoint: path of the checkpoint as recorded, possibly empty.
        source: the file that it was read from.
        run: what tells its training run from others, empty when unknown (a bare ns-eval file).
        group: its label without the seed; empty = it has none.
        series: its run without the seed.
        seed: of its training, None when not stated.
        preset: the method's name in ns-train, and options: what was given beside it.
        suite: the standard data set that the scene is from, `local`, or empty when unknown.
        atlas_format: of a bundle, empty when unknown.
        seeds: number of runs that it is the mean of.
    """

    scene: str
    method: str
    baked: bool
    label: str
    results: dict[str, float]
    checkpoint: str
    source: Path
    run: str = ""
    group: str = ""
    series: str = ""
    seed: int | None = None
    preset: str = ""
    options: tuple[str, ...] = ()
    suite: str = ""
    atlas_format: str = ""
    seeds: int = 1

    def get(self, key: str) -> float | None:
        """The result of that name, or None when it is missing or was not finite."""
        return self.results.get(key)


@dataclass(frozen=True)
class Curve:
    """One training run as it went: a list of points, each a dict of finite numbers with at least `step`."""

    scene: str
    label: str
    points: list[dict[str, float]]
    source: Path
    run: str = ""

    def series(self, x: str, y: str) -> tuple[list[float], list[float]]:
        """The points that have both numbers, in order of steps."""
        pairs = [(p[x], p[y]) for p in self.points if x in p and y in p]
        return [a for a, _ in pairs], [b for _, b in pairs]

    def last(self, key: str) -> float | None:
        """The last recorded value of `key`."""
        return next((p[key] for p in reversed(self.points) if key in p), None)

    def best(self, key: str) -> float | None:
        """The largest recorded value of `key`."""
        return max((p[key] for p in self.points if key in p), default=None)


@dataclass(frozen=True)
class KnobPoint:
    """What one setting of a quality knob costs and saves; `figures` has finite numbers: max_steps, mean_steps (errors
    against the exact setting in 8-bit steps), psnr_exact, psnr, ms, cpu_ms, bytes."""

    scene: str
    run: str
    knob: str
    value: str
    renderer: str
    exact: bool
    default: bool
    against: str
    figures: dict[str, float]


@dataclass(frozen=True)
class WorstView:
    """Pictures of one of the worst held-out views of a run: (caption, file) in order."""

    scene: str
    run: str
    title: str
    pictures: tuple[tuple[str, Path], ...]


@dataclass(frozen=True)
class FoundPoses:
    """How the poses of one capture were found.

    Attributes:
        source: the photographs or the video.
        numbers: registered, given, reprojection_error, track_length, points, ...: those that are finite.
        seconds: of every stage.
        left_out: photographs without a pose, and why; notes: what else there is to say of photographs.
        frame: where up and scale come from.
        file: the report.json that was read; the picture lies beside it.
    """

    source: str
    numbers: dict[str, float]
    seconds: dict[str, float]
    left_out: dict[str, str]
    notes: dict[str, str]
    frame: str
    file: Path


@dataclass
class Records:
    """Everything that was read, with notes on what was skipped and why."""

    evaluations: list[Evaluation] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    images: list[Path] = field(default_factory=list)
    knobs: list[KnobPoint] = field(default_factory=list)
    worst: list[WorstView] = field(default_factory=list)
    poses: list[FoundPoses] = field(default_factory=list)
    machines: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def finite_numbers(values: dict[str, Any]) -> dict[str, float]:
    """The entries of a JSON object that are finite numbers; NaN, infinities, text and nested values are left out."""
    numbers = {}
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            continue
        try:
            number = float(value)
        except OverflowError:  # an integer beyond the range of a double
            continue
        if math.isfinite(number):
            numbers[key] = number
    return numbers


def parse_json(text: str, where: str) -> Any:
    """Parse JSON (NaN and Infinity tokens allowed).

    Raises:
        ReportError: with the file, line, column and reason.
    """
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        reason = "it is empty" if not text.strip() else f"{error.msg} at line {error.lineno}, column {error.colno}"
    except RecursionError:
        reason = "it is nested too deeply"
    except ValueError as error:  # an integer with thousands of digits
        reason = str(error)
    raise ReportError(f"{where} is not valid JSON: {reason}. Write it again, or leave it out.") from None


def read_text(path: Path, limit: int) -> str:
    """The text of a file of at most `limit` bytes; what goes wrong becomes a ReportError naming the file."""
    try:
        size = path.stat().st_size
        if size > limit:
            raise ReportError(f"{path} is too large ({size:,} bytes) for an evaluation or a training curve.")
        return path.read_text("utf8")
    except UnicodeDecodeError:
        raise ReportError(f"{path} is not a text file (it is not UTF-8).") from None
    except OSError as error:
        raise ReportError(f"{path} cannot be read: {error.strerror or error}.") from None


def is_evaluation(data: Any) -> bool:
    """Whether a JSON value has ns-eval's shape."""
    return isinstance(data, dict) and isinstance(data.get("results"), dict)


def is_point(data: Any) -> bool:
    """Whether a JSON value is a line of a training curve."""
    return isinstance(data, dict) and "step" in finite_numbers(data)


def is_bundle_name(name: str) -> bool:
    """Whether a method, folder or path is called after a bundle."""
    return _BUNDLE.search(name.lower()) is not None


def evaluation_from(data: dict[str, Any], source: Path) -> Evaluation:
    """Build an evaluation from ns-eval's JSON object."""
    results = finite_numbers(data["results"])
    checkpoint = str(data.get("checkpoint") or "")
    name = str(data.get("method_name") or "unnamed method")
    # Of the checkpoint only .../<folder>/<folder>/nerfstudio_models/step-*.ckpt counts: not the name of some data set.
    tail = "/".join(Path(checkpoint.replace("\\", "/")).parts[-4:]).lower()
    baked = results.get("atlas_bytes", 0.0) > 0 or is_bundle_name(name) or is_bundle_name(tail)
    method = (_BUNDLE_SUFFIX.sub("", name) or name) if baked else name
    atlas_format = _FORMAT.search(tail) or _FORMAT.search(f"{source.parent.name}/{source.stem}".lower())
    return Evaluation(
        scene=str(data.get("experiment_name") or source.parent.name or "unnamed scene"),
        method=method,
        baked=baked,
        label=f"{method}, {atlas_format[1]}" if baked and atlas_format else method,
        results=results,
        checkpoint=checkpoint,
        source=source,
        preset=method,
        atlas_format=atlas_format[1] if baked and atlas_format else "",
    )


def curve_from(lines: list[dict[str, Any]], source: Path) -> Curve:
    """Build a curve from the objects of a JSONL file.

    A step that occurs twice (a resumed run) keeps its last line. Scene and label come from the lines themselves
    (`experiment_name`, `method_name`) or from nerfstudio's folders <experiment>/<method>/<time>, else from the file.
    """
    points: dict[float, dict[str, float]] = {}
    for line in lines:
        numbers = finite_numbers(line)
        points[numbers["step"]] = numbers
    named = {key: value for line in lines for key, value in line.items() if isinstance(value, str) and value}
    scene, label = named.get("experiment_name", ""), named.get("method_name", "")
    if not (scene and label) and (source.parent / "config.yml").is_file() and len(source.resolve().parts) > 4:
        experiment, method = source.resolve().parts[-4:-2]
        scene, label = scene or experiment, label or method
    return Curve(scene, label or source.stem, [points[step] for step in sorted(points)], source)


def read_json(path: Path) -> Any:
    """What a JSON file holds."""
    return parse_json(read_text(path, MAX_JSON_BYTES), str(path))


def read_lines(path: Path) -> tuple[list[tuple[int, Any]], list[str]]:
    """The values of a JSONL file with their line numbers, and notes.

    A last line that is cut off (a run that was killed while it wrote) is left out with a note; an earlier broken line
    is an error.
    """
    numbered = [(i, s) for i, s in enumerate(read_text(path, MAX_JSONL_BYTES).splitlines(), 1) if s.strip()]
    values, notes = [], []
    for position, (number, line) in enumerate(numbered):
        try:
            values.append((number, parse_json(line, f"{path}, line {number},")))
        except ReportError:
            if position + 1 < len(numbered) or position == 0:
                raise
            notes.append(f"{path}: the last line is cut off and was left out.")
    return values, notes


def read_jsonl(path: Path) -> tuple[list[Evaluation], list[Curve], list[str]]:
    """Evaluations, the curve and notes of a JSONL file; all empty when it holds something else."""
    numbered, notes = read_lines(path)
    values = [value for _, value in numbered]
    evaluations = [evaluation_from(value, path) for value in values if is_evaluation(value)]
    points = [value for value in values if is_point(value) and not is_evaluation(value)]
    return evaluations, [curve_from(points, path)] if points else [], notes


def link_curves(curves: list[Curve], evaluations: list[Evaluation]) -> list[Curve]:
    """Name curves after the evaluation whose checkpoint lies in the curve's folder (the run that wrote both)."""
    linked = []
    for curve in curves:
        if curve.run:  # named by its cell
            linked.append(curve)
            continue
        folder = str(curve.source.resolve().parent)
        parents = (e for e in evaluations if not e.baked and e.checkpoint)
        owner = next((e for e in parents if folder in map(str, Path(e.checkpoint).parents)), None)
        linked.append(replace(curve, scene=owner.scene, label=owner.method) if owner else curve)
    return linked


def add_training_time(records: Records) -> None:
    """Give evaluations without it the training time of the one curve of their scene and method."""
    for i, row in enumerate(records.evaluations):
        curves = [c for c in records.curves if (c.scene, c.label) == (row.scene, row.method)]
        if "train_seconds" in row.results or len(curves) != 1:
            continue
        times = {f"train_{key}": curves[0].last(key) for key in ("seconds", "cpu_seconds")}
        known = {key: value for key, value in times.items() if value is not None}
        records.evaluations[i] = replace(row, results={**row.results, **known})


def over_seeds(evaluations: list[Evaluation]) -> list[Evaluation]:
    """Means over runs that differ in their seed alone, with `psnr_seeds`, the standard deviation of their PSNR.

    Baked ones have `psnr_delta`, their PSNR minus that of the trained scene: of the same run each, before the mean.
    """
    evaluations = [_with_delta(row, evaluations) for row in evaluations]
    groups: dict[tuple, list[Evaluation]] = {}
    for i, row in enumerate(evaluations):
        key = (row.scene, row.baked, row.group, row.series) if row.group else (i,)
        groups.setdefault(key, []).append(row)
    merged = []
    for rows in groups.values():
        if len(rows) == 1:
            merged.append(rows[0])
            continue
        keys = set.intersection(*(set(row.results) for row in rows))
        means = {key: sum(row.results[key] for row in rows) / len(rows) for key in sorted(keys)}
        if "psnr" in means:
            squares = sum((row.results["psnr"] - means["psnr"]) ** 2 for row in rows)
            means["psnr_seeds"] = math.sqrt(squares / (len(rows) - 1))
        first = rows[0]
        label = f"{first.group} ({len(rows)} seeds)"
        merged.append(replace(first, label=label, results=means, run=first.series, seed=None, seeds=len(rows)))
    return merged


def _with_delta(row: Evaluation, evaluations: list[Evaluation]) -> Evaluation:
    delta = psnr_delta(row, evaluations)
    return row if delta is None else replace(row, results={**row.results, "psnr_delta": delta})


def psnr_delta(row: Evaluation, evaluations: list[Evaluation]) -> float | None:
    """PSNR of a baked evaluation minus that of its trained parent."""
    known = row.get("psnr_delta")
    if known is not None:
        return known
    parent = trained_parent(row, evaluations)
    before, after = (parent.get("psnr") if parent else None), row.get("psnr")
    return None if before is None or after is None else after - before


def _suffixes(sources: list[Path]) -> list[str]:
    """The shortest piece of each path, folder or stem, that tells equal names apart."""
    parts = [[*path.resolve().parts[:-1], path.stem] for path in sources]
    for depth in range(1, max(map(len, parts)) + 1):
        pieces = [p[-depth] if len(p) >= depth else "" for p in parts]
        if len(set(pieces)) == len(pieces):
            return pieces
    return [str(i + 1) for i in range(len(sources))]


def disambiguate(records: Records) -> None:
    """Give evaluations (within a scene and stage) and curves (within a scene) labels that are unique."""
    for items in (records.evaluations, records.curves):
        groups: dict[tuple, list[int]] = {}
        for i, item in enumerate(items):
            groups.setdefault((item.scene, getattr(item, "baked", None), item.label), []).append(i)
        for indices in groups.values():
            if len(indices) > 1:
                for i, suffix in zip(indices, _suffixes([items[i].source for i in indices]), strict=True):
                    items[i] = replace(items[i], label=f"{items[i].label} ({suffix})")


def trained_parent(row: Evaluation, evaluations: list[Evaluation]) -> Evaluation | None:
    """The trained evaluation that a baked one is compared with.

    That of the same run where that is known; else of the same scene and method, and of several the one whose file lies
    in the same folder. None when that leaves a doubt.
    """
    same = [e for e in evaluations if not e.baked and (e.scene, e.method, e.run) == (row.scene, row.method, row.run)]
    if len(same) > 1:
        same = [e for e in same if e.source.parent == row.source.parent]
    return same[0] if row.baked and len(same) == 1 else None
