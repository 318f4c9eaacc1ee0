"""Communication between the processes of a run, each of which renders its own views of a copy of the scene.

All make the same decisions, from inputs that are made equal here: sums, or values broadcast from the first process.
Uses torch.distributed's default group, with gloo for CPU tensors and nccl for CUDA tensors.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, NoReturn

import torch
import torch.distributed as dist
from torch import Tensor

from bitymi_ns.exit_messages import out_of_memory


class ProcessLost(RuntimeError):
    """Another process of the run has ended, or does not answer."""


class ProcessesApart(RuntimeError):
    """The processes of the run have scenes that differ."""


@dataclass(frozen=True)
class Processes:
    """Process group of a run; methods of a single process do nothing."""

    rank: int = 0  # of this process
    count: int = 1  # of processes
    each: int = 1  # views that a process renders per step, one after the other

    @classmethod
    def joined(cls, each: int = 1) -> Processes:
        """Return torch.distributed's default group, or a single process."""
        if not (dist.is_available() and dist.is_initialized()):
            return cls(each=each)
        return cls(dist.get_rank(), dist.get_world_size(), each)

    @property
    def first(self) -> bool:
        """True for rank 0, which writes and prints."""
        return self.rank == 0

    @property
    def views(self) -> int:
        """Number of views per step over all processes."""
        return self.count * self.each

    def view_numbers(self, step: int) -> range:
        """Compute the positions of this process's views in the training order."""
        start = step * self.views + self.rank * self.each
        return range(start, start + self.each)

    # inputs of decisions, made equal in all processes

    def any(self, condition: bool) -> bool:
        return bool(self._largest([int(condition)])[0])

    def first_error(self, own: str | None) -> str | None:
        """Return the first problem of any process, by rank; None without any."""
        if self.count == 1 or not self.any(own is not None):
            return own
        problems: list[str | None] = [None] * self.count
        with raise_process_lost():
            dist.all_gather_object(problems, own)
        return next(problem for problem in problems if problem is not None)

    def mean(self, value: float) -> float:
        """Average a number that is equal in all processes up to rounding."""
        total = torch.tensor(value, dtype=torch.float64)
        self.sum(total)
        return float(total) / self.count

    def from_first(self, state: Any, device: torch.device | str) -> Any:
        """Broadcast a state (tensors, numbers, strings) of rank 0; other ranks may pass None."""
        if self.count == 1:
            return state
        packed = io.BytesIO()
        if self.first:
            torch.save(state, packed)
        box = [packed.getvalue()]
        with raise_process_lost():
            dist.broadcast_object_list(box, src=0, device=torch.device("cpu"))
        return state if self.first else torch.load(io.BytesIO(box[0]), map_location=device, weights_only=True)

    def broadcast_(self, tensors: Iterable[Tensor]) -> None:
        """Broadcast tensors from rank 0, in place."""
        if self.count == 1:
            return
        with raise_process_lost(), torch.no_grad():
            for tensor in tensors:
                dist.broadcast(tensor, src=0)

    # sums

    def sum(self, *tensors: Tensor) -> None:
        """Replace tensors by their sums over the processes, bit-identical in all."""
        self._reduce(tensors, dist.ReduceOp.SUM)

    def maximum(self, tensor: Tensor) -> None:
        """Replace a tensor by its elementwise maximum over the processes."""
        self._reduce([tensor], dist.ReduceOp.MAX)

    @torch.no_grad()
    def average_gradients(self, parameters: Sequence[Tensor], surfels: int) -> None:
        """Replace gradients, summed over this process's views, by their means over all views of the step; None stays if
        all processes have it.

        Args:
            parameters: the same in all processes, with dense gradients.
            surfels: number of surfels, compared before gradients are added.

        Raises:
            ProcessesApart: the numbers of surfels differ.
            ProcessLost: another process has ended.
        """
        *moved, most, least = self._largest([*(int(p.grad is not None) for p in parameters), surfels, -surfels])
        if most != -least:
            raise ProcessesApart(
                f"the processes of the run have come apart: one has {most:,} surfels, another {-least:,}. Go on from "
                "the newest checkpoint, and report it; if it happens again, with one process"
            )
        gradients = []
        for parameter, there in zip(parameters, moved, strict=True):
            if there and parameter.grad is None:
                parameter.grad = torch.zeros_like(parameter)
            if parameter.grad is not None:
                gradients.append(parameter.grad)
        self.sum(*gradients)
        if gradients:
            torch._foreach_div_(gradients, float(self.views))

    def _largest(self, values: Sequence[int]) -> list[int]:
        largest = torch.tensor(values, dtype=torch.int64)
        self.maximum(largest)
        return largest.tolist()

    @torch.no_grad()
    def _reduce(self, tensors: Sequence[Tensor], op: Any) -> None:
        if self.count == 1:
            return
        for dtype in dict.fromkeys(tensor.dtype for tensor in tensors):
            same_dtype = [tensor for tensor in tensors if tensor.dtype == dtype]
            flat = torch.cat([tensor.reshape(-1) for tensor in same_dtype])
            with raise_process_lost():
                dist.all_reduce(flat, op)
            parts = flat.split([tensor.numel() for tensor in same_dtype])
            for tensor, part in zip(same_dtype, parts, strict=True):
                tensor.copy_(part.view_as(tensor))


ALONE = Processes()


@contextmanager
def raise_process_lost() -> Iterator[None]:
    """Turn torch's connection errors into ProcessLost."""
    try:
        yield
    except RuntimeError as error:
        if out_of_memory(error):
            raise
        message = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ProcessLost(f"another process of the run has ended, or does not answer ({message})") from error


def leave(status: int) -> NoReturn:
    """End this process at once after another was lost: threads of gloo that wait for it may abort the interpreter."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)
