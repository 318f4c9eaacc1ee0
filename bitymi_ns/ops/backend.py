"""Chooses the compiled kernel for a tensor: by its device, then by its dtype."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import torch
from torch import Tensor

SUFFIX = {torch.float32: "_f32", torch.float64: "_f64"}


def module(device: torch.device) -> ModuleType:
    """The kernel module for a device.

    Raises:
        RuntimeError: the kernels for that device are not built.
    """
    if device.type != "cpu":
        raise RuntimeError(f"no kernels for device '{device}' in this build: move the tensors to the CPU")
    try:
        from bitymi_ns import _cpu
    except ImportError as error:
        raise RuntimeError(
            "the compiled module bitymi_ns._cpu is missing: install the package (`pip install .`, or `make setup` in a "
            f"checkout); the import said: {error}"
        ) from error
    return _cpu


def kernel(name: str, like: Tensor) -> Any:
    """The kernel `name` for tensors like `like`.

    Raises:
        TypeError: the dtype is neither float32 nor float64.
    """
    if like.dtype not in SUFFIX:
        raise TypeError(f"{name} takes float32 or float64 tensors, not {like.dtype}")
    return getattr(module(like.device), name + SUFFIX[like.dtype])


def dense(tensor: Tensor, like: Tensor) -> Tensor:
    """`tensor` without its graph, contiguous, with the dtype and device of `like`."""
    return tensor.detach().to(like).contiguous()
