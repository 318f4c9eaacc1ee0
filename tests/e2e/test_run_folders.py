"""Folders of runs: exclusive use, full disks, read-only disks."""

import copy
import json
import shutil
from pathlib import Path

import pytest
from nerfstudio.scripts import train as ns_train

from bitymi_ns.capture.frame import WorldFrame, write_frame
from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run import folder_lock
from bitymi_ns.plugin.run.config import BitymiTrainerConfig
from tests.captures import expect
from tests.e2e.runs import Start
from tests.files.test_files import another_process


def test_a_folder_takes_one_run_at_a_time(start: Start) -> None:
    config = start(name="run")
    config.max_num_iterations = 2
    folder = config.get_base_dir()
    folder.mkdir(parents=True)
    with another_process("locks.Lock(path)", folder / folder_lock.LOCK) as other:
        with expect(f"is in use: process {other.pid} is writing there(.|\n)*--timestamp") as stop:
            ns_train.main(copy.deepcopy(config))
        assert stop.value.code != 0 and [p.name for p in folder.iterdir()] == [".lock"]  # untouched
    (folder / ".step-000000001.ckpt.unfinished").write_text("of the run that was killed")
    ns_train.main(config)
    assert not [p.name for p in folder.iterdir() if p.name.startswith(".")]
    again = start(name="run")  # into the same folder, once the first has ended
    again.max_num_iterations, again.load_dir = 3, config.get_checkpoint_dir()
    ns_train.main(again)
    assert [p.name for p in config.get_checkpoint_dir().iterdir()] == ["step-000000002.ckpt"]


def test_too_little_room_for_a_checkpoint_is_found_first(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder_lock.files, "free_bytes", lambda path: 12_000)
    config = start(name="full")
    with pytest.raises(InputError, match=r"has 12.0 kB free, and a checkpoint takes [\d.]+ [kM]B or more"):
        ns_train.main(config)
    assert not (config.get_base_dir() / "nerfstudio_models").exists()


def test_a_folder_that_cannot_be_written(start: Start) -> None:
    config = start(name="readonly")
    config.output_dir = config.output_dir / "file"
    config.output_dir.parent.mkdir()
    config.output_dir.write_text("in the way")
    with pytest.raises(InputError, match="cannot be written: .*is not a folder.*--output-dir"):
        ns_train.main(config)


def test_a_new_run_keeps_out_of_the_folder_of_an_earlier_one(trained: BitymiTrainerConfig, start: Start) -> None:
    config = start(name="run")
    config.output_dir = trained.output_dir
    with pytest.raises(InputError, match="holds a run, up to step-0+59.ckpt.*--load-dir"):
        ns_train.main(config)
    assert len(list(trained.get_checkpoint_dir().glob("*.ckpt"))) == 3


def test_a_run_keeps_how_its_poses_were_found(start: Start, room: Path, tmp_path: Path) -> None:
    capture = Path(shutil.copytree(room, tmp_path / "capture"))
    write_frame(capture, WorldFrame("gps", 1.0, None, 2.0, 12, [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]))
    found = {"source": "photos", "given": 14, "registered": 12, "reprojection_error": 0.5, "track_length": 3.0}
    (capture / "report.json").write_text(json.dumps({**found, "left_out": {"a.jpg": "blurred"}, "seconds": {"all": 9}}))
    config = start(data=capture)
    config.max_num_iterations = 1
    ns_train.main(config)
    shutil.rmtree(capture)
    kept = (config.get_base_dir() / "poses").iterdir()
    assert sorted(path.name for path in kept) == ["frame.json", "report.json"]
