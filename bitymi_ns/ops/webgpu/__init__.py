"""Drawing a baked scene through WebGPU: on graphics of any maker, by the shaders that the browser's viewer runs.

Needs the package `wgpu`, which is optional (`pip install 'bitymi-ns[webgpu]'`).
"""

from .device import WebGpuUnavailable
from .on_device import draw

__all__ = ["WebGpuUnavailable", "draw"]
