"""Devices that the kernels can run on."""

import importlib
import importlib.util
from functools import cache
from types import ModuleType

import torch

from ..console import warn_once


def has_cuda_kernels() -> bool:
    """Test for a GPU and CUDA kernels without touching the GPU."""
    return torch.cuda.is_available() and importlib.util.find_spec("bitymi_ns._cuda") is not None


def why_not_cuda(index: int | None = None) -> str | None:
    """Explain why the kernels cannot run on a GPU (`index`, or the current one); None = they can."""
    if not torch.cuda.is_available():
        if torch.version.cuda is None:
            return f"torch {torch.__version__} is a build without CUDA"
        return "there is no NVIDIA GPU, or its driver is missing, or too old for this torch"
    if importlib.util.find_spec("bitymi_ns._cuda") is None:
        return f"this installation has no CUDA kernels: {built('WHY_NOT')}"
    try:
        kernels = importlib.import_module("bitymi_ns._cuda")
    except ImportError as error:
        return f"the CUDA kernels cannot be loaded: {error}"
    return _device_problem(kernels, torch.cuda.current_device() if index is None else index)


def built(name: str) -> str:
    """Return WHY_NOT (why there are no CUDA kernels) or NOTE (which GPUs get less than they could) of `_cuda_build`,
    which cmake/cuda.cmake writes."""
    try:
        return getattr(importlib.import_module("bitymi_ns._cuda_build"), name)
    except ImportError:  # of an earlier version, installed in place
        return "it is of an earlier version, install bitymi-ns again" if name == "WHY_NOT" else ""


@cache
def _device_problem(kernels: ModuleType, index: int) -> str | None:
    """Have the kernels try a GPU."""
    return kernels.device_problem(index) or None


def kernel_device(device: torch.device | str) -> torch.device:
    """Return the device, or the CPU if the kernels cannot run on it: nerfstudio's tools pick any GPU."""
    device = torch.device(device)
    if device.type != "cpu":
        none = f"there are no kernels for the device '{device}'"
        problem = why_not_cuda(device.index) if device.type == "cuda" else none
        if problem is None:
            return device
        warn_once(f"The scene stays on the CPU: {problem}.")
    return torch.device("cpu")
