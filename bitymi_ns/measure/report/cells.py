"""Reading what `bitymi bench` writes: cells, quality knobs, and pictures of the worst views."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bitymi_ns.measure.report.records import (
    MAX_JSON_BYTES,
    Evaluation,
    KnobPoint,
    Records,
    ReportError,
    WorstView,
    finite_numbers,
    parse_json,
    read_jsonl,
    read_text,
)

CELLS = "cells.jsonl"
"""The file of finished cells in a work folder."""
PICTURES = "pictures.json"

_NAMES = ("suite", "row")
_NOT_OF_A_RUN = ("cell", "bundle", "export", "format", "views", *_NAMES)


def is_cell(data: Any) -> bool:
    """Whether a JSON value is a line of a benchmark's cells."""
    return isinstance(data, dict) and isinstance(data.get("key"), dict) and isinstance(data.get("value"), dict)


def is_knob(data: Any) -> bool:
    """Whether a JSON value is a measured setting of a quality knob."""
    return isinstance(data, dict) and isinstance(data.get("knob"), str) and "max_steps" in data


def knob_from(data: dict[str, Any], scene: str = "", run: str = "") -> KnobPoint:
    """Build a measured setting; `scene` and `run` name what it was measured on, else its own line does."""
    value = data.get("value")
    text = f"{value:.3g}" if isinstance(value, float) else str(value)
    return KnobPoint(
        scene or str(data.get("scene") or "unnamed scene"),
        run or str(data.get("method") or "unnamed method"),
        data["knob"],
        text,
        str(data.get("renderer") or ""),
        bool(data.get("exact")),
        bool(data.get("default")),
        str(data.get("against") or ""),
        finite_numbers({k: v for k, v in data.items() if k != "value"}),
    )


def read_pictures(path: Path, run: str = "") -> list[WorstView]:
    """The worst views that a pictures.json lists; an empty list when the file is something else.

    Raises:
        ReportError: it is no valid JSON, or lists its views in another form.
    """
    data = parse_json(read_text(path, MAX_JSON_BYTES), str(path))
    if not isinstance(data, dict) or "bitymi_pictures" not in data:
        return []
    scene, method = str(data.get("scene") or "unnamed scene"), run or str(data.get("method") or "")
    views = []
    try:
        for view in data["views"]:
            metrics = finite_numbers(view["metrics"])
            figures = [f"{metrics[key]:.{digits}f} {text}" for key, digits, text in _SHOWN if key in metrics]
            place = "worst" if view["rank"] == 1 else f"number {view['rank']} from below"
            title = f"{scene}, {method}: view {view['view']}, {place} of {view['of']}: {', '.join(figures)}"
            pictures = tuple((data["captions"].get(k, k), path.parent / Path(f).name) for k, f in view["files"].items())
            views.append(WorstView(scene, method, title, pictures))
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ReportError(f"{path} does not list its views as bitymi bench pictures does: {error!r}.") from error
    return views


_SHOWN = (
    ("psnr", 2, "dB"),
    ("cc_psnr", 2, "dB ccPSNR"),
    ("ssim", 3, "SSIM"),
    ("flip", 3, "FLIP"),
    ("lpips", 3, "LPIPS"),
    ("lpips_vgg", 3, "LPIPS (VGG)"),
)


def _identity(key: dict[str, Any], *without: str) -> str:
    return json.dumps({k: v for k, v in key.items() if k not in without}, sort_keys=True)


def _words(value: Any) -> tuple[str, ...]:
    return tuple(map(str, value)) if isinstance(value, list) else ()


def _row_name(key: dict[str, Any]) -> str:
    method = str(key.get("method") or "unnamed method")
    options = _words(key.get("options", key.get("extra")))  # lines of earlier versions say extra
    return str(key.get("row") or " ".join([method, *options]))


def _scene_name(key: dict[str, Any]) -> str:
    return str(key.get("scene") or Path(str(key.get("data") or "unnamed scene")).name)


class _Run:
    """The cells of one training."""

    def __init__(self, key: dict[str, Any]) -> None:
        self.key = key
        self.id = _identity(key, *_NOT_OF_A_RUN)
        self.series = _identity(key, *_NOT_OF_A_RUN, "seed")
        self.scene, self.name = _scene_name(key), _row_name(key)
        self.seed = key.get("seed") if isinstance(key.get("seed"), int) else None
        self.train: dict[str, Any] = {}
        self.exports: dict[str, dict[str, Any]] = {}
        self.evaluations: list[tuple[str, dict[str, float]]] = []
        self.knobs: list[dict[str, Any]] = []
        self.pictures: str = ""

    def label(self, several_seeds: bool) -> str:
        return f"{self.name}, seed {self.seed}" if several_seeds and self.seed is not None else self.name


