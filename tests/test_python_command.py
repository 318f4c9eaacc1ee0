"""Python processes run no code from the current folder."""

import subprocess
from pathlib import Path

import pytest

import bitymi_ns
from bitymi_ns.capture.sfm import process
from bitymi_ns.capture.sfm.job import Job
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.trust import python_command

PACKAGE = Path(bitymi_ns.__file__).parent


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with modules that leave a mark when run."""
    for name in ("getpass", "json", "os", "numpy", "pycolmap"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_function_is_called_and_no_module_of_the_current_folder(hostile: Path) -> None:
    command = python_command("getpass", "getuser")
    command[-1] = command[-1].replace("sys.exit(", "print(")
    done = subprocess.run(command, env={"USER": "somebody"}, capture_output=True, text=True, check=True)
    assert done.stdout == "somebody\n" and not (hostile / "ran").exists()


def test_colmap_is_started_beside_hostile_modules(hostile: Path) -> None:
    job = Job(str(hostile), str(hostile), None, [], [], {}, False, {})
    with pytest.raises(CaptureError):  # no photographs
        process.run(job, hostile, lambda *told: None)
    assert not (hostile / "ran").exists()


def test_python_is_started_this_way_alone() -> None:
    here = {"trust.py", "measure/bench/process.py"}  # finds programs beside Python
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text("utf8")
        starts = "sys.executable" in text and path.relative_to(PACKAGE).as_posix() not in here
        assert not starts and "multiprocessing" not in text, f"{path} starts Python by itself"
