"""Records of a report and the links between them: evaluations, training curves."""

import re
import statistics
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bitymi_ns.bundle.manifest import MANIFEST
from bitymi_ns.trust import finite_numbers

_BUNDLE_SUFFIX = re.compile(r"[-_]?(bundle|baked)$")
_FORMAT = re.compile(r"(?<![a-z0-9])(fp16|uint8|bc7|compact)(?![a-z0-9])")


class ReportError(ValueError):
    """The report cannot be made; the message names the input at fault and what to do."""


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of a model on the held-out views."""

    scene: str  # experiment name; evaluations are compared within one scene
    method: str  # method name without a suffix for baking, so that a bundle shares it with its trained scene
    baked: bool  # True for a bundle
    label: str  # for tables, unique within its scene and stage after `disambiguate`
    results: dict[str, float]  # finite numbers by name (psnr, ssim, render_ms, atlas_bytes, ...)
    checkpoint: str  # recorded path of the checkpoint, may be empty
    source: Path  # file it was read from
    run: str = ""  # identity of the training run, empty if unknown (a bare ns-eval file)
    group: str = ""  # label without the seed; empty: not grouped over seeds
    series: str = ""  # run without the seed
    seed: int | None = None  # of the training, None if not stated


@dataclass(frozen=True)
class Curve:
    """Training curve: points by step, each a dict of finite numbers with at least `step`."""

    scene: str
    label: str
    points: list[dict[str, float]]
    source: Path
    run: str = ""

    def series(self, x: str, y: str) -> tuple[list[float], list[float]]:
        """Return the columns x and y of the points that have both."""
        pairs = [(p[x], p[y]) for p in self.points if x in p and y in p]
        return [a for a, _ in pairs], [b for _, b in pairs]

    def last(self, key: str) -> float | None:
        """Return the last recorded value of `key`, or None."""
        return next((p[key] for p in reversed(self.points) if key in p), None)


@dataclass
class Records:
    """All records read, with notes on skipped inputs."""

    evaluations: list[Evaluation] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    images: list[Path] = field(default_factory=list)  # photographs beside renders, as ns-eval writes them
    machines: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def evaluation_from(data: dict[str, Any], source: Path) -> Evaluation:
    """Build an evaluation from ns-eval's JSON object."""
    results = finite_numbers(data["results"])
    checkpoint = str(data.get("checkpoint") or "")
    name = str(data.get("method_name") or "unnamed method")
    parts = Path(checkpoint.replace("\\", "/")).parts
    tail = "/".join(parts[-2 if parts[-1:] == (MANIFEST,) else -4 :]).lower()
    baked = "bundle_bytes" in results or results.get("atlas_bytes", 0.0) > 0  # which earlier versions stated alone
    method = (_BUNDLE_SUFFIX.sub("", name) or name) if baked else name
    form = _FORMAT.search(tail) or _FORMAT.search(f"{source.parent.name}/{source.stem}".lower())
    label = f"{method}, {form[1]}" if baked and form else method
    scene = str(data.get("experiment_name") or source.parent.name or "unnamed scene")
    return Evaluation(scene, method, baked, label, results, checkpoint, source)


def curve_from(lines: list[dict[str, Any]], source: Path) -> Curve:
    """Build a curve from the objects of a JSONL file.

    If a step occurs twice (a resumed run), its last line is used. Scene and label come from the lines
    (`experiment_name`, `method_name`), nerfstudio's folders <experiment>/<method>/<time>, or the file's name.
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


def link(records: Records) -> None:
    """Link records: name curves after the evaluation whose checkpoint is in their folder, make labels unique, and add
    missing training times to evaluations from the only curve of their scene and method."""
    for i, curve in enumerate(records.curves):
        folder = str(curve.source.resolve().parent)
        parents = (e for e in records.evaluations if not curve.run and not e.baked and e.checkpoint)
        owner = next((e for e in parents if folder in map(str, Path(e.checkpoint).parents)), None)
        if owner:
            records.curves[i] = replace(curve, scene=owner.scene, label=owner.method)
    disambiguate(records.evaluations)
    disambiguate(records.curves)
    for i, row in enumerate(records.evaluations):
        curves = [c for c in records.curves if (c.scene, c.label) == (row.scene, row.method)]
        if "train_seconds" in row.results or len(curves) != 1:
            continue
        times = {f"train_{key}": curves[0].last(key) for key in ("seconds", "cpu_seconds")}
        known = {key: value for key, value in times.items() if value is not None}
        records.evaluations[i] = replace(row, results={**row.results, **known})


def over_seeds(evaluations: list[Evaluation]) -> list[Evaluation]:
    """Average runs that differ only in their seed; `psnr_seeds` is the standard deviation of their PSNR.

    `psnr_delta` of bundles, their PSNR minus that of the trained scene, is computed per run before averaging.
    """
    deltas = [psnr_delta(row, evaluations) for row in evaluations]
    evaluations = [
        row if delta is None else replace(row, results={**row.results, "psnr_delta": delta})
        for row, delta in zip(evaluations, deltas, strict=True)
    ]
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
            means["psnr_seeds"] = statistics.stdev(row.results["psnr"] for row in rows)
        first = rows[0]
        label = f"{first.group} ({len(rows)} seeds)"
        merged.append(replace(first, label=label, results=means, run=first.series, seed=None))
    return merged


def psnr_delta(row: Evaluation, evaluations: list[Evaluation]) -> float | None:
    """Compute the PSNR of a bundle minus that of its trained scene; None if unknown."""
    known = row.results.get("psnr_delta")
    if known is not None:
        return known
    parent = trained_parent(row, evaluations)
    before, after = (parent.results.get("psnr") if parent else None), row.results.get("psnr")
    return None if before is None or after is None else after - before


def trained_parent(row: Evaluation, evaluations: list[Evaluation]) -> Evaluation | None:
    """Find the evaluation of a bundle's trained scene: of the same scene, method and run; if there are several, the one
    whose file is in the same folder. None if ambiguous."""
    same = [e for e in evaluations if not e.baked and (e.scene, e.method, e.run) == (row.scene, row.method, row.run)]
    if len(same) > 1:
        same = [e for e in same if e.source.parent == row.source.parent]
    return same[0] if row.baked and len(same) == 1 else None


def _suffixes(sources: list[Path]) -> list[str]:
    """Return the last component of each path in which all paths differ."""
    parts = [[*path.resolve().parts[:-1], path.stem] for path in sources]
    for depth in range(1, max(map(len, parts)) + 1):
        pieces = [p[-depth] if len(p) >= depth else "" for p in parts]
        if len(set(pieces)) == len(pieces):
            return pieces
    return [str(i + 1) for i in range(len(sources))]


def disambiguate(items: list) -> None:
    """Make the labels of evaluations (within a scene and stage) or curves (within a scene) unique, in place."""
    groups: dict[tuple, list[int]] = {}
    for i, item in enumerate(items):
        groups.setdefault((item.scene, getattr(item, "baked", None), item.label), []).append(i)
    for indices in groups.values():
        if len(indices) > 1:
            for i, suffix in zip(indices, _suffixes([items[i].source for i in indices]), strict=True):
                items[i] = replace(items[i], label=f"{items[i].label} ({suffix})")
