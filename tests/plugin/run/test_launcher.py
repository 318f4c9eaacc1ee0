"""Messages of the first process when another one is lost. Whole runs: tests/e2e/test_several_processes.py."""

from types import SimpleNamespace

import pytest
import torch.distributed as dist

from bitymi_ns.plugin.console import InputError
from bitymi_ns.plugin.run import launcher


def process(status: int | None) -> SimpleNamespace:
    return SimpleNamespace(poll=lambda: status, returncode=status)


@pytest.fixture
def others(monkeypatch: pytest.MonkeyPatch) -> launcher.Workers:
    monkeypatch.setattr(launcher, "PATIENCE", 0.0)
    found = launcher.Workers.__new__(launcher.Workers)
    found._store = dist.TCPStore("127.0.0.1", 0, 3, is_master=True, wait_for_workers=False)
    found._processes = [process(None), process(None)]
    return found


def test_what_went_wrong_in_another_process_is_told(others: launcher.Workers) -> None:
    with pytest.raises(InputError, match="the 3 processes of this run lost contact, or did not answer within 30 min"):
        others.explain()
    others._processes[1] = process(-9)
    with pytest.raises(InputError, match="process 3 of the 3 of this run has ended: exit status -9"):
        others.explain()
    others._processes[0], others._processes[1] = process(launcher.LOST), process(None)  # because the other one ended
    others._store.set("why 2", "bitymi: there is no capture")
    with pytest.raises(InputError, match="process 3 of the 3 of this run has ended: bitymi: there is no capture"):
        others.explain()
