"""Interrupted commands, closed pipes and full disks end in one line without a traceback."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from PIL import Image

from bitymi_ns import exit_messages
from bitymi_ns.capture import known_poses, sfm_photos
from bitymi_ns.measure.report import pictures
from bitymi_ns.plugin.run.trainer import BitymiPipeline
from bitymi_ns.safe_reading import reading
from bitymi_ns.trust import python_command

BITYMI = python_command("bitymi_ns.__main__", "main")


def test_a_reader_that_goes_away_is_no_error() -> None:
    for words in (["--help"], ["sample", "--help"]):
        with subprocess.Popen([*BITYMI, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            assert process.stdout is not None and process.stderr is not None
            process.stdout.close()  # like `| head -c0`
            said = process.stderr.read().decode()
        assert process.returncode == exit_messages.NO_READER and said == ""


@pytest.mark.parametrize("after", [0.15, 0.6])
def test_ctrl_c_in_the_first_second(after: float) -> None:
    """While modules are imported."""
    code = (
        "import sys, time, importlib.abc\n"
        "class Slow(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path, target=None):\n"
        "        if name == 'bitymi_ns.cli': print('importing', flush=True); time.sleep(60)\n"
        "sys.meta_path.insert(0, Slow())\n"
        "from bitymi_ns.__main__ import main\n"
        "sys.exit(main())"
    )
    command = [sys.executable, "-c", code, "--help"]
    heeds = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # background jobs of a shell ignore it
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heeds
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "importing\n"
        time.sleep(after)
        os.kill(process.pid, signal.SIGINT)
        _, said = process.communicate()
    assert process.returncode == 130
    assert said == "bitymi: interrupted\n"


@pytest.mark.parametrize(
    ("error", "line"),
    [
        ("KeyboardInterrupt", "bitymi: interrupted\n"),
        ("OSError(28, 'No space', 'a.png')", "bitymi: a.png cannot be written: the disk is full: free some space"),
        ("OSError(28, 'No space')", "bitymi: a result cannot be written: the disk is full"),
        ("OSError(30, 'Read-only', 'a')", "bitymi: a cannot be written: the file system is read-only"),
        ("OSError(5, 'I/O error', 'a')", "bitymi: a cannot be read or written: the disk reports an error of its own"),
        ("OSError(24, 'Too many', 'a')", "bitymi: a cannot be read or written: too many files are open: allow more"),
        ("MemoryError()", "bitymi: there is not enough memory for this"),
        ("RuntimeError('[enforce] DefaultCPUAllocator: not enough memory')", "bitymi: there is not enough memory"),
        ("RuntimeError('CUDA out of memory. Tried to allocate 2 GiB')", "bitymi: there is not enough memory"),
        ("OSError(12, 'Cannot allocate memory')", "bitymi: there is not enough memory"),
        ("ImportError('a.so: cannot map it: Cannot allocate memory')", "bitymi: there is not enough memory"),
        ("OSError(13, 'Permission denied', 'a')", "bitymi: a cannot be read or written: you have no permission for"),
        ("OSError(2, 'No such file', 'a')", "bitymi: a cannot be read or written: it does not exist: check the path"),
    ],
)
def test_commands_of_others_end_in_one_line(error: str, line: str) -> None:
    """nerfstudio's commands catch nothing themselves."""
    code = f"from bitymi_ns import exit_messages; exit_messages.install(); exit_messages.install(); raise {error}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stderr.startswith(line) and done.stderr.count("\n") == 1
    assert done.returncode in (1, -signal.SIGINT)  # shells show 130


def _read(path: Path) -> None:
    with reading(path, ValueError, "It is damaged."):
        raise RuntimeError("[enforce fail at alloc_cpu.cpp] DefaultCPUAllocator: can't allocate memory")


@pytest.mark.parametrize(
    ("owner", "name", "read"),
    [
        (sfm_photos, "open_picture", lambda path: sfm_photos.read_photo(path.parent, path.name)),
        (known_poses, "read_image", lambda a: known_poses._job(["a"], [SimpleNamespace(file=a)], [], a.parent)),
        (Image, "open", pictures.open_image),
        (VanillaPipeline, "load_pipeline", lambda _: BitymiPipeline.__new__(BitymiPipeline).load_pipeline({}, 3)),
        (sfm_photos, "open_picture", _read),
    ],
)
def test_files_are_not_blamed_for_a_lack_of_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, owner: object, name: str, read: Callable[[Path], object]
) -> None:
    (tmp_path / "a.jpg").write_bytes(b"")
    raised = RuntimeError("CUDA out of memory") if owner is VanillaPipeline else MemoryError()
    monkeypatch.setattr(owner, name, Mock(side_effect=raised))
    with pytest.raises((MemoryError, RuntimeError, ValueError)) as stop:
        read(tmp_path / "a.jpg")
    assert stop.value is raised or str(stop.value).endswith(
        "a.jpg cannot be read: it takes more memory than there is. End other programs, or make it smaller."
    )


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("begun", ["exit_messages.install(); work()", "sys.exit(exit_messages.run(work))"])
def test_signals_of_others_remove_what_was_begun(how: signal.Signals, begun: str, tmp_path: Path) -> None:
    code = (
        "import sys, time\n"
        "from bitymi_ns import exit_messages, files\n"
        "def work():\n"
        f"    with files.complete_folder({str(tmp_path / 'a')!r}): print('begun', flush=True); time.sleep(60)\n"
        f"{begun}"
    )
    heeds = partial(signal.signal, how, signal.SIG_DFL)  # nohup ignores one of them
    command, pipe = [sys.executable, "-c", code], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=heeds) as process:
        assert process.stdout is not None and process.stdout.readline() == "begun\n"
        os.kill(process.pid, how)
        _, said = process.communicate()
    assert said == "bitymi: interrupted\n" and list(tmp_path.iterdir()) == []


def test_a_signal_to_an_interpreter_that_shuts_down_is_silent() -> None:
    code = (
        "import atexit, os, signal; from bitymi_ns import exit_messages\n"
        "atexit.register(lambda: os.kill(os.getpid(), signal.SIGTERM)); exit_messages.install()"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == -signal.SIGTERM and ended.stderr == ""


def test_a_command_leaves_the_signals_as_they_were() -> None:
    before = [signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP)]
    assert exit_messages.run(lambda: 3) == 3
    assert [signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP)] == before


def test_faults_of_the_program_keep_their_traceback() -> None:
    code = "from bitymi_ns import exit_messages; exit_messages.install(); raise ZeroDivisionError"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "Traceback" in done.stderr and done.returncode == 1
    with pytest.raises(KeyError):
        exit_messages.run(lambda: {}["missing"])


def test_work_goes_on_when_nobody_reads_its_output(tmp_path: Path) -> None:
    code = (
        "import sys; from bitymi_ns import exit_messages; exit_messages.outlive_output(); sys.stdin.read()\n"
        "for _ in range(100): print('x' * 1000, flush=True)\n"
        f"open({str(tmp_path / 'done')!r}, 'w').close()"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, stderr=pipe) as process:
        assert process.stdin is not None and process.stdout is not None and process.stderr is not None
        process.stdout.close()  # like `| head`
        process.stdin.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0 and (tmp_path / "done").exists()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has it")
def test_output_on_a_full_disk() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run([*BITYMI, "--help"], stdout=full, stderr=subprocess.PIPE, text=True)
    assert "the disk is full" in done.stderr and "Traceback" not in done.stderr
