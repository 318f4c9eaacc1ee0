"""Subprocesses with measured time and memory."""

import datetime
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from bitymi_ns.locks import Lock
from bitymi_ns.trust import no_links, printable

TAIL = 25  # lines of a failed command's log to show
GRACE = 20.0  # seconds between terminating and killing a command


class BenchError(ValueError):
    """The benchmark cannot be run."""


class CommandFailed(BenchError):
    """A command failed; the message has the end of its log."""


def run_measured(command: Sequence[str], log: Path, lock: Lock | None = None) -> dict[str, float]:
    """Run a command with its output in a file; return `process_seconds`, `process_cpu_seconds` and `peak_bytes` of it
    with all threads and children. Raises CommandFailed. `lock`: inherited by the command and labelled with its process,
    so that it stays locked if this process is killed."""
    log.parent.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    with open(log, "wb", opener=no_links) as out:
        try:
            process = subprocess.Popen(
                command,
                env={**os.environ, "OMP_WAIT_POLICY": "passive"},  # CPU seconds measure work, not spinning
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
        ended = f"{shlex.join(command)} ended with status {process.returncode}"
        raise CommandFailed(f"{ended}; see {log}, whose end is:\n{tail}")
    kibibytes = usage.ru_maxrss if sys.platform != "darwin" else usage.ru_maxrss / 1024
    return {
        "process_seconds": round(time.perf_counter() - start, 2),
        "process_cpu_seconds": round(usage.ru_utime + usage.ru_stime, 2),
        "peak_bytes": int(kibibytes * 1024),
    }


def tool(name: str) -> str:
    """Find a console script in this Python's environment or on PATH. Raises BenchError: it is missing."""
    beside = Path(sys.executable).with_name(name)
    path = str(beside) if beside.is_file() else shutil.which(name)
    if path is None:
        raise BenchError(f"there is no {name}: run this with the Python of an environment that has nerfstudio")
    return path


def say(text: str) -> None:
    """Print progress to stderr."""
    print(f"[{datetime.datetime.now():%H:%M:%S}] {printable(text)}", file=sys.stderr, flush=True)
