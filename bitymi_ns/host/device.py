"""Which device the kernels can run on here."""

from __future__ import annotations

import importlib.util

import torch


def has_cuda_kernels() -> bool:
    """Whether there is a GPU and this installation has kernels for it."""
    return torch.cuda.is_available() and importlib.util.find_spec("bitymi_ns._cuda") is not None


def default_device_type() -> str:
    """nerfstudio's name of the device that is used when none is asked for."""
    return "cuda" if has_cuda_kernels() else "cpu"


def kernel_device(device: torch.device | str) -> torch.device:
    """`device`, or the CPU where there are no kernels for it (nerfstudio's tools pick a GPU whenever they see one)."""
    device = torch.device(device)
    return device if device.type == "cpu" or (device.type == "cuda" and has_cuda_kernels()) else torch.device("cpu")
