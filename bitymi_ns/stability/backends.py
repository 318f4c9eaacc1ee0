"""Where the operations can run. A backend is a device, and what has to be in place while its kernels are used."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass


@dataclass(frozen=True)
class Backend:
    """One set of compiled kernels behind `bitymi_ns.ops`.

    Attributes:
        name: for tables and tests.
        device: of the tensors that it takes.
        use: context in which `bitymi_ns.ops` uses it, where the device alone does not choose it.
    """

    name: str
    device: str
    use: Callable[[], AbstractContextManager[object]] = nullcontext


BACKENDS: dict[str, Backend] = {"cpu": Backend("cpu", "cpu")}
"""By name; tests/stress runs every case on each of them."""