def read_cells(numbered: Sequence[tuple[int, Any]], path: Path, records: Records) -> None:
    """Add what the lines of a cells file hold, and the curves and pictures that they name, where these are there.

    Of lines with equal keys the last counts.

    Raises:
        ReportError: a line is no cell, or lacks what its kind must have; the message has its number.
    """
    latest: dict[str, tuple[int, dict[str, Any]]] = {}
    for number, value in numbered:
        if not is_cell(value):
            raise ReportError(f"{path}, line {number}, is not a cell of a benchmark: it has no key and value objects.")
        name = _identity(value["key"], *_NAMES)
        latest.pop(name, None)
        latest[name] = (number, value)
    runs: dict[str, _Run] = {}
    for number, cell in latest.values():
        key, value = cell["key"], cell["value"]
        run = _Run(key)
        run = runs.setdefault(run.id, run)
        machine = cell.get("made", {}).get("machine") if isinstance(cell.get("made"), dict) else None
        if machine and machine not in records.machines:
            records.machines.append(str(machine))
        try:
            _add_cell(run, key, value)
        except (KeyError, TypeError, AttributeError) as error:
            raise ReportError(f"{path}, line {number}: the {key.get('cell')} cell lacks {error}.") from error
    _name_lengths(list(runs.values()))
    seeds: dict[str, set[int | None]] = {}
    for run in runs.values():
        seeds.setdefault(run.series, set()).add(run.seed)
    for run in runs.values():
        _add_run(run, len(seeds[run.series]) > 1, path, records)


def _add_cell(run: _Run, key: dict[str, Any], value: dict[str, Any]) -> None:
    kind = key.get("cell")
    bundle = key.get("bundle", key.get("format")) or ""  # lines of earlier versions say format
    if kind == "train":
        run.train = value
    elif kind == "export":
        run.exports[str(bundle)] = value
    elif kind == "eval":
        results = value.get("results", value)
        if not isinstance(results, dict) or "psnr" not in results:
            raise KeyError("psnr among its results")
        run.evaluations.append((str(bundle), finite_numbers(results)))
    elif kind == "knobs":
        run.knobs = [point for point in value["points"] if is_knob(point)]
    elif kind == "pictures":
        run.pictures = str(value["folder"])


def _name_lengths(runs: list[_Run]) -> None:
    """Say the number of steps of runs that differ in nothing else that is shown."""
    groups: dict[tuple[str, str, int | None], list[_Run]] = {}
    for run in runs:
        groups.setdefault((run.scene, run.name, run.seed), []).append(run)
    for group in groups.values():
        if len(group) > 1:
            for i, run in enumerate(group, 1):
                steps = run.train.get("steps") or run.key.get("steps")
                alike = sum((r.train.get("steps") or r.key.get("steps")) == steps for r in group) > 1
                length = f"{steps:,} steps" if isinstance(steps, int) else "own length"
                run.name = f"{run.name}, {length}{f' ({i})' if alike else ''}"


def _add_run(run: _Run, several_seeds: bool, path: Path, records: Records) -> None:
    label = run.label(several_seeds)
    trained = finite_numbers(run.train)
    times = {f"train_{k}": trained[k] for k in ("seconds", "cpu_seconds") if k in trained}
    times |= {"train_peak_bytes": trained["peak_bytes"]} if "peak_bytes" in trained else {}
    for bundle, results in run.evaluations:
        export = run.exports.get(bundle, {}) if bundle else {}
        size = finite_numbers(export).get("bytes")
        form = f", {bundle}" if bundle else ""
        records.evaluations.append(
            Evaluation(
                scene=run.scene,
                method=run.name,
                baked=bool(bundle),
                label=f"{run.name}{form}{label[len(run.name) :]}",
                results={**results, **times, **({} if size is None else {"bundle_bytes": size})},
                checkpoint="",
                source=path,
                run=run.id,
                group=f"{run.name}{form}",
                series=run.series,
                seed=run.seed,
                preset=str(run.key.get("method") or ""),
                options=_words(run.key.get("options", run.key.get("extra"))),
                suite=str(run.key.get("suite") or ""),
                atlas_format=str(export.get("format") or bundle),
            )
        )
    records.knobs += [knob_from(point, run.scene, label) for point in run.knobs]
    curve = path.parent / str(run.train["curve"]) if run.train.get("curve") else None
    if curve is not None and curve.is_file():
        _, curves, notes = read_jsonl(curve)
        records.curves += [replace(c, scene=run.scene, label=label, run=run.id) for c in curves]
        records.notes += notes
    listed = path.parent / run.pictures / PICTURES if run.pictures else None
    if listed is not None and listed.is_file():
        records.worst += read_pictures(listed, label)
