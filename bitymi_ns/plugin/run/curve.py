"""The training curve: quality against time, one JSON object per line, written while a run goes on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from bitymi_ns.files import reason, write_file
from bitymi_ns.plugin.errors import fail, warn
from bitymi_ns.trust import json_of, no_links

FILE = "training_curve.jsonl"


class TrainingCurve:
    """Appends points to the file of a run."""

    def __init__(self, path: Path, resumed_from: Path | None = None, steps_done: int = 0) -> None:
        """
        Args:
            path: the file; a new run starts it afresh.
            resumed_from: curve of the run that is continued; its points up to the checkpoint are taken over.
            steps_done: number of steps that the checkpoint contains; 0 = a new run.
        """
        self.path = path
        source = resumed_from if resumed_from is not None else path if steps_done > 0 else None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            kept = _points_until(source, steps_done) if source is not None and source.is_file() else []
            write_file(path, "".join(line + "\n" for line in kept).encode("utf8"))
        except OSError as error:
            fail(f"the training curve {path} cannot be written: {reason(error, path)}.", error)

    def add(self, point: dict[str, Any]) -> None:
        """Write one point, whole and at once. A full disk costs the point, not the run."""
        try:
            with open(self.path, "a", encoding="utf8", opener=no_links) as file:
                file.write(json.dumps(point) + "\n")
        except OSError as error:
            warn(f"A point of the training curve {self.path} could not be written: {reason(error, self.path)}.")


def _points_until(path: Path, steps: int) -> list[str]:
    kept = []
    for line in path.read_text("utf8").splitlines():
        try:
            if json_of(line)["step"] <= steps:
                kept.append(line)
        except (ValueError, KeyError, TypeError):
            continue  # cut off when the run was killed
    return kept


def points(total: int, count: int) -> frozenset[int]:
    """The steps after which the curve gets a point: `count` of them, evenly spaced, the last step included."""
    if count <= 0:
        return frozenset()
    return frozenset(max(0, round(total * (i + 1) / count) - 1) for i in range(count))
