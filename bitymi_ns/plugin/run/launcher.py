"""Launch and end the worker processes of a multi-process run on one machine: nerfstudio's own start needs CUDA and
torch's DistributedDataParallel, which knows no parameters that change their size.

The process that the user started checks, prints, evaluates and saves as it would alone. The others are started after
that, and write into folders of their own that are thrown away."""

from __future__ import annotations

import atexit
import copy
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import torch
import torch.distributed as dist
from nerfstudio.utils.rich_utils import CONSOLE

from bitymi_ns.plugin.console import fail
from bitymi_ns.train.processes import ProcessLost
from bitymi_ns.trust import python_command

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

TIMEOUT = timedelta(minutes=30)  # timeout for a process that does not answer; one that has ended is noticed at once
PATIENCE = 10.0  # seconds in which a process that is lost is expected to say why
HOST = "127.0.0.1"
LOST = 3  # exit status of a process that ends because another one has


class Workers:
    """The worker processes of a run; this process is the first."""

    def __init__(self, config: TrainerConfig, count: int) -> None:
        self._cards = config.machine.device_type == "cuda"
        self._scratch = tempfile.TemporaryDirectory()
        self._store = dist.TCPStore(HOST, 0, count, is_master=True, wait_for_workers=False, timeout=TIMEOUT)
        self._inputs = []
        for rank in range(1, count):  # the others write nothing that stays, show nothing and evaluate nothing
            own = copy.deepcopy(config)
            own.output_dir, own.vis, own.pipeline.model.curve_points = Path(self._scratch.name) / str(rank), "none", 0
            self._inputs.append((own, rank, count, self._store.port))
        self._processes: list[subprocess.Popen[bytes]] = []
        atexit.register(self.end)

    def start(self) -> None:
        """Start them and wait until they are there.

        Raises:
            InputError: one has ended already.
        """
        count = len(self._inputs) + 1
        environment = {**os.environ, "PYTHONWARNINGS": "ignore"}  # those of nerfstudio's import were shown once
        for inputs in self._inputs:
            process = subprocess.Popen(python_command(__name__, "work"), stdin=subprocess.PIPE, env=environment)
            self._processes.append(process)
            assert process.stdin is not None
            with suppress(BrokenPipeError), process.stdin:  # one that has ended already is noticed below
                process.stdin.write(pickle.dumps(inputs))
        keys = [f"here {rank}" for rank in range(1, count)]
        while not self._store.check(keys):
            if any(process.poll() is not None for process in self._processes):
                self.explain()
            time.sleep(0.05)
        _join(self._store, 0, count, self._cards)

    def explain(self) -> NoReturn:
        """End the run with what the process said that was lost.

        Raises:
            InputError: always.
        """
        until, count = time.monotonic() + PATIENCE, len(self._processes) + 1
        while True:
            for rank, process in enumerate(self._processes, 1):
                told = self._store.check([f"why {rank}"])
                if told or process.poll() not in (None, LOST):
                    why = self._store.get(f"why {rank}").decode() if told else f"exit status {process.returncode}"
                    fail(f"process {rank + 1} of the {count} of this run has ended: {why}")
            if time.monotonic() > until:
                minutes = round(TIMEOUT.total_seconds() / 60)
                fail(f"the {count} processes of this run lost contact, or did not answer within {minutes} min")
            time.sleep(0.05)

    def end(self, orderly: bool = False) -> None:
        """End the other processes; a second call changes nothing.

        Args:
            orderly: the run is over for all of them: let them end themselves.
        """
        atexit.unregister(self.end)
        processes, self._processes = self._processes, []
        for process in processes:
            if orderly:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(PATIENCE)
            process.kill()
            process.wait()
        self._scratch.cleanup()
        # a card may wait for one that is lost: then the end of this process is the remedy
        if processes and dist.is_initialized() and (orderly or not self._cards):
            dist.destroy_process_group()


def _join(store: dist.Store, rank: int, count: int, cards: bool) -> None:
    """Enter torch.distributed's default group: gloo for what decides, and nccl for what lies on cards."""
    backend = "gloo"
    if cards:
        torch.cuda.set_device(rank)
        backend = "cpu:gloo,cuda:nccl"
    else:  # all of them have the same cores
        torch.set_num_threads(max(1, torch.get_num_threads() // count))
    dist.init_process_group(backend, store=store, rank=rank, world_size=count, timeout=TIMEOUT)


def work() -> None:
    """Main function of a worker; configuration and rank come through stdin."""
    for number in (signal.SIGINT, signal.SIGTERM):  # before and after training the first process decides
        signal.signal(number, signal.SIG_IGN)
    config, rank, count, port = pickle.loads(sys.stdin.buffer.read())
    from nerfstudio.scripts.train import train_loop

    CONSOLE.quiet = True
    store = dist.TCPStore(HOST, port, count, is_master=False, timeout=TIMEOUT)
    try:
        store.set(f"here {rank}", "1")
        _join(store, rank, count, config.machine.device_type == "cuda")
        train_loop(rank, count, config)  # with the seed of the first process
        dist.destroy_process_group()
    except ProcessLost:  # another one has ended, and the first one says why
        if config.machine.device_type != "cuda":  # a card may wait for one that is lost
            dist.destroy_process_group()
        sys.exit(LOST)
    except BaseException as error:
        message = str(error) if isinstance(error, SystemExit) else traceback.format_exc()
        with suppress(RuntimeError):  # the first process has ended
            store.set(f"why {rank}", message)
        sys.exit(1)
