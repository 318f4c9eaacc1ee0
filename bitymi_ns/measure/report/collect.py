"""Find evaluations, training curves, reports of camera poses and rendered images among files and folders."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

from bitymi_ns.measure.report.cells import CELLS, PICTURES, is_cell, is_knob, knob_from, read_cells, read_pictures
from bitymi_ns.measure.report.poses import is_poses, poses_from
from bitymi_ns.measure.report.records import (
    Records,
    ReportError,
    add_training_time,
    disambiguate,
    evaluation_from,
    is_evaluation,
    link_curves,
    read_json,
    read_jsonl,
    read_lines,
)

MAX_DEPTH = 8
"""Folders are searched this many levels down."""
MAX_ENTRIES = 50_000
"""A search stops after this many files."""
RENDERED = re.compile(r"^eval_.+_\d{4,}\.png$|^preview.*\.(png|jpg)$", re.IGNORECASE)
"""Images that a search picks up: those of `ns-eval --render-output-path` and the preview of a bundle."""

_SKIPPED = {"__pycache__", "node_modules", "wandb", "nerfstudio_models"}


def walk(folder: Path, skip: Path, notes: list[str]) -> Iterator[Path]:
    """Files below `folder`, sorted, without hidden folders, links to folders, and `skip` when it lies below.

    Of a benchmark's work folder only its cells: they name everything else that counts.
    """
    seen = 0
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
        for name in sorted(files):
            seen += 1
            if seen > MAX_ENTRIES:
                notes.append(f"{folder}: only the first {MAX_ENTRIES:,} files were searched; name a smaller folder.")
                return
            yield here / name


def _read(path: Path, records: Records) -> bool:
    """Add what one file holds; whether it held anything."""
    suffix = path.suffix.lower()
    if suffix == ".png":
        records.images.append(path)
        return True
    if suffix == ".jsonl":
        numbered, notes = read_lines(path)
        if path.name == CELLS or any(is_cell(value) for _, value in numbered):
            read_cells(numbered, path, records)
            records.notes += notes
            return bool(numbered)
        if any(is_knob(value) for _, value in numbered):
            records.knobs += [knob_from(value) for _, value in numbered if is_knob(value)]
            records.notes += notes
            return True
        evaluations, curves, notes = read_jsonl(path)
        records.curves += curves
        records.notes += notes
    elif path.name == PICTURES:
        views = read_pictures(path)
        records.worst += views
        return bool(views)
    else:
        data = read_json(path)
        if is_poses(data):
            records.poses.append(poses_from(data, path))
            return True
        evaluations, curves = [evaluation_from(data, path)] if is_evaluation(data) else [], []
    records.evaluations += evaluations
    return bool(evaluations or curves)


def _search(folder: Path, skip: Path, seen: set[Path], records: Records) -> None:
    """Add what the files of a folder hold. A broken file is noted, not fatal: nobody named it."""
    for path in walk(folder, skip, records.notes):
        suffix = path.suffix.lower()
        wanted = suffix in (".json", ".jsonl") or RENDERED.match(path.name)
        if not wanted or path.resolve() in seen:
            continue
        seen.add(path.resolve())
        try:
            _read(path, records)
        except ReportError as error:
            records.notes.append(str(error))


def collect(inputs: list[Path], output_dir: Path) -> Records:
    """Read all inputs.

    Args:
        inputs: ns-eval JSON files, training curves, cells and knobs of `bitymi bench` (JSONL), pictures.json,
            report.json of camera poses, PNG images, and folders that are searched for all of these.
        output_dir: where the report goes; not searched when it lies inside one of the folders.

    Raises:
        ReportError: a named file is missing, broken, or no evaluation or curve; or nothing usable was found.
    """
    records = Records()
    seen: set[Path] = set()
    skip = output_dir.resolve()
    # Named files first: their errors are fatal, also when a folder holds the same file.
    paths = [Path(os.path.expanduser(p)) for p in inputs]
    for path in sorted(paths, key=lambda p: p.is_dir()):
        if not path.exists():
            raise ReportError(f"{path} does not exist. Give ns-eval JSON files, training curves (.jsonl) or folders.")
        if path.is_dir():
            _search(path.resolve(), skip, seen, records)
        elif path.resolve() not in seen:
            seen.add(path.resolve())
            if not _read(path, records):
                raise ReportError(
                    f"{path} holds neither an evaluation (a JSON object with 'results', as ns-eval writes it) "
                    "nor a training curve (JSON lines with 'step') nor lines of bitymi bench, nor how poses were found."
                )
    if not (records.evaluations or records.curves or records.knobs or records.worst or records.poses):
        where = ", ".join(map(str, paths)) or "no inputs"
        more = "".join(f"\n  {note}" for note in records.notes)
        raise ReportError(
            f"nothing to report in {where}: no ns-eval JSON and no training curve. Run "
            f"`ns-eval --load-config <config.yml> --output-path eval.json` and name that file or its folder.{more}"
        )
    records.curves = link_curves(records.curves, records.evaluations)
    disambiguate(records)
    add_training_time(records)
    return records
