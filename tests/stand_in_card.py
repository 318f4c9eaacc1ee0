"""A stub GPU without kernels: tensors on `CARD` are in host memory, and reads are recorded."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

CARD = torch.device("meta")
CPU = torch.device("cpu")
READS = (Tensor.cpu, Tensor.item, Tensor.tolist, Tensor.__bool__, Tensor.__float__, Tensor.__int__, Tensor.__index__)


class _OnCard(Tensor):
    """A tensor on the stub GPU, as are results computed with it."""


def on_card(tensor: Tensor) -> Tensor:
    return tensor.clone().as_subclass(_OnCard)


class _Mode(TorchFunctionMode):
    def __init__(self) -> None:
        super().__init__()
        self.reads: list[int] = []

    def __torch_function__(self, func: Callable[..., Any], types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        first = args[0] if args and isinstance(args[0], Tensor) else None
        there = isinstance(first, _OnCard)
        if there and func == Tensor.device.__get__:
            return CARD
        devices = [each for each in (*args[1:], kwargs.get("device")) if isinstance(each, (torch.device, str))]
        to = None if not devices else torch.device(devices[0])
        if there and (func in READS or (func == Tensor.to and to == CPU)):
            self.reads.append(first.numel())
            plain = first.as_subclass(Tensor)
            return plain.clone() if func in (Tensor.cpu, Tensor.to) else func(plain, *args[1:], **kwargs)
        if to != CARD:
            return func(*args, **kwargs)
        if "device" in kwargs:
            kwargs["device"] = CPU
        found = func(*(CPU if isinstance(each, torch.device) else each for each in args), **kwargs)
        return found if isinstance(found, _OnCard) else on_card(found)


@contextmanager
def noted_reads() -> Iterator[list[int]]:
    """Enable the stub; yields the sizes of the host's reads from it, at which it would wait."""
    with _Mode() as mode:
        yield mode.reads
