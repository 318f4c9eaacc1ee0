"""Commands as measured subprocesses."""

from __future__ import annotations

import datetime
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bitymi_ns.files import Lock
from bitymi_ns.trust import no_links, printable

TAIL = 25
"""Lines of a failed command's log that are shown."""
GRACE = 20.0
"""Seconds that a command gets to end by itself after an interrupt, before it is killed."""


class BenchError(Exception):
    """A benchmark cannot be run as asked; the message says what to change."""


class CommandFailed(BenchError):
    """A command ended with a non-zero status; the message has the end of its log."""


@dataclass(frozen=True)
class Cost:
    """What a process used, all its threads and the children it waited for included."""

    seconds: float
    cpu_seconds: float
    peak_bytes: int

    def as_dict(self) -> dict[str, float]:
        """The names under which a cell records them."""
        return {
            "process_seconds": round(self.seconds, 2),
            "process_cpu_seconds": round(self.cpu_seconds, 2),
            "peak_bytes": self.peak_bytes,
        }


def environment() -> dict[str, str]:
    """What a measured command runs in: OpenMP threads wait without spinning, so that CPU seconds count work."""
    return {**os.environ, "OMP_WAIT_POLICY": "passive"}


def run_measured(command: Sequence[str], log: Path, lock: Lock | None = None) -> Cost:
    """Run a command with its output in a file.

    An interrupt ends the command first, then this call.

    Args:
        command: the command.
        log: the file for its output.
        lock: what the command holds, too, and is named in: should this process be killed while the command goes on,
            the lock outlives it and says who has it.

    Raises:
        CommandFailed: non-zero exit status, or the command cannot be started.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with open(log, "wb", opener=no_links) as out:
        try:
            process = subprocess.Popen(
                command,
                env=environment(),
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                pass_fds=() if lock is None else (lock.fileno(),),
            )
        except OSError as error:
            raise CommandFailed(f"{shlex.join(command)} cannot be started: {error}") from error
        try:
            if lock is not None:
                lock.name(process.pid)
            _, status, usage = os.wait4(process.pid, 0)
        except BaseException:
            process.terminate()
            try:
                process.wait(GRACE)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            raise
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        tail = "\n".join(log.read_text("utf8", "replace").splitlines()[-TAIL:])
        raise CommandFailed(
            f"{shlex.join(command)} ended with status {process.returncode}; see {log}, whose end is:\n{tail}"
        )
    kibibytes = usage.ru_maxrss if sys.platform != "darwin" else usage.ru_maxrss / 1024
    return Cost(time.perf_counter() - start, usage.ru_utime + usage.ru_stime, int(kibibytes * 1024))


def tool(name: str) -> str:
    """A console script of this Python's environment, else the one on PATH.

    Raises:
        BenchError: there is none.
    """
    beside = Path(sys.executable).with_name(name)
    found = str(beside) if beside.is_file() else shutil.which(name)
    if found is None:
        raise BenchError(f"there is no {name}: run this with the Python of an environment that has nerfstudio")
    return found


def say(text: str) -> None:
    """Progress on stderr, apart from the tables."""
    print(f"[{datetime.datetime.now():%H:%M:%S}] {printable(text)}", file=sys.stderr, flush=True)
