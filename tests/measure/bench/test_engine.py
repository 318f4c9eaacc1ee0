"""The matrix engine: what runs, what is skipped, and recovery from failures and kills."""

import json
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from bitymi_ns.cli import main
from bitymi_ns.locks import Lock
from bitymi_ns.measure.bench import engine
from bitymi_ns.measure.bench.cells import Cells, identity
from bitymi_ns.measure.bench.engine import run_chains
from bitymi_ns.measure.bench.matrix import Chain, Row, Scene, chains
from bitymi_ns.measure.bench.process import BenchError, CommandFailed, run_measured, tool


def lines(work: Path) -> list[dict]:
    return [json.loads(line) for line in (work / "cells.jsonl").read_text().splitlines()]


def test_every_cell_is_a_line_and_is_not_run_again(fakes, matrix: list[Chain], work: Path) -> None:
    assert run_chains(work, matrix) == []
    cells = lines(work)
    assert len(cells) == 16 and len({identity(c["key"]) for c in cells}) == 16
    assert len({chain[0].folder for chain in matrix}) == 4
    assert [c["key"]["cell"] for c in cells[:4]] == ["train", "eval", "export", "eval"]
    train = cells[4]
    assert train["key"]["seed"] == 1 and train["key"]["steps"] == 100 and train["key"]["scene"] == "fox"
    assert train["value"]["seconds"] == 10 and train["value"]["process_cpu_seconds"] > 0
    assert (work / train["value"]["curve"]).is_file()
    assert cells[2]["value"]["bytes"] > 3000 and cells[2]["value"]["format"] == "bc7"
    assert cells[3]["value"]["results"]["lpips"] is None  # NaN is no JSON
    for cell in cells:
        assert cell["made"]["machine"] and cell["made"]["versions"]["python"] and cell["made"]["command"]
    log = (work / "logs" / "fox" / "bitymi").glob("*/train-trained.log")
    assert "passive" in next(log).read_text()
    train, trained, export, baked = fakes.calls()[4:8]
    assert train.startswith("ns-train bitymi ") and train.endswith("captures/fox")
    for words in ("--machine.seed 1", "--pipeline.model.train.seed 1", "--max-num-iterations 100", "--vis none"):
        assert words in train
    assert export.startswith("ns-export bitymi-atlas --load-config ") and export.endswith("--format bc7")
    assert trained.startswith("ns-eval --load-config ") and "/bundles/" in baked
    renamed = [[replace(cell, row="another name") for cell in chain] for chain in matrix]
    assert run_chains(work, matrix) == run_chains(work, renamed) == []
    assert fakes.calls() == []


