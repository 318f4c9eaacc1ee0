"""Dispatch to compiled kernels by device and dtype; pools of kernel objects that keep their memory."""

import functools
import importlib
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from bitymi_ns.errors import KernelsUnavailable

T = TypeVar("T")
SUFFIX = {torch.float32: "_f32", torch.float64: "_f64"}

CPUINFO = Path("/proc/cpuinfo")

_AS_IT_IS = nullcontext()

_emulated = False


@contextmanager
def emulated_cuda(seed: int = 0) -> Iterator[None]:
    """Send CPU tensors to the CUDA kernels, run thread by thread on the host, for tests. `seed`: of the order of a
    block's threads. Raises KernelsUnavailable: the package was built without BITYMI_EMULATED_CUDA (a CMake option)."""
    global _emulated
    before = _emulated
    load("_emulated").set_seed(seed)
    _emulated = True
    try:
        yield
    finally:
        _emulated = before


@functools.cache
def cpu_module() -> str:
    """Return the name of the best module of CPU kernels that this CPU can run; the first where its features are unknown
    (outside Linux). Raises KernelsUnavailable: it lacks a feature that all modules need."""
    # checked before loading, as an unsupported instruction ends the process
    try:
        needs = importlib.import_module("bitymi_ns._cpu_features").FEATURES
        lines = CPUINFO.read_text(encoding="utf8").splitlines()
    except (ImportError, OSError):
        return "_cpu"
    flags = next((line.split(":", 1)[1].split() for line in lines if line.startswith("flags")), None)
    if flags is None:
        return "_cpu"
    lacking = {name: [flag for flag in needed.split() if flag not in flags] for name, needed in needs.items()}
    usable = [name for name, missing in lacking.items() if not missing]
    if not usable:
        raise KernelsUnavailable(
            f"the CPU kernels were compiled for a CPU with {', '.join(lacking['_cpu'])}, which this one lacks: install "
            "bitymi-ns again on this machine from its source, with `pip install . "
            "--config-settings=cmake.define.BITYMI_MARCH=native` (in a checkout: `make clean setup`)"
        )
    return usable[-1]


@functools.cache
def load(name: str) -> ModuleType:
    """Load a compiled module: _cpu, _cuda or _emulated. Raises KernelsUnavailable: missing, or not for this CPU."""
    try:
        return importlib.import_module(f"bitymi_ns.{cpu_module() if name == '_cpu' else name}")
    except ImportError as error:
        advice = {
            "_cpu": "install the package (`pip install .`, or `make setup` in a checkout)",
            "_cuda": "install the package again where the CUDA toolkit's nvcc is found, or move the tensors to the CPU",
            "_emulated": "install the package with --config-settings=cmake.define.BITYMI_EMULATED_CUDA=ON",
        }[name]
        what = f"the compiled module bitymi_ns.{name} is missing: {advice}; the import said: {error}"
        raise KernelsUnavailable(what) from error


@functools.cache
def _set_up_process() -> None:
    load("_cpu").set_up_process()


def give_back_memory() -> None:
    """Return memory that the CPU kernels keep for later views to the system, before views of other sizes."""
    if _set_up_process.cache_info().currsize:  # the CPU kernels have been asked for
        load("_cpu").give_back_memory()


def cuda_backend(device: torch.device) -> bool:
    """Return True if tensors on that device go to the CUDA kernels or their emulation."""
    return device.type == "cuda" or _emulated


def module(device: torch.device) -> ModuleType:
    """Return the kernel module for a device. Raises RuntimeError: there is none, or as `load`."""
    if device.type not in ("cpu", "cuda"):
        raise RuntimeError(f"no kernels for device '{device}': move the tensors to the CPU or a CUDA device")
    if cuda_backend(device):
        return load("_cuda" if device.type == "cuda" else "_emulated")
    _set_up_process()
    return load("_cpu")


