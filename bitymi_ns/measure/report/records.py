"""Records of a report and the links between them."""

import os
import statistics
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from bitymi_ns.trust import finite_numbers

T = TypeVar("T")
K = TypeVar("K", bound=Hashable)


class ReportError(ValueError):
    """The report cannot be made; the message names the input and what to do."""


@dataclass(frozen=True)
class Evaluation:
    """Evaluation of a trained scene or a bundle on the held-out views."""

    scene: str  # experiment name
    method: str  # which a bundle shares with its trained scene
    baked: bool  # True for a bundle
    label: str  # unique within its scene and stage after `disambiguate`
    results: dict[str, float]  # finite numbers
    source: Path
    group: str = ""  # label without the seed; empty: not grouped over seeds
    series: str = ""  # identity of the training run without its seed


@dataclass(frozen=True)
class Curve:
    """Training curve."""

    scene: str
    label: str
    points: list[dict[str, float]]  # in the order of their `step`; finite numbers
    source: Path

    def series(self, x: str, y: str) -> tuple[list[float], list[float]]:
        """Return the columns x and y of the points that have both."""
        points = [p for p in self.points if x in p and y in p]
        return [p[x] for p in points], [p[y] for p in points]

    def last(self, key: str) -> float | None:
        return next((p[key] for p in reversed(self.points) if key in p), None)


@dataclass
class Records:
    """Everything read, with notes on skipped inputs."""

    evaluations: list[Evaluation] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    images: list[Path] = field(default_factory=list)  # photographs beside renders
    machines: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def evaluation_from(data: dict[str, Any], source: Path) -> Evaluation:
    """Build an evaluation from ns-eval's JSON."""
    results = finite_numbers(data["results"])
    method = str(data.get("method_name") or "unnamed method")
    scene = str(data.get("experiment_name") or source.parent.name or "unnamed scene")
    return Evaluation(scene, method, "bundle_bytes" in results, method, results, source)


def curve_from(lines: list[dict[str, Any]], source: Path) -> Curve:
    """Build a curve from the objects of a JSONL file. If a step occurs twice (a resumed run), its last line is used."""
    points = {numbers["step"]: numbers for numbers in map(finite_numbers, lines)}
    named = {key: value for line in lines for key, value in line.items() if isinstance(value, str) and value}
    scene, label = named.get("experiment_name", ""), named.get("method_name", source.stem)
    return Curve(scene, label, [points[step] for step in sorted(points)], source)


def link(records: Records) -> None:
    """Make labels unique; add to evaluations of files the training times of the only curve of their scene and method,
    and to bundles the difference from their trained scene (`psnr_delta`): the only one of the same scene and method, or
    in the same folder."""
    disambiguate(records.evaluations)
    disambiguate(records.curves)
    of_files = [row for row in records.evaluations if not row.series]  # those of a benchmark state both
    for i, row in enumerate(records.evaluations):
        if row.series:
            continue
        known: dict[str, float | None] = {}
        curves = [c for c in records.curves if (c.scene, c.label) == (row.scene, row.method)]
        if len(curves) == 1:
            known = {f"train_{key}": curves[0].last(key) for key in ("seconds", "cpu_seconds")}
        trained = [e for e in of_files if not e.baked and (e.scene, e.method) == (row.scene, row.method)]
        if len(trained) > 1:
            trained = [e for e in trained if e.source.parent == row.source.parent]
        if row.baked and len(trained) == 1 and "psnr" in row.results and "psnr" in trained[0].results:
            known["psnr_delta"] = row.results["psnr"] - trained[0].results["psnr"]
        records.evaluations[i] = replace(row, results=finite_numbers(known) | row.results)


def grouped(items: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """Group items by their keys, in order."""
    groups: dict[K, list[T]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def means(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Average the figures that all rows have."""
    names = sorted(set.intersection(*map(set, rows)))
    return {name: statistics.fmean(row[name] for row in rows) for name in names}


def over_seeds(evaluations: list[Evaluation]) -> list[Evaluation]:
    """Average runs that differ only in their seed. `psnr_seeds`: standard deviation of their PSNR."""
    merged = []
    for rows in grouped(evaluations, lambda row: (row.scene, row.baked, row.group, row.series)).values():
        if len(rows) == 1 or not rows[0].group:
            merged += rows
            continue
        spread = statistics.stdev(row.results["psnr"] for row in rows)
        results = means([row.results for row in rows]) | {"psnr_seeds": spread}
        merged.append(replace(rows[0], label=f"{rows[0].group} ({len(rows)} seeds)", results=results))
    return merged


def disambiguate(items: list) -> None:
    """Add their files, in place, to equal labels of evaluations (of a scene and stage) or curves (of a scene)."""
    same = grouped(range(len(items)), lambda i: (items[i].scene, getattr(items[i], "baked", None), items[i].label))
    for indices in same.values():
        shared = os.path.commonpath([items[i].source.resolve().parent for i in indices])
        for i in indices if len(indices) > 1 else ():
            file = os.path.relpath(items[i].source.resolve().with_suffix(""), shared)
            items[i] = replace(items[i], label=f"{items[i].label} ({file})")
