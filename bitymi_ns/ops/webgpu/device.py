"""The WebGPU device and its capabilities."""

import functools
import importlib
from types import ModuleType
from typing import Any

INSTALL = "pip install 'bitymi-ns[webgpu]'"
OPTIONAL = ("texture-compression-bc", "float32-blendable", "float32-filterable")
"""Features that are used if available."""
_LIMITS = (
    *("max-texture-dimension-2d", "max-texture-array-layers", "max-storage-buffer-binding-size", "max-buffer-size"),
    "max-compute-workgroups-per-dimension",
)


class WebGpuUnavailable(RuntimeError):
    """WebGPU is not available; the message says why and what to do."""


@functools.cache
def library() -> ModuleType:
    """Import wgpu. Raises WebGpuUnavailable: not installed, or not loadable."""
    try:
        return importlib.import_module("wgpu")
    except Exception as error:  # the library may be for another system; what it raises is undocumented
        raise WebGpuUnavailable(
            f"drawing through WebGPU needs Python 3.11 and the package wgpu ({INSTALL}): {error}"
        ) from error


@functools.cache
def device() -> Any:
    """Return the device of this process, a GPU if possible, else a software adapter. Raises WebGpuUnavailable: none
    found."""
    rank = {"DiscreteGPU": 0, "IntegratedGPU": 1, "VirtualGPU": 2, "Unknown": 3, "CPU": 4}
    adapters = [a for a in library().gpu.enumerate_adapters_sync() if a.info["backend_type"] != "OpenGL"]
    if not adapters:
        raise WebGpuUnavailable(
            "no graphics device for WebGPU was found: it needs a driver for Vulkan, Metal or Direct3D 12 (on Debian "
            "and Ubuntu: apt install mesa-vulkan-drivers, which also draws without a GPU)"
        )
    adapter = min(adapters, key=lambda a: rank.get(a.info["adapter_type"], 3))
    try:
        return adapter.request_device_sync(
            required_features=[name for name in OPTIONAL if name in adapter.features],
            required_limits={name: adapter.limits[name] for name in _LIMITS},
        )
    except RuntimeError as error:
        raise WebGpuUnavailable(f"the graphics device {adapter.info['device']} cannot be used: {error}") from error


def check_room(*, array_bytes: int = 0, groups: int = 0, size: tuple[int, int] = (0, 0), layers: int = 0) -> None:
    """Check bytes of the largest buffer, workgroups of a dispatch, and the size of a texture against the device's
    limits. Raises WebGpuUnavailable: one is exceeded."""
    limits = device().limits
    wanted = {
        "max-storage-buffer-binding-size": array_bytes,
        "max-buffer-size": array_bytes,
        "max-compute-workgroups-per-dimension": groups,
        "max-texture-dimension-2d": max(size),
        "max-texture-array-layers": layers,
    }
    for name, needed in wanted.items():
        if needed > limits[name]:
            what = name.removeprefix("max-").replace("-", " ")
            raise WebGpuUnavailable(f"the graphics device is too small: {what} is {limits[name]}, {needed} are needed")


def in_software() -> bool:
    """Return True for a software adapter, which decodes a BC7 block for each texel fetch."""
    return device().adapter.info["adapter_type"] == "CPU"
