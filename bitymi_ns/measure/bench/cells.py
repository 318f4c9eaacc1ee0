"""Finished cells as JSON lines: `key` (all settings that affect the result), `value` (the figures; paths are relative
to the work folder) and `made` (time, machine, versions, command)."""

import datetime
import fcntl
import json
import os
import platform
from pathlib import Path
from typing import Any

from bitymi_ns.files import write_errors_as
from bitymi_ns.safe_reading import read_bytes
from bitymi_ns.trust import json_of, no_links
from ..machine import commit, machine, versions
from .process import BenchError

FILE = "cells.jsonl"
NAMES = ("suite", "row")  # entries of a key that are labels
NOT_OF_A_RUN = ("cell", "bundle", "export")  # entries in which the cells of a run differ


def identity(key: dict[str, Any], *without: str) -> str:
    """Serialise the identity of a cell, without some entries."""
    return json.dumps({name: value for name, value in key.items() if name not in (*NAMES, *without)}, sort_keys=True)


def provenance(command: list[str], seconds: float) -> dict[str, Any]:
    """Build the entry `made` of a cell."""
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
    """Finished cells of a work folder, `known` by identity; several processes may append to the file."""

    def __init__(self, path: Path) -> None:
        """Raises BenchError: a line is not a cell."""
        self.path = path
        self.refresh()

    def refresh(self) -> None:
        """Read the file again. A truncated last line (of a killed writer) is skipped."""
        self.known: dict[str, dict[str, Any]] = {}
        text = read_bytes(self.path) if self.path.is_file() else b""
        for number, line in enumerate(text[: text.rfind(b"\n") + 1].splitlines(), 1):
            if not line.strip():
                continue
            try:
                cell = json_of(line)
                self.known[identity(cell["key"])] = {**cell, "value": dict(cell["value"])}
            except (ValueError, KeyError, TypeError, AttributeError) as error:
                reason = f"{self.path}, line {number}, is not a finished cell ({error})"
                raise BenchError(f"{reason}: remove that line, or give another --work") from error

    def get(self, key: dict[str, Any]) -> dict[str, Any] | None:
        return self.known.get(identity(key))

    def add(self, key: dict[str, Any], value: dict[str, Any], origin: dict[str, Any]) -> None:
        """Append a cell, in place of a truncated last line; NaN and infinite numbers become None. Raises BenchError."""
        cell = {"key": key, "value": value, "made": origin}
        cell = json.loads(json.dumps(cell), parse_constant=lambda constant: None)
        line = json.dumps(cell).encode("utf8") + b"\n"
        with write_errors_as(self.path, BenchError, ", with --work"):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.path, "a+b", opener=no_links) as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                file.seek(0)
                file.truncate(file.read().rfind(b"\n") + 1)
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        self.known[identity(key)] = cell
