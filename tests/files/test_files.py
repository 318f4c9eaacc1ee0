"""Atomic writes: kills at every step, locks of live and dead processes, correct error messages."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bitymi_ns import files, locks
from bitymi_ns.safe_reading import read_text

WAITS = """
import sys
from pathlib import Path
from bitymi_ns import files, locks

path = Path(sys.argv[1])
with {call}:
    print("has it", flush=True)
    sys.stdin.read()
"""


@contextmanager
def another_process(call: str, path: Path) -> Iterator[subprocess.Popen]:
    """Run a process within `with <call>` until it is killed."""
    code = WAITS.format(call=call)
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "has it\n"
        yield process
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["file", "folder", "bundle"])
def test_a_kill_at_any_step_leaves_the_old_or_the_new_and_nothing_else(kind: str, tmp_path: Path) -> None:
    script = Path(__file__).with_name("kill_everywhere.py")
    done = subprocess.run([sys.executable, script, kind, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("kills") == 2


@pytest.mark.parametrize("call", ["files.complete_folder(path)", "files.reserved(path, lambda: None)"])
def test_a_folder_has_one_writer_and_the_next_one_cleans_up(tmp_path: Path, call: str) -> None:
    with another_process(call, tmp_path / "b") as process:
        before = names(tmp_path)
        with pytest.raises(locks.Busy, match=f"process {process.pid} is writing there: wait for it, or end it"):
            with files.complete_folder(tmp_path / "b"):
                pass
        assert names(tmp_path) == before and ".b.lock" in before
    assert names(tmp_path) == before  # killed
    with files.complete_folder(tmp_path / "b") as new:
        (new / "x").write_text("y")
    assert names(tmp_path) == ["b"] and names(tmp_path / "b") == ["x"]


def test_an_unfinished_file_is_removed_when_its_process_has_ended(tmp_path: Path) -> None:
    with another_process("files.complete_file(path)", tmp_path / "f"):
        files.remove_unfinished(tmp_path)
        assert names(tmp_path) == [".f.unfinished"]
        with pytest.raises(locks.Busy, match="another process is writing it"):
            files.write_file(tmp_path / "f", b"")
    files.remove_unfinished(tmp_path)
    assert names(tmp_path) == []


def test_a_lock_may_be_taken_again_by_its_thread_alone(tmp_path: Path) -> None:
    with files.reserved(tmp_path / "b") as place, files.reserved(tmp_path / "b"):
        assert names(tmp_path) == [".b.lock"]
        with pytest.raises(locks.Busy, match=f"process {os.getpid()}"):
            locks.Lock(place.with_name(".b.lock"))
    assert names(tmp_path) == []


def test_a_file_system_without_locks_costs_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*arguments: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(locks.fcntl, "flock", no_locks)
    told: list[str] = []
    with files.complete_folder(tmp_path / "b", tell=told.append) as new:
        (new / "x").write_text("y")
    (warning,) = told
    assert "without locks: see that no other process writes there" in warning
    files.write_file(tmp_path / "f", b"x")
    (tmp_path / ".g.unfinished").write_text("whose is it?")
    files.remove_unfinished(tmp_path)
    assert names(tmp_path) == [".g.unfinished", "b", "f"]


def test_parents_that_were_made_for_nothing_go_again(tmp_path: Path) -> None:
    files.check_writable(Path("/dev/null"))
    files.write_file(Path("/dev/null"), b"x")
    assert not Path("/dev/null").is_file()  # devices are written directly
    files.check_writable(tmp_path / "a" / "b" / "c")
    assert names(tmp_path) == []
    with files.complete_folder(tmp_path / "a" / "b" / "c"):
        pass
    assert names(tmp_path / "a" / "b") == ["c"]


def below_a_file(folder: Path) -> Path:
    (folder / "file").write_text("")
    return folder / "file" / "x" / "y"


def a_loop(folder: Path) -> Path:
    (folder / "loop").symlink_to(folder / "loop")
    return folder / "loop" / "x"


@pytest.mark.parametrize(
    ("place", "why"),
    [
        (below_a_file, "file is not a folder: choose another path"),
        (a_loop, "leads back to itself|is a link to nothing"),
        (lambda folder: folder / ("x" * 300), "the name is too long: choose a shorter one"),
        (lambda folder: Path("/proc/nothing/b"), "nothing can be made in /proc .*: choose another folder"),
        (lambda folder: Path("/sys/b"), "does not permit|no permission|read-only"),
        (lambda folder: Path("/proc"), "mount point"),
        (lambda folder: folder, "it is a folder, not a file"),
    ],
)
def test_what_cannot_be_written_is_explained(tmp_path: Path, place: Callable[[Path], Path], why: str) -> None:
    target = place(tmp_path)
    with pytest.raises(ValueError, match=f"cannot be written: .*({why})"), files.write_errors_as(target, ValueError):
        files.check_writable(target)


@pytest.mark.parametrize("kind", ["file", "dangling link", "link to a file"])
def test_a_file_or_a_link_to_nothing_is_never_replaced_by_a_folder(tmp_path: Path, kind: str) -> None:
    target = tmp_path / "thesis"
    (tmp_path / "file").write_text("precious")
    if kind == "file":
        target.write_text("precious")
    else:
        target.symlink_to(tmp_path / ("file" if kind == "link to a file" else "nothing"))
    before = names(tmp_path)
    with pytest.raises(ValueError, match="thesis is (not a folder|a link to nothing)|file is not a folder"):
        with files.write_errors_as(target, ValueError), files.complete_folder(target):
            raise AssertionError("the work has begun")
    assert names(tmp_path) == before and (kind == "dangling link" or target.read_text() == "precious")


def test_a_file_that_the_user_names_is_written_through_a_link_and_others_replace_it(tmp_path: Path) -> None:
    (tmp_path / "big").mkdir()
    for name, follow in (("named", True), ("inside", False)):
        (tmp_path / name).symlink_to(tmp_path / "big" / name)
        files.write_file(tmp_path / name, b"new", follow)
        assert (tmp_path / name).is_symlink() == (tmp_path / "big" / name).is_file() == follow
    assert names(tmp_path) == ["big", "inside", "named"] and names(tmp_path / "big") == ["named"]


def test_an_error_elsewhere_is_not_blamed_on_the_result(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="other"), files.write_errors_as(tmp_path / "a", ValueError):
        (tmp_path / "other").read_text()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("file systems cannot be mounted here")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_read_only_and_a_full_disk(small_disk: Path) -> None:
    files.write_file(small_disk / "f", b"old")
    with pytest.raises(ValueError, match="the disk is full: free some space"):
        with files.write_errors_as(small_disk / "f", ValueError):
            files.write_file(small_disk / "f", bytes(2 << 20))
    assert names(small_disk) == ["f"] and (small_disk / "f").read_bytes() == b"old"
    assert 0 < files.free_bytes(small_disk / "a" / "b") < 1 << 20
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    with pytest.raises(ValueError, match="the file system is read-only: write to another one"):
        with files.write_errors_as(small_disk / "b", ValueError):
            files.check_writable(small_disk / "b")


OVERLAY = """
set -e
cd "$1"; mkdir -p lower/bundle/parts mounted; echo old > lower/bundle/x
mount -t tmpfs none mounted; mkdir mounted/upper mounted/work mounted/seen
mount -t overlay -o lowerdir=lower,upperdir=mounted/upper,workdir=mounted/work none mounted/seen
exec "$2" -c "$3" "$1/mounted/seen/bundle"
"""
REPLACED = """
import sys
from pathlib import Path
from bitymi_ns import files

