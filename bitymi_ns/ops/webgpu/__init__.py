"""Rendering of baked scenes through WebGPU, with the shaders of the browser viewer and the optional package `wgpu`."""

from .device import WebGpuUnavailable
from .on_device import draw

__all__ = ["WebGpuUnavailable", "draw"]
