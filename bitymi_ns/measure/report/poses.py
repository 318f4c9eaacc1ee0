"""The camera poses of a capture that were found here, as the finding of poses reports them (capture/report.py)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bitymi_ns.capture.report import PICTURE, frame_text
from bitymi_ns.measure.report.gallery import Picture, encode, open_image
from bitymi_ns.measure.report.records import FoundPoses, finite_numbers
from bitymi_ns.measure.report.tables import MISSING, Row, Table

MOST_NAMED = 60
"""Photographs that a table names; report.json has them all."""
_REQUIRED = {"source", "registered", "given", "reprojection_error", "track_length", "left_out", "seconds"}


@dataclass(frozen=True)
class PosesShown:
    """What a page shows of `FoundPoses`; `picture` is of the cameras and points, None where there is none."""

    tables: tuple[Table, ...]
    picture: Picture | None


def is_poses(data: Any) -> bool:
    """Whether a JSON value is a report of the finding of poses."""
    return isinstance(data, dict) and data.keys() >= _REQUIRED


def poses_from(data: Mapping[str, Any], file: Path) -> FoundPoses:
    """What such a report says; what is of another type than it should be is left out."""

    def texts(key: str) -> dict[str, str]:
        found = data.get(key)
        return {name: str(why) for name, why in found.items()} if isinstance(found, dict) else {}

    numbers, seconds = finite_numbers(dict(data)), data["seconds"]
    return FoundPoses(
        str(data["source"]),
        numbers,
        finite_numbers(seconds) if isinstance(seconds, dict) else {},
        texts("left_out"),
        texts("notes"),
        frame_text({"up": data.get("up"), **numbers}),
        file,
    )


def shown(found: Sequence[FoundPoses]) -> tuple[list[PosesShown], list[str]]:
    """What the page shows of these, each once where several runs have the same; and a note per broken picture."""
    once = {(each.source, *each.numbers.items(), *each.seconds.items()): each for each in reversed(found)}
    result, notes = [], []
    for each in reversed(once.values()):
        picture, path = None, each.file.parent / PICTURE
        if path.is_file():
            try:
                picture = encode(open_image(path), "Cameras (red) and points, from above and from the side.")
            except OSError as error:
                notes.append(f"{path} is not an image that can be read: {error}.")
        tables = (_overview(each), _seconds(each), _named(each.left_out, "Left out"), _named(each.notes, "Notes"))
        result.append(PosesShown(tuple(table for table in tables if table.rows), picture))
    return result, notes


def _overview(found: FoundPoses) -> Table:
    def text(key: str, form: str) -> str:
        return form.format(found.numbers[key]) if key in found.numbers else MISSING

    rows = {
        "Photographs with a pose": f"{text('registered', '{:,.0f}')} of {text('given', '{:,.0f}')}",
        "Mean reprojection error, pixels": text("reprojection_error", "{:.2f}"),
        "Mean track length, photographs per point": text("track_length", "{:.2f}"),
        "Points": text("points", "{:,.0f}"),
        "Median parallax, degrees": text("parallax_degrees", "{:.1f}"),
        "Up, scale": found.frame,
    }
    return Table("Poses", ("", found.source), tuple(Row(cells) for cells in rows.items()))


def _seconds(found: FoundPoses) -> Table:
    rows = tuple(Row((stage, f"{seconds:.1f}")) for stage, seconds in found.seconds.items())
    return Table("Time of every stage", ("Stage", "Seconds"), rows)


def _named(photographs: Mapping[str, str], title: str) -> Table:
    rows = tuple(Row(each) for each in list(photographs.items())[:MOST_NAMED])
    more = len(photographs) - len(rows)
    note = f"And {more:,} more, which report.json names." if more else ""
    return Table(f"{title}: {len(photographs):,}", ("Photograph", "Why" if title == "Left out" else ""), rows, note)
