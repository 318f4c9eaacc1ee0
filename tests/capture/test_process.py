"""Runs that are interrupted or cannot write."""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bitymi_ns.capture.poses import find_poses
from bitymi_ns.capture.sfm.job import Job
from bitymi_ns.capture.sfm.process import rows

Copy = Callable[[str], Path]
COMMAND = [sys.executable, "-m", "bitymi_ns", "sfm"]


def database(folder: Path) -> Path | None:
    return next(iter(folder.glob(".bitymi/*/database.db")), None)


def started(folder: Path, prepare: Callable[[], object] = lambda: None) -> subprocess.Popen:
    def preexec() -> None:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # background jobs of a shell ignore it
        prepare()

    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    return subprocess.Popen([*COMMAND, str(folder)], **pipes, start_new_session=True, preexec_fn=preexec)


def wait_for(condition: Callable[[], bool], seconds: float = 120) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.05)


def workers(folder: Path) -> list[str]:
    """List the processes with an open file in the folder."""
    found = []
    for process in Path("/proc").iterdir():
        if process.name.isdecimal():
            try:
                found += [process.name for link in (process / "fd").iterdir() if str(folder) in os.readlink(link)]
            except OSError:
                continue
    return found


@pytest.mark.slow
def test_a_killed_run_leaves_no_process_and_goes_on_where_it_stopped(copied: Copy) -> None:
    folder = copied("killed")
    run = started(folder)
    wait_for(lambda: (db := database(folder)) is not None and rows(db, "keypoints") >= 3)
    run.kill()
    run.communicate()
    wait_for(lambda: not workers(folder))
    done = rows(database(folder), "keypoints")
    assert done >= 3

    told: list[tuple[str, int]] = []
    poses = find_poses(folder, progress=lambda step, done, total: told.append((step, done)))
    assert poses.registered == 8
    counted = [count for step, count in told if step == "finding features"]
    assert counted[0] == 0 and min(counted[1:]) >= done, "what the first run found was kept"
    assert not list(folder.glob(".bitymi/*/.*.new"))


@pytest.mark.slow
def test_ctrl_c_ends_it_without_a_traceback(copied: Copy) -> None:
    folder = copied("interrupted")
    run = started(folder)
    wait_for(lambda: (db := database(folder)) is not None and rows(db, "keypoints") >= 1)
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=60)
    assert run.returncode == 130 and "interrupted" in said and "Traceback" not in said
    wait_for(lambda: not workers(folder))


@pytest.mark.slow
def test_a_full_disk_is_named(copied: Copy) -> None:
    folder = copied("full")
    limit = 300_000  # largest file size, as on a nearly full disk

    def little_space() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    run = started(folder, little_space)
    _, said = run.communicate(timeout=120)
    assert run.returncode == 1 and "Traceback" not in said
    assert "cannot be written" in said and "Free some space" in said
    assert find_poses(folder).registered == 8


@pytest.mark.slow
def test_a_read_only_folder_is_no_hindrance(copied: Copy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = copied("read only")
    real = Path.mkdir

    def refuse(path: Path, *arguments: object, **options: object) -> None:
        if folder in path.parents:
            raise OSError(30, os.strerror(30), str(path))
        real(path, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(Path, "mkdir", refuse)
    poses = find_poses(folder)
    assert poses.registered == 8 and tmp_path / "cache" in poses.model.parents
    assert not (folder / ".bitymi").exists()


@contextmanager
def worker_that_finds(tmp_path: Path, found: str) -> Iterator[subprocess.Popen[str]]:
    """Start the process of COLMAP with a job that finds this."""
    code = f"""if True:
        import os, resource, pycolmap
        from bitymi_ns.capture.sfm import worker
        def find(job, stages):
            {found}
        worker.find = find
        worker.main()"""
    job = Job(str(tmp_path), str(tmp_path), None, [], [], {}, False, {})
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as worker:
        assert worker.stdin is not None
        worker.stdin.write(job.text() + "\n")
        worker.stdin.flush()
        yield worker


def test_what_libraries_print_is_no_message(tmp_path: Path) -> None:
    found = 'os.write(1, b"BLAS : Bad memory unallocation!\\n"); raise worker.NoPoses("nothing")'
    with worker_that_finds(tmp_path, found) as worker:
        assert worker.stdout is not None and worker.stderr is not None
        assert json.loads(worker.stdout.readline()) == {"failure": "nothing"}
        assert "BLAS" in worker.stderr.read()


def test_a_model_that_cannot_be_written_has_its_reason(tmp_path: Path) -> None:
    found = "resource.setrlimit(resource.RLIMIT_FSIZE, (7, 7)); return pycolmap.Reconstruction(), {}"
    with worker_that_finds(tmp_path, found) as worker:
        assert worker.stdout is not None
        lines = [json.loads(line) for line in worker.stdout]
    why = f"{tmp_path / 'model'} cannot be written: the file would be larger than this system allows (see `ulimit -f`)"
    assert lines[-1] == {"failure": f"{why}. Start again then: what is done is kept."}


@pytest.mark.slow
@pytest.mark.parametrize("before", ["", "signal.signal(15, lambda *_: os._exit(3)); "])
def test_signals_end_a_program_as_before_it_read_a_capture(before: str) -> None:
    program = f"import os, signal; {before}from bitymi_ns.capture import poses, read; os.kill(os.getpid(), 15)"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True)
    assert (ended.returncode, ended.stderr) == (3 if before else -15, b"")
