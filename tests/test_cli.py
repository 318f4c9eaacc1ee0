"""The `bitymi` console script: thin calls, and errors in one line."""

import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

from bitymi_ns import __main__, cli
from tests.typed import Patch, Printed


def test_sample(tmp_path: Path, capsys: Printed) -> None:
    args = ["sample", "--output-dir", str(tmp_path / "room"), "--views", "1", "--width", "16", "--height", "12"]
    assert cli.main(args) == 0
    assert (tmp_path / "room" / "transforms.json").is_file()
    assert "Wrote 1 images" in capsys.readouterr().out
    assert cli.main(args) == 1
    error = capsys.readouterr().err
    assert "--overwrite" in error and error.count("\n") == 1
    assert cli.main([*args, "--overwrite"]) == 0


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["sample", "--output-dir", "{}/room", "--views", "0"], "bitymi: views must be at least 1, got 0\n"),
        (["sample", "--output-dir", "{}/file/room"], "bitymi: {0}/file/room cannot be written: {0}/file is not a"),
        (["report", "{}/missing.json", "--output-dir", "{}/report"], "bitymi: {0}/missing.json does not exist"),
        (["report"], "bitymi: nothing to report"),
    ],
)
def test_mistakes_are_a_line(tmp_path: Path, words: list[str], error: str, capsys: Printed) -> None:
    (tmp_path / "file").write_text("")
    assert cli.main([word.format(tmp_path) for word in words]) == 1
    said = capsys.readouterr().err
    assert said.startswith(error.format(tmp_path)) and said.count("\n") == 1


@pytest.mark.slow
def test_what_nobody_can_act_on_is_not_said_and_nothing_is_written_elsewhere(tmp_path: Path) -> None:
    assert cli.Stability().output == Path("stability.md")  # in the current folder
    old = "warnings.warn_explicit('old', FutureWarning, 'a.py', 1, '{}.activations')"
    code = ["import sys, warnings", "from bitymi_ns.__main__ import main", "sys.argv[1:] = ['report']", "main()"]
    for module, said in (("nerfstudio", False), ("mine", True)):
        script = "; ".join([*code, old.format(module)])
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path)
        assert "nothing to report" in done.stderr and ("FutureWarning: old" in done.stderr) == said


FULL = "{} cannot be written: the disk is full: free some space, or write to another disk\n"


@pytest.mark.parametrize(
    ("problem", "status", "error"),
    [(OSError(28, "No space left on device"), 1, FULL), (KeyboardInterrupt(), 130, "interrupted")],
)
def test_a_full_disk_and_ctrl_c_are_named(
    tmp_path: Path, monkeypatch: Patch, capsys: Printed, problem: BaseException, status: int, error: str
) -> None:
    def failing(*args: object, **kwargs: object) -> None:
        raise problem

    monkeypatch.setattr("bitymi_ns.sample.generate", failing)
    monkeypatch.setattr("sys.argv", ["bitymi", "sample", "--output-dir", str(tmp_path / "room")])
    assert __main__.main() == status
    assert error.format(tmp_path / "room") in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a\x1b[2Jb", "\udcff", "\rx"])
def test_names_do_not_control_the_terminal(tmp_path: Path, capsys: Printed, name: str) -> None:
    (tmp_path / name).touch()
    shown = name.encode("unicode_escape").decode()
    for command in ("sfm", "verify", "report", "view", "pack", "extras"):
        assert cli.main([command, str(tmp_path / name)]) == 1
        said = capsys.readouterr()
        assert shown in said.err + said.out and name not in said.err + said.out
    small = ["--views", "1", "--width", "16", "--height", "12"]
    assert cli.main(["sample", "--output-dir", str(tmp_path / f"{name}2"), *small]) == 0
    assert shown in capsys.readouterr().out


def test_report_calls_build(tmp_path: Path, monkeypatch: Patch) -> None:
    import bitymi_ns.measure.report.page

    build = Mock(return_value=tmp_path / "index.html")
    monkeypatch.setattr(bitymi_ns.measure.report.page, "build", build)
    assert cli.main(["report", "a.json", "b.json", "--output-dir", str(tmp_path), "--title", "Two"]) == 0
    build.assert_called_once_with((Path("a.json"), Path("b.json")), tmp_path, "Two")
