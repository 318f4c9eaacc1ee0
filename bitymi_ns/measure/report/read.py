"""Readers of a report's inputs."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from bitymi_ns.safe_reading import read_json, read_text, reading
from bitymi_ns.trust import finite_numbers, json_of
from ..bench.cells import FILE as CELLS
from ..bench.cells import NOT_OF_A_RUN, Cells, identity
from .pictures import SIDE_BY_SIDE
from .records import Evaluation, Records, ReportError, curve_from, evaluation_from, grouped, link

MAX_BYTES = 64 << 20  # larger files are not evaluations
ADVICE = "Write it again, or leave it out."


def is_evaluation(data: Any) -> bool:
    return isinstance(data, dict) and isinstance(data.get("results"), dict)


def read_jsonl(path: Path) -> Records:
    """Read evaluations and the curve of a JSONL file; empty if it holds something else. A truncated last line (of a
    killed run) is skipped with a note. Raises ReportError: another line is broken."""
    with reading(path, ReportError, ADVICE):
        lines = [(i, s) for i, s in enumerate(read_text(path, MAX_BYTES).splitlines(), 1) if s.strip()]
    values, notes = [], []
    for number, line in lines:
        try:
            values.append(json_of(line))
        except ValueError as error:
            if number < lines[-1][0] or not values:
                raise ReportError(f"{path}, line {number}, cannot be read: {error}. {ADVICE}") from None
            notes.append(f"{path}: the last line is cut off and was left out.")
    evaluations = [evaluation_from(value, path) for value in values if is_evaluation(value)]
    points = [v for v in values if isinstance(v, dict) and "step" in finite_numbers(v) and not is_evaluation(v)]
    return Records(evaluations, [curve_from(points, path)] if points else [], notes=notes)


def add_cells(cells: Iterable[dict[str, Any]], path: Path, records: Records) -> None:
    """Add cells of the file `path`, and the curves and images that they name, if these exist. Raises ReportError: a
    cell lacks an entry."""
    with reading(f"{path}: a cell", ReportError, passing=(ReportError,)):
        runs = grouped(cells, lambda cell: identity(cell["key"], *NOT_OF_A_RUN))
        keys = [of_run[0]["key"] for of_run in runs.values()]
        seeds = Counter(identity(key, *NOT_OF_A_RUN, "seed") for key in keys)
        namesakes = Counter((key["scene"], key["row"], key.get("seed")) for key in keys)
        for of_run, key in zip(runs.values(), keys, strict=True):
            name = str(key["row"])
            seed = key.get("seed")
            series = identity(key, *NOT_OF_A_RUN, "seed")
            if namesakes[key["scene"], key["row"], seed] > 1:  # runs that differ in their length
                name += f", {key['steps']:,} steps" if key["steps"] else ", own length"
            suffix = f", seed {seed}" if seeds[series] > 1 and seed is not None else ""
            trained = Evaluation(str(key["scene"]), name, False, name + suffix, {}, path, name, series)
            _add_run(trained, suffix, of_run, records)


def _add_run(trained: Evaluation, suffix: str, of_run: list[dict[str, Any]], records: Records) -> None:
    """Add the cells of a run. `trained`: the evaluation of its trained scene, without results."""
    values: dict[tuple[str, str], dict[str, Any]] = {}  # by kind and bundle
    for cell in of_run:
        values[cell["key"].get("cell"), cell["key"].get("bundle", "")] = cell["value"]
        machine = cell["made"].get("machine") if isinstance(cell.get("made"), dict) else None
        if machine and machine not in records.machines:
            records.machines.append(str(machine))
    folder, train = trained.source.parent, values.get(("train", ""), {})
    figures = finite_numbers(train)
    times = {f"train_{k}": figures[k] for k in ("seconds", "cpu_seconds", "peak_bytes") if k in figures}
    before = finite_numbers(values.get(("eval", ""), {}).get("results", {})).get("psnr")
    for (kind, bundle), value in values.items():
        if kind != "eval":
            continue
        with reading(f"{trained.source}: the eval cell of {trained.method}", ReportError):
            size = values.get(("export", bundle), {}).get("bytes")
            results = finite_numbers({**value["results"], **times, "bundle_bytes": size})
            if "psnr" not in results:
                raise KeyError("psnr")
            if bundle and before is not None:
                results["psnr_delta"] = results["psnr"] - before
            shown = folder / value["pictures"] if value.get("pictures") else None
            if shown and os.path.isdir(shown):
                records.images += sorted(shown.glob("eval_img_*.png"))
        group = f"{trained.method}, {bundle}" if bundle else trained.method
        row = replace(trained, results=results, baked=bool(bundle), label=group + suffix, group=group)
        records.evaluations.append(row)
    curve = folder / str(train["curve"]) if train.get("curve") else None
    if curve is not None and os.path.isfile(curve):
        read = read_jsonl(curve)
        records.curves += [replace(c, scene=trained.scene, label=trained.label) for c in read.curves]
        records.notes += read.notes


def _walk(folder: Path, skip: Path) -> Iterator[Path]:
    """List the files below a folder that may be inputs, except in hidden folders and `skip`; of a benchmark's work
    folder only its cells, which name all other files."""
    for root, folders, files in os.walk(folder):
        here = Path(root)
        if CELLS in files:
            folders.clear()
            yield here / CELLS
            continue
        folders[:] = sorted(name for name in folders if not name.startswith(".") and here / name != skip)
        for file in map(here.joinpath, sorted(files)):
            if file.suffix.lower() in (".json", ".jsonl") or SIDE_BY_SIDE.match(file.name):
                yield file


def _read(path: Path) -> Records:
    """Read the records of a file, which may be none. Raises ReportError: it is broken."""
    if path.suffix.lower() == ".png":
        return Records(images=[path])
    if path.suffix.lower() == ".jsonl" and path.name != CELLS:
        return read_jsonl(path)
    records = Records()
    with reading(path, ReportError, ADVICE, passing=(ReportError,)):
        if path.name == CELLS:
            add_cells(Cells(path).known.values(), path, records)
        elif is_evaluation(data := read_json(path, MAX_BYTES)):
            records.evaluations.append(evaluation_from(data, path))
    return records


def collect(inputs: list[Path], output_dir: Path) -> Records:
    """Read files, and folders, in which the report's is not searched. Raises ReportError: a named file is missing,
    broken, or of an unknown kind; or nothing usable was found."""
    records, seen = Records(), set()
    paths = [Path(os.path.expanduser(p)) for p in inputs]
    # named files first: their errors are fatal, also if a folder contains the same file
    for path in sorted(paths, key=Path.is_dir):
        if not path.exists():
            raise ReportError(f"{path} does not exist. Give ns-eval JSON files, training curves (.jsonl) or folders.")
        for file in _walk(path.resolve(), output_dir.resolve()) if path.is_dir() else [path]:
            if file.resolve() in seen:
                continue
            seen.add(file.resolve())
            try:
                more = _read(file)
            except ReportError as error:
                if file is path:
                    raise
                records.notes.append(str(error))
                continue
            for name, values in vars(more).items():
                vars(records)[name] += values
            if file is path and not (more.images or more.evaluations or more.curves):
                raise ReportError(
                    f"{path} holds neither an evaluation (JSON of ns-eval with 'results') nor a training curve (JSON "
                    "lines with 'step') nor lines of bitymi bench."
                )
    if not (records.evaluations or records.curves):
        where = ", ".join(map(str, paths)) or "no inputs"
        notes = "".join(f"\n  {note}" for note in records.notes)
        raise ReportError(
            f"nothing to report in {where}: name the file or folder of a training curve, or of "
            f"`ns-eval --load-config <config.yml> --output-path eval.json`.{notes}"
        )
    link(records)
    return records
