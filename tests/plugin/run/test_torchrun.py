"""Start and end runs of several processes. Whole runs: tests/e2e/test_several_processes.py."""

import pytest

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run import torchrun
from bitymi_ns.plugin.run.config import method_config
from bitymi_ns.train.processes import Processes

LOST = torchrun.LOST


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("num_devices", 0, "num-devices must be at least 1, not 0"),
        ("num_machines", 2, "num-machines 2: .* torchrun --nnodes 2 --node-rank K .* --nproc-per-node 1"),
    ],
)
def test_machines_that_a_run_cannot_have(option: str, value: int, message: str) -> None:
    config = method_config("bitymi").config
    setattr(config.machine, option, value)
    with pytest.raises(InputError, match=message):
        config.set_timestamp()


@pytest.mark.parametrize(
    ("statuses", "message"),
    [
        ({0: LOST, 1: -9}, "process 2 of the 3 of this run was ended by SIGKILL, as where .* not enough memory"),
        ({2: -11, 0: LOST, 1: -15}, "process 3 of the 3 of this run was ended by SIGSEGV$"),
        ({0: LOST, 1: LOST}, "the 3 processes of this run lost contact, or one did not answer for 0:30:00"),
    ],
)
def test_a_process_that_cannot_say_why_it_has_ended_is_named(statuses: dict[int, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        torchrun.end(statuses, 3)


def test_a_process_that_has_said_why_it_has_ended_gives_its_status() -> None:
    with pytest.raises(SystemExit) as ended:
        torchrun.end({0: LOST, 1: 130}, 3)
    assert ended.value.code == 130


def test_torchrun_tells_a_process_which_one_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RANK", "2")  # of another launcher
    monkeypatch.setenv("WORLD_SIZE", "3")
    assert torchrun.own().count == 1
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.setenv("LOCAL_RANK", "0")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "1")
    assert torchrun.own() == Processes(2, 3) and torchrun.own("LOCAL_") == Processes(0, 1)