@pytest.mark.parametrize("at", [0, 2, 3])
def test_a_kill_costs_one_cell(
    fakes, matrix: list[Chain], work: Path, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    chain = matrix[0]
    calls = iter(range(99))

    def killed(command: list[str], log: Path, lock: Lock) -> object:
        if next(calls) == at:
            if "--output-dir" in command:  # half-written
                Path(command[command.index("--output-dir") + 1]).mkdir(parents=True, exist_ok=True)
            raise KeyboardInterrupt
        return run_measured(command, log, lock)

    monkeypatch.setattr(engine, "run_measured", killed)
    with pytest.raises(KeyboardInterrupt):
        run_chains(work, [chain])
    done = len(lines(work)) if at else 0
    assert done == at
    fakes.calls()
    monkeypatch.setattr(engine, "run_measured", run_measured)
    assert run_chains(work, [chain]) == []
    assert len(fakes.calls()) == 4 - at and len(lines(work)) == 4


@pytest.mark.slow
def test_a_killed_benchmark_goes_on_when_its_command_has_ended(fakes, matrix: list[Chain], work: Path) -> None:
    beside = f"import sys; sys.executable = {str(fakes.folder / 'python')!r}"  # where the stubs are found
    code = f"{beside}; from bitymi_ns.cli import main; sys.exit(main())"
    words = [sys.executable, "-c", code, "bench", "local", "--data", matrix[0][0].data, "--steps", "10"]
    words += ["--formats", "bc7", "--work", str(work)]
    fakes.slow.write_text("ns-export")
    process = subprocess.Popen(words, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 600  # others may keep the machine busy
    while not any(call.startswith("ns-export") for call in fakes.log.read_text().splitlines()):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.wait()
    assert len(lines(work)) == 2
    again = subprocess.run(words, capture_output=True, text=True, check=False)
    named = re.search(r"fox, bitymi: process (\d+) is writing there: wait for it, or end it", again.stderr)
    assert again.returncode == 1 and named is not None and int(named[1]) != process.pid
    assert b"ns-export" in Path(f"/proc/{named[1]}/cmdline").read_bytes()  # its export still runs
    fakes.calls()
    fakes.slow.write_text("")
    while subprocess.run(words, capture_output=True, check=False).returncode != 0:
        assert time.monotonic() < deadline
    assert [call.split()[0] for call in fakes.calls()] == ["ns-export", "ns-eval"] and len(lines(work)) == 4


@pytest.mark.parametrize(
    ("kept", "again"),
    [
        ([0, 1, 2, 3], ["ns-eval"]),  # the last one cut off
        ([1, 2, 3], ["ns-train", "ns-eval", "ns-export", "ns-eval"]),
        ([0, 1, 3], ["ns-export", "ns-eval"]),
    ],
)
def test_what_depends_on_a_missing_cell_is_done_again(
    fakes, matrix: list[Chain], work: Path, kept: list[int], again: list[str]
) -> None:
    chain = matrix[0]
    run_chains(work, [chain])
    fakes.calls()
    text = (work / "cells.jsonl").read_text().splitlines(keepends=True)
    left = "".join(text[i] for i in kept)
    (work / "cells.jsonl").write_text(left[:-40] if len(kept) == 4 else left)
    assert run_chains(work, [chain]) == []
    assert [call.split()[0] for call in fakes.calls()] == again
    assert {identity(c["key"]) for c in lines(work)} == {identity(s.key) for s in chain}


def test_a_failure_is_told_and_the_rest_goes_on(fakes, matrix: list[Chain], work: Path) -> None:
    fakes.fail("ns-train captures/fox", "ns-export /lego/ -seed1")
    failures = run_chains(work, matrix)
    assert len(failures) == 3
    assert "fox, bitymi, seed 0: training failed" in failures[0] and "status 3" in failures[0]
    assert "something is wrong with the capture" in failures[0]
    assert "export (bc7) failed" in failures[2]
    assert len(lines(work)) == 4 + 2  # the second lego run has no export and no evaluation of it
    fakes.fail()
    fakes.calls()
    assert run_chains(work, matrix) == []
    assert len(fakes.calls()) == 8 + 2


def test_a_command_that_leaves_nothing_is_a_failure(fakes, matrix: list[Chain], work: Path) -> None:
    (fakes.folder / "ns-eval").write_text("#!/bin/sh\nexit 0\n")
    (failure, *_) = run_chains(work, matrix[:1])
    assert "evaluation (trained)" in failure and "cannot be read: it does not exist" in failure


def test_methods_of_others_are_trained_and_evaluated_only(fakes, matrix: list[Chain], work: Path) -> None:
    scene = Scene("fox", matrix[0][0].data)
    other = chains([scene], {"splatfacto": Row(method="splatfacto")}, {"bc7": ()}, (), 100)
    assert run_chains(work, other) == []
    assert [call.split()[0] for call in fakes.calls()] == ["ns-train", "ns-eval"]
    (cell, _) = lines(work)
    assert "seconds" not in cell["value"] and cell["value"]["process_seconds"] >= 0


def test_broken_cells_are_named(tmp_path: Path) -> None:
    path = tmp_path / "cells.jsonl"
    path.write_text('{"key": {"cell": "train"}, "value": {}}\nhello\n{"key": {}, "value": {}}\n')
    with pytest.raises(BenchError, match=r"cells\.jsonl, line 2, is not a finished cell"):
        Cells(path)
    path.write_text('{"key": {"cell": "train"}, "value": {}}\n{"key": {"cel')
    assert len(Cells(path).known) == 1


def test_several_writers_share_a_file(tmp_path: Path) -> None:
    first, second = Cells(tmp_path / "cells.jsonl"), Cells(tmp_path / "cells.jsonl")
    first.add({"cell": "a"}, {"x": 1}, {})
    second.add({"cell": "b"}, {"x": 2}, {})
    assert first.get({"cell": "b"}) is None
    first.refresh()
    assert first.get({"cell": "b", "suite": "any"})["value"] == {"x": 2} and len(first.known) == 2


def test_empty_matrix_and_missing_tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BenchError, match="nothing to run"):
        run_chains(tmp_path, [])
    with pytest.raises(BenchError, match="there is no ns-nothing"):
        tool("ns-nothing")
    with pytest.raises(CommandFailed, match="cannot be started"):
        run_measured([str(tmp_path / "nothing")], tmp_path / "log")


@pytest.mark.parametrize("option", ["--work", "--output"])
def test_places_that_cannot_be_written_are_found_first(
    fakes, matrix: list[Chain], tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    (tmp_path / "file").write_text("")
    words = ["bench", "local", "--data", matrix[0][0].data, "--steps", "10", "--work", str(tmp_path / "work")]
    assert main([*words, option, str(tmp_path / "file" / "x")]) == 1
    assert f"x cannot be written: {tmp_path / 'file'} is not a folder" in capsys.readouterr().err
    assert fakes.calls() == []
