"""COLMAP in a process of its own: Ctrl-C ends it at once, and where it aborts, which its library does, only it does."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from bitymi_ns.capture.sfm.job import Job
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.files import size_text
from bitymi_ns.progress import Progress

LOG = "colmap.log"
LITTLE_SPACE = 50_000_000
"""Bytes; where less is left, the disk is what stopped COLMAP."""


def run(job: Job, source: Path, progress: Progress) -> dict[str, object]:
    """Run a job to its end.

    Args:
        job: what is to be done.
        source: the photographs or the video, for messages.
        progress: told the stage and how far it is.

    Returns:
        what the worker found.

    Raises:
        CaptureError: there are no poses, or COLMAP ended otherwise.
    """
    work = Path(job.work)
    with open(work / LOG, "wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "bitymi_ns.capture.sfm.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            encoding="utf8",
            start_new_session=True,  # Ctrl-C comes to us, and we end it
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        )
        try:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(job.text() + "\n")
            process.stdin.flush()
            for text in process.stdout:
                line = json.loads(text)
                if "failure" in line:
                    raise CaptureError(f"no camera poses can be found in {source}: {line['failure']}")
                if "result" in line:
                    return line["result"]
                progress(line["stage"], line["done"], line["total"])
        except BrokenPipeError:
            pass
        finally:
            process.kill()
            process.wait()
    raise CaptureError(_why_ended(work, source, process.returncode))


def _why_ended(work: Path, source: Path, code: int) -> str:
    log = (work / LOG).read_text("utf8", errors="replace")
    said = [
        line for line in log.splitlines() if line.strip() and "@ 0x" not in line.replace("@  ", "@ ").replace("  ", " ")
    ]
    last = said[-1].split("] ", 1)[-1] if said else ""
    free = shutil.disk_usage(work).free
    full = any(
        word in log
        for word in ("disk is full", "No space left", "disk I/O error", "File too large", "readonly database")
    )
    if full or free < LITTLE_SPACE:
        return (
            f"{work} cannot be written: the disk or the quota is full ({size_text(free)} free on the disk). Free some "
            "space, and start again: what is done is kept"
        )
    if code in (-9, 137):
        return (
            f"the finding of poses of {source} was killed: the machine may have run out of memory. Start it again, it "
            "goes on where it stopped; a smaller max_image_size needs less"
        )
    return f"COLMAP failed on {source}: {last or f'it ended with status {code}'}. All it said is in {work / LOG}"