path = Path(sys.argv[1])
with files.write_errors_as(path, SystemExit), files.complete_folder(path) if path.is_dir() else files.reserved(path):
    raise SystemExit("the work has begun")
"""


def test_a_folder_of_a_lower_layer_is_refused_before_the_work(tmp_path: Path) -> None:
    command = ["unshare", "-m", "bash", "-c", OVERLAY, "-", tmp_path, sys.executable, REPLACED]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.stderr.startswith(("mount: ", "unshare: ")):
        pytest.skip("overlays cannot be mounted here")
    assert "bundle cannot be written: it lies in a lower layer of an overlay" in done.stderr
    assert (tmp_path / "lower/bundle/x").read_text() == "old\n"


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_its_attributes_protect_is_refused_before_the_work(kind: str, tmp_path: Path) -> None:
    target = tmp_path / "a"
    target.touch() if kind == "file" else target.mkdir()
    if shutil.which("chattr") is None or subprocess.run(["chattr", "+i", target], capture_output=True).returncode:
        pytest.skip("files cannot be made immutable here")
    try:
        done = subprocess.run([sys.executable, "-c", REPLACED, target], capture_output=True, text=True, check=False)
        assert "a cannot be written: the system does not permit it, as after `chattr +i`" in done.stderr
        assert names(tmp_path) == ["a"]
    finally:
        subprocess.run(["chattr", "-i", target], check=True)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
def test_text_says_how_it_is_encoded(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.txt"
    path.write_text(("\ufeff" if encoding == "utf-16-le" else "") + "# \u00fc\n", encoding)
    assert read_text(path) == "# \u00fc\n"
    path.write_bytes(b"")
    assert read_text(path) == ""
