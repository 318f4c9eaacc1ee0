"""The `bitymi` console script: thin calls, and mistakes answered in one line."""

from pathlib import Path

import pytest

from bitymi_ns import cli


def test_sample(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["sample", "--output-dir", str(tmp_path / "room"), "--views", "1", "--width", "16", "--height", "12"]
    assert cli.main(args) == 0
    assert (tmp_path / "room" / "transforms.json").is_file()
    assert "Wrote 1 images" in capsys.readouterr().out
    assert cli.main(args) == 1
    error = capsys.readouterr().err
    assert "--overwrite" in error and error.count("\n") == 1
    assert cli.main([*args, "--overwrite"]) == 0


def test_bad_value_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["sample", "--output-dir", str(tmp_path / "room"), "--views", "0"]) == 1
    assert capsys.readouterr().err == "bitymi: views must be at least 1, got 0\n"


@pytest.mark.parametrize("name", ["a\x1b[2Jb", "\udcff", "\rx"])
def test_names_do_not_control_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    (tmp_path / name).touch()
    shown = name.encode("unicode_escape").decode()
    for command in ("sfm", "verify", "report", "view", "pack", "extras"):
        assert cli.main([command, str(tmp_path / name)]) == 1
        said = capsys.readouterr()
        assert shown in said.err + said.out and name not in said.err + said.out
    small = ["--views", "1", "--width", "16", "--height", "12"]
    assert cli.main(["sample", "--output-dir", str(tmp_path / f"{name}2"), *small]) == 0
    assert shown in capsys.readouterr().out


def test_unwritable_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert cli.main(["sample", "--output-dir", str(tmp_path / "file" / "room")]) == 1
    error = capsys.readouterr().err
    assert error.startswith(
        f"bitymi: {tmp_path / 'file' / 'room'} cannot be written: {tmp_path / 'file'} is not a folder"
    )
    assert error.count("\n") == 1


def test_a_full_disk_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import bitymi_ns.sample

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(bitymi_ns.sample, "generate", full)
    assert cli.main(["sample", "--output-dir", str(tmp_path / "room")]) == 1
    assert capsys.readouterr().err == (
        f"bitymi: {tmp_path / 'room'} cannot be written: the disk is full: free some space, or give a place on another "
        "disk\n"
    )


def test_report_calls_build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import bitymi_ns.measure.report

    seen = {}

    def build(inputs: list[Path], output_dir: Path, title: str = "") -> Path:
        seen.update(inputs=inputs, output_dir=output_dir, title=title)
        return output_dir / "index.html"

    monkeypatch.setattr(bitymi_ns.measure.report, "build", build, raising=False)
    assert cli.main(["report", "a.json", "b.json", "--output-dir", str(tmp_path), "--title", "Two"]) == 0
    expected = {"inputs": [Path("a.json"), Path("b.json")], "output_dir": tmp_path, "title": "Two"}
    assert seen == expected


def test_broken_report_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report", str(tmp_path / "missing.json"), "--output-dir", str(tmp_path / "report")]) == 1
    error = capsys.readouterr().err
    assert error.startswith("bitymi: ") and "missing.json" in error and error.count("\n") == 1


def test_report_without_inputs(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["report"]) == 1
    assert "nothing to report" in capsys.readouterr().err


def test_interrupt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(*args: object, **kwargs: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("bitymi_ns.sample.generate", interrupted)
    assert cli.main(["sample", "--output-dir", str(tmp_path / "room")]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_help_lists_commands(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    assert "sample" in out and "report" in out
