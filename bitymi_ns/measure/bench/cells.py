"""Finished cells on disk: one JSON object per line, appended when a cell is done.

A line has `key` (everything that decides the result; cells of equal keys are the same cell), `value` (what came out;
paths in it are relative to the work folder) and `made` (when, where and with what).
"""

from __future__ import annotations

import datetime
import fcntl
import json
import os
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bitymi_ns.files import reason
from bitymi_ns.measure.bench.machine import commit, machine, versions
from bitymi_ns.measure.bench.process import BenchError
from bitymi_ns.trust import json_of, no_links

FILE = "cells.jsonl"
NAMES = ("suite", "row")
"""Entries of a key that name things and decide nothing."""


def identity(key: dict[str, Any]) -> str:
    """What tells cells apart, as text."""
    return json.dumps({name: value for name, value in key.items() if name not in NAMES}, sort_keys=True)


def made(command: list[str], seconds: float) -> dict[str, Any]:
    """Where a cell comes from."""
    return {
        "at": f"{datetime.datetime.now(datetime.timezone.utc):%Y-%m-%dT%H:%M:%SZ}",
        "seconds": round(seconds, 2),
        "commit": commit(),
        "versions": versions(),
        "machine": machine(),
        "host": platform.node(),
        "load": round(os.getloadavg()[0], 2),
        "command": command,
    }


class Cells:
    """The finished cells of a work folder. Several processes may append to the file at once."""

    def __init__(self, path: Path) -> None:
        """
        Raises:
            BenchError: a line that is not the last is no cell.
        """
        self.path = path
        self._read_until = 0
        self._known: dict[str, dict[str, Any]] = {}
        self.refresh()

    def __len__(self) -> int:
        return len(self._known)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return iter(self._known.values())

    def refresh(self) -> None:
        """Read what other processes have added. A last line without its end (a writer that was killed) is left out."""
        if not self.path.is_file():
            return
        with open(self.path, "rb") as file:
            file.seek(self._read_until)
            text = file.read()
        whole = text[: text.rfind(b"\n") + 1]
        first = self._read_until == 0
        for number, line in enumerate(whole.splitlines(), 1):
            if not line.strip():
                continue
            try:
                cell = json_of(line)
                self._known[identity(cell["key"])] = {**cell, "value": dict(cell["value"])}
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                where = f"line {number}" if first else "a line that was added"
                raise BenchError(
                    f"{self.path}, {where}, is not a finished cell ({error}): remove that line, or give another --work"
                ) from error
        self._read_until += len(whole)

    def get(self, key: dict[str, Any]) -> dict[str, Any] | None:
        """The line of a finished cell."""
        return self._known.get(identity(key))

    def add(self, key: dict[str, Any], value: dict[str, Any], origin: dict[str, Any]) -> dict[str, Any]:
        """Append a cell, whole or not at all; an unfinished line of a killed writer is cut off first."""
        cell = {"key": key, "value": value, "made": origin}
        line = json.dumps(cell, allow_nan=False).encode("utf8") + b"\n"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a+b", opener=no_links) as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                end = file.seek(0, os.SEEK_END)
                if end:
                    file.seek(max(0, end - (1 << 20)))
                    tail = file.read()
                    if not tail.endswith(b"\n"):
                        end = max(0, end - len(tail)) + tail.rfind(b"\n") + 1
                        file.truncate(end)
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise BenchError(f"{self.path} cannot be written: {reason(error, self.path)}, with --work") from error
        self._known[identity(key)] = cell
        return cell


def without_nan(value: Any) -> Any:
    """The same JSON value with null for numbers that JSON does not know."""
    if isinstance(value, dict):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(item) for item in value]
    if isinstance(value, float) and value - value != 0:
        return None
    return value
