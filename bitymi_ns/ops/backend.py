"""The compiled kernel for a tensor, by its device and dtype, and objects of kernels that keep their memory."""

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

from bitymi_ns import KernelsUnavailable

T = TypeVar("T")
SUFFIX = {torch.float32: "_f32", torch.float64: "_f64"}

CPUINFO = Path("/proc/cpuinfo")

_AS_IT_IS = nullcontext()

_emulated = False


@contextmanager
def emulated_cuda(seed: int = 0) -> Iterator[None]:
    """Send tensors on the CPU to the CUDA kernels, which run thread by thread on the host. For tests.

    Args:
        seed: of the order in which the threads of a block take turns.

    Raises:
        RuntimeError: the package was built without them (CMake option BITYMI_EMULATED_CUDA).
    """
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
    """Name of the module of CPU kernels: of those that were built, the last for which this CPU has all that it needs.

    Asked before it is loaded: a CPU ends a process at an instruction that it does not have. Only Linux lists a CPU's
    features; elsewhere the first module is taken to run.

    Raises:
        KernelsUnavailable: this CPU lacks a feature that each of them needs.
    """
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
    """The compiled module of that name: _cpu, _cuda or _emulated. Starts no thread and changes no setting.

    Raises:
        KernelsUnavailable: it is missing, or not for this CPU.
    """
    try:
        return importlib.import_module(f"bitymi_ns.{cpu_module() if name == '_cpu' else name}")
    except ImportError as error:
        advice = {
            "_cpu": "install the package (`pip install .`, or `make setup` in a checkout)",
            "_cuda": "install the package again where the CUDA toolkit's nvcc is found, or move the tensors to the CPU",
            "_emulated": "install the package with --config-settings=cmake.define.BITYMI_EMULATED_CUDA=ON",
        }[name]
        raise KernelsUnavailable(
            f"the compiled module bitymi_ns.{name} is missing: {advice}; the import said: {error}"
        ) from (error)


@functools.cache
def _set_up_process() -> None:
    load("_cpu").set_up_process()


def give_back_memory() -> None:
    """Return freed memory that the process keeps for the next views to the system, before views of other sizes."""
    if _set_up_process.cache_info().currsize:  # the CPU kernels have been asked for
        load("_cpu").give_back_memory()


def cuda_backend(device: torch.device) -> bool:
    """Return True if tensors on that device go to the CUDA kernels or to their emulation."""
    return device.type == "cuda" or _emulated


def module(device: torch.device) -> ModuleType:
    """The kernel module for a device.

    Raises:
        RuntimeError: the kernels for that device are not built, or not for this CPU.
    """
    if device.type not in ("cpu", "cuda"):
        raise RuntimeError(f"no kernels for device '{device}': move the tensors to the CPU or a CUDA device")
    if cuda_backend(device):
        return load("_cuda" if device.type == "cuda" else "_emulated")
    _set_up_process()
    return load("_cpu")


def require(operation: str, kind: str, device: torch.device, instead: str) -> None:
    """Refuse a device on which an operation has no kernel.

    Args:
        kind: cpu or cuda, where it has one.
        instead: what to do, the end of the message.

    Raises:
        RuntimeError: the device is not of that kind.
    """
    if cuda_backend(device) != (kind == "cuda") or device.type not in ("cpu", "cuda"):
        where = {"cpu": "on the CPU", "cuda": "on a CUDA device"}
        raise RuntimeError(f"{operation} runs {where[kind]} only, and the tensors are on '{device}': {instead}")


def function(name: str, device: torch.device) -> Callable[..., Any]:
    """The kernel function of that name, which takes its arguments by keyword (csrc/ops); on a CUDA device it runs on
    torch's current stream of that device.

    Raises:
        RuntimeError: the kernels for that device are not built, or it has none of that name.
    """
    compiled = getattr(module(device), name, None)
    if compiled is None:
        raise RuntimeError(f"there is no kernel {name} for tensors on '{device}': move them to another device")
    if device.type != "cuda":
        return compiled

    def on_stream(**arguments: Any) -> Any:
        with on_device(device):
            return compiled(**arguments, stream=_stream(device))

    return on_stream


def _stream(device: torch.device) -> int:
    """torch's current stream of a CUDA device, as the number that CUDA knows it by."""
    raw = getattr(torch._C, "_cuda_getCurrentRawStream", None)  # in half a microsecond, where a Stream takes ten
    if raw is None or device.index is None:
        return torch.cuda.current_stream(device).cuda_stream
    return raw(device.index)


def _name(name: str, like: Tensor) -> str:
    if like.dtype not in SUFFIX:
        raise TypeError(f"{name} takes float32 or float64 tensors, not {like.dtype}")
    return name + SUFFIX[like.dtype]


def kernel(name: str, like: Tensor) -> Callable[..., Any]:
    """The kernel function `name` for tensors like `like`.

    Raises:
        TypeError: the dtype is neither float32 nor float64.
        RuntimeError: the kernels for that device are not built.
    """
    return function(_name(name, like), like.device)


def kernel_class(name: str, like: Tensor) -> type:
    """The class `name` of the kernel module for tensors like `like`; raises what `kernel` raises."""
    return getattr(module(like.device), _name(name, like))


def workspace(name: str, like: Tensor, **sizes: int) -> Tensor:
    """Working memory for the CUDA kernel `name`: [bytes] uint8, as many as its function `name`_workspace asks for."""
    ask = getattr(module(like.device), _name(f"{name}_workspace", like))
    with on_device(like.device):
        size = ask(**sizes)
    return torch.empty(size, dtype=torch.uint8, device=like.device)


def on_device(device: torch.device) -> AbstractContextManager[Any]:
    """A context in which that CUDA device is the current one, for calls that take no stream."""
    if device.type != "cuda" or device.index == torch.cuda.current_device():
        return _AS_IT_IS
    return torch.cuda.device(device)


def on_same_device(like: Tensor, **tensors: Tensor) -> None:
    """Check that tensors lie where `like` does.

    Raises:
        ValueError: one does not; names it.
    """
    for name, tensor in tensors.items():
        if tensor.device != like.device:
            raise ValueError(f"{name} is on device '{tensor.device}', it must be on '{like.device}'")


def check_shapes(**shapes: tuple[Tensor, Sequence[int]]) -> None:
    """Check tensors against their shapes, by name.

    Raises:
        ValueError: one has another shape; names it.
    """
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != tuple(shape):
            raise ValueError(f"{name} must have shape {list(shape)}, not {list(tensor.shape)}")


def dense(tensor: Tensor, like: Tensor) -> Tensor:
    """`tensor` without its graph, contiguous, with the dtype and device of `like`."""
    if tensor.dtype != like.dtype or tensor.device != like.device:
        tensor = tensor.to(like)
    return (tensor.detach() if tensor.requires_grad else tensor).contiguous()


def version_of(tensor: Tensor) -> int:
    """Count how often a tensor was written to; -1 for one of inference mode, which does not count."""
    return -1 if tensor.is_inference() else tensor._version


class Pool(Generic[T]):
    """Objects of one kind, made where none is idle; one is used by one thread at a time."""

    def __init__(self, make: Callable[[], T]) -> None:
        self._make = make
        self._idle: list[T] = []
        self._lock = threading.Lock()

    @contextmanager
    def borrow(self) -> Iterator[T]:
        """An idle object, or a new one. It is idle again where the block ends without an error."""
        with self._lock:
            borrowed = self._idle.pop() if self._idle else None
        if borrowed is None:
            borrowed = self._make()
        yield borrowed
        with self._lock:
            self._idle.append(borrowed)
