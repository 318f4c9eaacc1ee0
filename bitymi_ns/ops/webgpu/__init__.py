"""Rendering of baked scenes through WebGPU, on any vendor's GPU, with the shaders of the browser viewer.

Requires the optional package `wgpu` (`pip install 'bitymi-ns[webgpu]'`).
"""

from .device import WebGpuUnavailable
from .on_device import draw

__all__ = ["WebGpuUnavailable", "draw"]
