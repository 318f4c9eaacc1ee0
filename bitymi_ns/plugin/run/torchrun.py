"""Multi-process runs, started by torchrun: nerfstudio's launcher needs CUDA and torch's DistributedDataParallel, which
cannot handle parameters that change their size.

The first process checks, prints, evaluates and saves as it would alone. The others wait until it is about to train,
take its configuration, and write into temporary folders."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import sys
import tempfile
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import torch
import torch.distributed as dist

from bitymi_ns.train.processes import ALONE, Processes, ProcessLost, leave, raise_process_lost
from bitymi_ns.trust import python_command
from ..console import INTERRUPTED, InputError, fail

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

TIMEOUT = timedelta(minutes=30)  # timeout for a process that does not answer; one that has ended is noticed at once
SETUP = timedelta(days=7)  # for the first process to read the capture and find poses
LOST = 3  # exit status if another process has ended
CONFIG = "config"  # of the pickled configuration: file, and key in torch.distributed's store


def own(group: str = "") -> Processes:
    """Return the rank of this process and the number of processes in the run; LOCAL_: on this machine; GROUP_: of
    machines."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return ALONE
    return Processes(int(os.environ[f"{group}RANK"]), int(os.environ[f"{group}WORLD_SIZE"]))


def run(config: TrainerConfig) -> NoReturn:
    """Start a run's processes, wait for them, and exit with their status, or a message where none has printed one."""
    from torch.distributed.launcher.api import ChildFailedError, SignalException
    from torch.distributed.run import main as torchrun

    count, machines = config.machine.num_devices, config.machine.num_machines
    if count < 1:
        fail(f"--machine.num-devices must be at least 1, not {count}")
    if machines != 1:
        fail(
            f"--machine.num-machines {machines}: start the run on each, K = 0, 1, ..., by torchrun --nnodes {machines} "
            f"--node-rank K --rdzv-endpoint HOST:PORT --nproc-per-node {count} --no-python ns-train ..."
        )
    os.environ["OMP_NUM_THREADS"] = str(max(1, torch.get_num_threads() // count))
    os.environ["PYTHONWARNINGS"] = "ignore"  # this process has shown them
    # a step and its checkpoint may take longer than torchrun's 30 s
    os.environ.setdefault("TORCH_ELASTIC_SHUTDOWN_TIMEOUT", str(round(TIMEOUT.total_seconds())))
    logging.disable()  # torchrun's log
    with tempfile.TemporaryDirectory() as scratch:
        Path(scratch, CONFIG).write_bytes(pickle.dumps(config))
        words = ["--standalone", "--local-addr", "127.0.0.1", "--nproc-per-node", str(count), "--log-dir", scratch]
        try:
            torchrun([*words, "--no-python", *python_command(__name__, "work"), scratch])
        except ChildFailedError as error:
            soon = error.get_first_failure()[1].timestamp + 1  # torchrun ended later ones
            first = {rank: failure.exitcode for rank, failure in error.failures.items() if failure.timestamp <= soon}
            end(first, count)
        except (KeyboardInterrupt, SignalException):
            sys.exit(INTERRUPTED)
    sys.exit()


def end(statuses: dict[int, int], count: int) -> NoReturn:
    """Exit with the status of the process that failed first, and print a message unless it has. `statuses`: by rank, in
    the order in which torchrun noticed them; negative: killed by that signal. `count`: of processes."""
    rank, status = next(((r, s) for r, s in statuses.items() if s != LOST), (0, LOST))
    if status == LOST:
        fail(f"the {count} processes of this run lost contact, or one did not answer for {TIMEOUT}")
    if status > 0:
        sys.exit(status)
    memory = ", as where there is not enough memory" if -status == signal.SIGKILL else ""
    fail(f"process {rank + 1} of the {count} of this run was ended by {signal.Signals(-status).name}{memory}")


def work() -> None:
    """Train in a process started by `run`."""
    from nerfstudio.scripts.train import train_loop

    tempfile.tempdir = sys.argv[1]  # which `run` removes
    config = pickle.loads(Path(sys.argv[1], CONFIG).read_bytes())
    try:
        config.set_timestamp()
        config.save_config()
        train_loop(0, 1, config)
    except InputError as error:
        if isinstance(error.__cause__, ProcessLost):  # `run` names the process
            leave(LOST)
        raise


def join(config: Any) -> None:
    """Join torch.distributed's default group: gloo for CPU tensors, nccl for CUDA tensors. The other processes take the
    first one's configuration. Raises InputError: another process has ended."""
    try:
        with raise_process_lost():
            store: Any
            store, rank, count = next(dist.rendezvous("env://", timeout=SETUP))
            if rank == 0:
                store.set(CONFIG, pickle.dumps(config))
            else:
                for number in (signal.SIGINT, signal.SIGTERM):  # Python's handlers wait for torch, COLMAP's print
                    signal.signal(number, signal.SIG_DFL)
                vars(config).update(vars(pickle.loads(store.get(CONFIG))))
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process handles it
                vars(config)["scratch"] = scratch = tempfile.TemporaryDirectory()  # kept until the process ends
                config.output_dir, config.vis = Path(scratch.name), "none"
                config.pipeline.model.curve_points = 0
            backend = "gloo"
            if config.machine.device_type == "cuda":
                torch.cuda.set_device(own("LOCAL_").rank)
                backend = "cpu:gloo,cuda:nccl"
            group = dist.PrefixStore("run", store)
            dist.init_process_group(backend, store=group, rank=rank, world_size=count, timeout=TIMEOUT)
    except ProcessLost as error:
        fail(str(error), error)
