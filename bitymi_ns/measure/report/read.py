"""Readers of a report's inputs: ns-eval files, training curves, benchmark cells, images, and folders of these."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from bitymi_ns.measure.bench.cells import FILE as CELLS
from bitymi_ns.measure.bench.cells import Cells, identity
from bitymi_ns.measure.bench.process import BenchError
from bitymi_ns.measure.report.pictures import SIDE_BY_SIDE
from bitymi_ns.measure.report.records import (
    Curve,
    Evaluation,
    Records,
    ReportError,
    curve_from,
    evaluation_from,
    grouped,
    link,
)
from bitymi_ns.safe_reading import read_text as text_of
from bitymi_ns.safe_reading import reading
from bitymi_ns.trust import finite_numbers, json_of

MAX_BYTES = 64 << 20  # larger files are not evaluations
MAX_DEPTH = 8  # levels of folders that are searched
_SKIPPED = {"__pycache__", "node_modules", "wandb", "nerfstudio_models"}
_NOT_OF_A_RUN = ("cell", "bundle", "export")


def parse_json(text: str, where: str) -> Any:
    """Parse JSON (NaN and Infinity tokens allowed). Raises ReportError: it is not valid JSON; the message names the
    file."""
    try:
        return json_of(text)
    except ValueError as error:
        raise ReportError(f"{where} is not valid JSON: {error}. Write it again, or leave it out.") from None


def read_text(path: Path) -> str:
    """Read a text file. Raises ReportError: it is too large, not text, or cannot be read."""
    with reading(path, _refuse, "Write it again, or leave it out."):
        return text_of(path, MAX_BYTES)


def _refuse(message: str, cause: BaseException) -> NoReturn:
    raise ReportError(message) from cause


def is_evaluation(data: Any) -> bool:
    """Return True for ns-eval's JSON."""
    return isinstance(data, dict) and isinstance(data.get("results"), dict)


def read_jsonl(path: Path) -> tuple[list[Evaluation], list[Curve], list[str]]:
    """Read evaluations, curve and notes of a JSONL file; empty if it holds something else.

    A truncated last line (of a killed run) is skipped with a note. Raises ReportError: another line is broken."""
    numbered = [(i, s) for i, s in enumerate(read_text(path).splitlines(), 1) if s.strip()]
    values, notes = [], []
    for position, (number, line) in enumerate(numbered):
        try:
            values.append(parse_json(line, f"{path}, line {number},"))
        except ReportError:
            if position + 1 < len(numbered) or position == 0:
                raise
            notes.append(f"{path}: the last line is cut off and was left out.")
    evaluations = [evaluation_from(value, path) for value in values if is_evaluation(value)]
    points = [v for v in values if isinstance(v, dict) and "step" in finite_numbers(v) and not is_evaluation(v)]
    return evaluations, [curve_from(points, path)] if points else [], notes


def add_cells(cells: Iterable[dict[str, Any]], path: Path, records: Records) -> None:
    """Add the cells of a benchmark, and the curves and images that they name, if these exist. `cells`: of the file
    `path`. Raises ReportError: a cell lacks an entry that its kind requires."""
    runs = grouped(cells, lambda cell: identity(cell["key"], *_NOT_OF_A_RUN))
    keys = {run: of_run[0]["key"] for run, of_run in runs.items()}
    series = {run: identity(key, *_NOT_OF_A_RUN, "seed") for run, key in keys.items()}
    seeds = Counter(series.values())
    named = {run: (str(key.get("scene") or "unnamed scene"), _row_of(key)) for run, key in keys.items()}
    namesakes = Counter((*named[run], str(key.get("seed"))) for run, key in keys.items())
    for run, key in keys.items():
        (scene, name), seed, steps = named[run], key.get("seed"), key.get("steps")
        if namesakes[scene, name, str(seed)] > 1:  # runs that differ in their length
            name += f", {steps:,} steps" if isinstance(steps, int) else ", own length"
        suffix = f", seed {seed}" if seeds[series[run]] > 1 and seed is not None else ""
        trained = Evaluation(scene, name, False, name + suffix, {}, path, run, name, series[run], seed)
        _add_run(trained, suffix, runs[run], records)


def _row_of(key: dict[str, Any]) -> str:
    return str(key.get("row") or key.get("method") or "unnamed method")


