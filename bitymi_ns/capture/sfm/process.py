"""Run COLMAP in a process of its own: Ctrl-C can end it at once, and an abort of COLMAP ends nothing else."""

import json
import os
import re
import shutil
import sqlite3
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from bitymi_ns.files import size_text
from bitymi_ns.progress import Progress
from bitymi_ns.trust import no_links, python_command
from ..types import CaptureError
from .job import DATABASE, PAIRS, Job

LOG = "colmap.log"
LITTLE_SPACE = 50_000_000  # free bytes that count as a full disk


def run(job: Job, source: Path, progress: Progress) -> dict[str, Any]:
    """Run a job, and return the worker's result. Raises CaptureError: there are no poses, or COLMAP failed."""
    work = Path(job.work)
    watching = ExitStack()
    with open(work / LOG, "wb", opener=no_links) as log:
        streams = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": log}
        how = {"text": True, "encoding": "utf8", "env": {**os.environ, "PYTHONUNBUFFERED": "1"}}
        how["start_new_session"] = True  # Ctrl-C comes to this process alone
        process = subprocess.Popen(python_command("bitymi_ns.capture.sfm.worker", "main"), **streams, **how)
        try:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(job.text() + "\n")
            process.stdin.flush()
            for text in process.stdout:
                line = json.loads(text)
                if "failure" in line:
                    wanted = "points" if job.poses else "camera poses"
                    raise CaptureError(f"no {wanted} can be found in {source}: {line['failure']}")
                if "result" in line:
                    return line["result"]
                watching.close()
                progress(line["stage"], line["done"], line["total"])
                if line["counts"]:
                    watched = _watched(work / DATABASE, line["counts"], progress, line["stage"], line["total"])
                    watching.enter_context(watched)
        except BrokenPipeError:
            pass
        finally:
            watching.close()
            process.kill()
            process.wait()
    raise CaptureError(_why_ended(work, source, process.returncode))


@contextmanager
def _watched(database: Path, table: str, progress: Progress, stage: str, total: int) -> Iterator[None]:
    """Report the rows of a table while COLMAP fills it. They are counted in this process: COLMAP's SQLite and Python's
    in one process would release each other's file locks."""
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(0.5):
            progress(stage, min(rows(database, table), total), total)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def rows(database: Path, table: str) -> int:
    """Count the rows of a table; 0 if it cannot be read. Not in a process in which COLMAP has the database open."""
    where = f"{database.absolute().as_uri()}?mode=ro"
    with suppress(sqlite3.Error), closing(sqlite3.connect(where, uri=True, timeout=5)) as connection:
        return connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
    return 0


def delete_work(work: Path, *folders: str) -> None:
    """Delete features, matches, pairs and `folders` from a work folder."""
    for name in (DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm", PAIRS):
        with suppress(OSError):
            (work / name).unlink()
    for name in folders:
        shutil.rmtree(work / name, ignore_errors=True)


def _why_ended(work: Path, source: Path, code: int) -> str:
    log = (work / LOG).read_text("utf8", errors="replace")
    said = [line for line in log.splitlines() if line.strip() and not re.match(r"\*\*\* |PC: @| +@ ", line)]
    last = said[-1].split("] ", 1)[-1].strip() if said else ""
    free = shutil.disk_usage(work).free
    signs = ("disk is full", "No space left", "disk I/O error", "File too large", "readonly database")
    full = any(sign in log for sign in signs)
    if full or free < LITTLE_SPACE:
        full_disk = f"disk or quota is full ({size_text(free)} free on the disk)"
        return f"{work} cannot be written: {full_disk}. Free some space, and start again: what is done is kept"
    if "database disk image is malformed" in log:
        delete_work(work)
        return f"features and matches kept in {work} were damaged and have been removed: start again"
    if code in (-9, 137):
        killed = f"the finding of poses of {source} was killed: the machine may have run out of memory"
        return f"{killed}. Start again, it goes on; a smaller max_image_size needs less"
    return f"COLMAP failed on {source}: {last or f'it ended with status {code}'}. All it said is in {work / LOG}"