def lookup(name: str, device: torch.device) -> Any:
    """Return a function or class of the kernel module for a device. Raises RuntimeError: it has none of that name,
    or as `module`."""
    kernel_or_class = getattr(module(device), name, None)
    if kernel_or_class is None:
        raise RuntimeError(f"there is no kernel {name} for tensors on '{device}': move them to another device")
    return kernel_or_class


def function(name: str, device: torch.device) -> Callable[..., Any]:
    """Return a kernel function, which takes keyword arguments (csrc/ops) and, on a CUDA device, runs on torch's current
    stream; raises as `lookup`."""
    run = lookup(name, device)
    if device.type != "cuda":
        return run

    def on_stream(**arguments: Any) -> Any:
        with on_device(device):
            return run(**arguments, stream=stream_of(device))

    return on_stream


def stream_of(device: torch.device) -> int:
    """Return the raw handle of torch's current stream of a CUDA device; 0 for the emulator."""
    if device.type != "cuda":
        return 0
    raw = getattr(torch._C, "_cuda_getCurrentRawStream", None)  # 0.5 us; constructing a Stream takes ten
    if raw is None or device.index is None:
        return torch.cuda.current_stream(device).cuda_stream
    return raw(device.index)


def _name(name: str, like: Tensor) -> str:
    if like.dtype not in SUFFIX:
        raise TypeError(f"{name} takes float32 or float64 tensors, not {like.dtype}")
    return name + SUFFIX[like.dtype]


def kernel(name: str, like: Tensor) -> Callable[..., Any]:
    """Return the kernel function `name` for tensors like `like`. Raises TypeError: neither float32 nor float64. Raises
    RuntimeError: as `lookup`."""
    return function(_name(name, like), like.device)


def kernel_class(name: str, like: Tensor) -> type:
    """Return the class `name` for tensors like `like`; raises as `kernel`."""
    return lookup(_name(name, like), like.device)


def workspace(name: str, like: Tensor, **sizes: int) -> Tensor:
    """Allocate working memory for the CUDA kernel `name`, sized by its function `name`_workspace: [bytes] uint8."""
    ask = lookup(_name(f"{name}_workspace", like), like.device)
    with on_device(like.device):
        size = ask(**sizes)
    return torch.empty(size, dtype=torch.uint8, device=like.device)


def on_device(device: torch.device) -> AbstractContextManager[Any]:
    """Make a CUDA device current, for calls that take no stream."""
    if device.type != "cuda" or device.index == torch.cuda.current_device():
        return _AS_IT_IS
    return torch.cuda.device(device)


def on_same_device(like: Tensor, **tensors: Tensor) -> None:
    """Raise ValueError for a tensor on another device than `like`."""
    for name, tensor in tensors.items():
        if tensor.device != like.device:
            raise ValueError(f"{name} is on device '{tensor.device}', it must be on '{like.device}'")


def check_shapes(**shapes: tuple[Tensor, Sequence[int]]) -> None:
    """Raise ValueError for a tensor with another shape."""
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != tuple(shape):
            raise ValueError(f"{name} must have shape {list(shape)}, not {list(tensor.shape)}")


def dense(tensor: Tensor, like: Tensor) -> Tensor:
    """Return `tensor` detached and contiguous, with the dtype and device of `like`."""
    if tensor.dtype != like.dtype or tensor.device != like.device:
        tensor = tensor.to(like)
    return (tensor.detach() if tensor.requires_grad else tensor).contiguous()


def version_of(tensor: Tensor) -> int:
    """Return the number of writes to a tensor; -1 for inference tensors, which do not count them."""
    return -1 if tensor.is_inference() else tensor._version


class Pool(Generic[T]):
    """Reusable objects, each used by one thread at a time."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make = make
        self._idle: list[T] = []
        self._lock = threading.Lock()

    @contextmanager
    def borrow(self) -> Iterator[T]:
        """Yield an idle object, or a new one; it returns to the pool unless the block raises."""
        with self._lock:
            borrowed = self._idle.pop() if self._idle else None
        if borrowed is None:
            borrowed = self._make()
        yield borrowed
        with self._lock:
            self._idle.append(borrowed)