def _add_run(trained: Evaluation, suffix: str, of_run: list[dict[str, Any]], records: Records) -> None:
    """Add the cells of a run; `trained` is the evaluation of its trained scene without results."""
    cells: dict[tuple[str, str], dict[str, Any]] = {}  # by kind and bundle
    for cell in of_run:
        cells[str(cell["key"].get("cell")), str(cell["key"].get("bundle") or "")] = cell["value"]
        machine = cell["made"].get("machine") if isinstance(cell.get("made"), dict) else None
        if machine and machine not in records.machines:
            records.machines.append(str(machine))
    folder, train = trained.source.parent, cells.get(("train", ""), {})
    figures = finite_numbers(train)
    times = {f"train_{k}": figures[k] for k in ("seconds", "cpu_seconds", "peak_bytes") if k in figures}
    for (kind, bundle), value in cells.items():
        if kind != "eval":
            continue
        try:
            size = cells.get(("export", bundle), {}).get("bytes")
            results = finite_numbers({**value["results"], **times, "bundle_bytes": size})
            if "psnr" not in results:
                raise KeyError("psnr among its results")
            shown = folder / value["pictures"] if value.get("pictures") else None
            pictures = sorted(shown.glob("eval_img_*.png")) if shown and os.path.isdir(shown) else []
        except (KeyError, TypeError, AttributeError, ValueError, OSError) as error:
            raise ReportError(f"{trained.source}: the {kind} cell of {trained.method} lacks {error}.") from error
        group = f"{trained.method}, {bundle}" if bundle else trained.method
        own = {"baked": bool(bundle), "label": group + suffix, "group": group}
        records.evaluations.append(replace(trained, results=results, **own))
        records.images += pictures
    curve = folder / str(train["curve"]) if train.get("curve") else None
    if curve is not None and os.path.isfile(curve):
        _, curves, notes = read_jsonl(curve)
        records.curves += [replace(c, scene=trained.scene, label=trained.label) for c in curves]
        records.notes += notes


def _walk(folder: Path, skip: Path) -> Iterator[Path]:
    """List the files below `folder` that may be inputs, sorted, without hidden folders, links to folders, and `skip`;
    of a benchmark's work folder only its cells, which name all other files."""
    for root, folders, files in os.walk(folder):
        here = Path(root)
        if CELLS in files:
            folders[:] = []
            yield here / CELLS
            continue
        depth = len(here.relative_to(folder).parts)
        folders[:] = sorted(
            name
            for name in folders
            if depth < MAX_DEPTH and not name.startswith(".") and name not in _SKIPPED and here / name != skip
        )
        for file in map(here.joinpath, sorted(files)):
            kind = file.suffix.lower()
            if kind in (".json", ".jsonl") or (kind == ".png" and SIDE_BY_SIDE.match(file.stem)):
                yield file


def _read(path: Path, records: Records) -> bool:
    """Add the records of a file; return False if it has none."""
    found = Records()
    if path.suffix.lower() == ".png":
        found.images.append(path)
    elif path.name == CELLS:
        try:
            add_cells(Cells(path), path, found)
        except BenchError as error:
            raise ReportError(str(error)) from error
    elif path.suffix.lower() == ".jsonl":
        found.evaluations, found.curves, found.notes = read_jsonl(path)
    elif is_evaluation(data := parse_json(read_text(path), str(path))):
        found.evaluations.append(evaluation_from(data, path))
    for name, values in vars(found).items():
        vars(records)[name] += values
    return bool(found.images or found.evaluations or found.curves)


def collect(inputs: list[Path], output_dir: Path) -> Records:
    """Read all inputs.

    Args:
        inputs: files, and folders to search for files.
        output_dir: folder of the report, which is not searched.

    Raises:
        ReportError: a named file is missing, broken, or of an unknown kind; or nothing usable was found.
    """
    records = Records()
    seen: set[Path] = set()
    # named files first: their errors are fatal, also if a folder contains the same file
    paths = [Path(os.path.expanduser(p)) for p in inputs]
    for path in sorted(paths, key=lambda p: p.is_dir()):
        if not path.exists():
            raise ReportError(f"{path} does not exist. Give ns-eval JSON files, training curves (.jsonl) or folders.")
        for file in _walk(path.resolve(), output_dir.resolve()) if path.is_dir() else [path]:
            if file.resolve() in seen:
                continue
            seen.add(file.resolve())
            try:
                usable = _read(file, records)
            except ReportError as error:
                if file is path:
                    raise
                records.notes.append(str(error))
                continue
            if file is path and not usable:
                raise ReportError(
                    f"{path} holds neither an evaluation (a JSON object with 'results', as ns-eval writes it) "
                    "nor a training curve (JSON lines with 'step') nor lines of bitymi bench."
                )
    if not (records.evaluations or records.curves):
        where = ", ".join(map(str, paths)) or "no inputs"
        more = "".join(f"\n  {note}" for note in records.notes)
        raise ReportError(
            f"nothing to report in {where}: no ns-eval JSON and no training curve. Run "
            f"`ns-eval --load-config <config.yml> --output-path eval.json` and name that file or its folder.{more}"
        )
    link(records)
    return records
