"""Backends of the measurement: a device, and what has to be in place while its kernels are used."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch

from bitymi_ns.ops.backend import emulated_cuda, module


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


BACKENDS: dict[str, Backend] = {
    "cpu": Backend("cpu", "cpu"),
    "cuda": Backend("cuda", "cuda"),
    "emulated": Backend("emulated", "cpu", emulated_cuda),
}
"""Backends by name; tests/stress runs every case on those that are there. `emulated`: CUDA kernels, run on the host."""


def missing(backend: Backend) -> str:
    """Why a backend cannot be used here; empty when it can."""
    device = torch.device(backend.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        return "no CUDA device (or torch without CUDA)"
    try:
        with backend.use():
            module(device)
    except RuntimeError as error:
        return str(error)
    return ""
