"""Fragments that fit into memory, and the error of a view that has more."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from .project import Projection

NUMBERS = 24
"""Numbers per fragment in a training step: 7 in the list, 3 of its residual, 8 of gradients; the rest is slack."""
FEW = 1 << 23  # up to this many fragments free memory is not queried
LISTS_PER_CHECK = 100
"""Lists between queries of free memory: a query takes a tenth of a training step, and only other programs change the
answer, as torch keeps a list's memory for the next one."""


@dataclass
class _Room:
    """Fragments that fit into a device's free memory, as last measured."""

    capacity: int  # fragments
    largest: int  # longest list checked against it
    lists: int = 0  # since then


_rooms: dict[torch.device, _Room] = {}


class TooManyFragments(RuntimeError):
    """A view with more fragments (`count`) than allowed (`most`). `ids`: surfel and pixel are stored too, 8 bytes
    beside 5 numbers of geom's dtype."""

    def __init__(self, geom: Tensor, projection: Projection, count: int, most: int, ids: bool) -> None:
        size = 5 * geom.element_size() + 8 * ids
        pixels = projection.camera.width * projection.camera.height
        super().__init__(
            f"the view has {count:,} fragments, {count / pixels:.0f} per pixel; their list needs "
            f"{count * size / 2**30:.2f} GiB, and there is room for {most:,}: render a smaller image or use fewer "
            "surfels"
        )
        self.count, self.most = count, most


@contextmanager
def memory_errors() -> Iterator[None]:
    """Raise MemoryError, as the kernels do, where torch raises RuntimeError for a lack of the CPU's memory."""
    try:
        yield
    except RuntimeError as error:
        if "DefaultCPUAllocator" not in str(error):
            raise
        raise MemoryError(f"the picture does not fit into memory: {error}") from error


def free_memory(device: torch.device) -> int:
    """Return the free bytes of a CUDA device, with what torch holds unused."""
    kept = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return torch.cuda.mem_get_info(device)[0] + kept


def fragment_capacity(geom: Tensor) -> int:
    """Compute the number of fragments whose training step fits into the free memory of a CUDA device."""
    return free_memory(geom.device) // (NUMBERS * geom.element_size())


def check_capacity(geom: Tensor, projection: Projection, count: int, most: int | None) -> None:
    """Raise TooManyFragments if a list is longer than `most` or, with most = 0, than memory permits, which is queried
    for a list longer than all before, and every `LISTS_PER_CHECK` lists."""
    if most == 0 and geom.device.type == "cuda" and count > FEW:
        room = _rooms.get(geom.device)
        if room is None or count > room.largest or room.lists >= LISTS_PER_CHECK:
            room = _rooms[geom.device] = _Room(fragment_capacity(geom), count)
        room.lists += 1
        most = room.capacity
    if most and count > most:
        raise TooManyFragments(geom, projection, count, most, ids=True)
