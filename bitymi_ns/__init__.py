"""Textured Beta-surfel splatting: a nerfstudio method.

The public functions are `load_capture`, `train_scene`, `bake_scene`, `read_bundle` and `rasterize` (bitymi_ns/api.py).
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bitymi_ns.api import Bundle, Camera, View, bake_scene, load_capture, rasterize, read_bundle, train_scene

__version__ = "0.1.0"
__all__ = ["Bundle", "Camera", "View", "bake_scene", "load_capture", "rasterize", "read_bundle", "train_scene"]


class KernelsUnavailable(RuntimeError):
    """The compiled kernels are missing or do not run on this machine; the message says what to do."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'bitymi_ns' has no attribute '{name}'")
    from bitymi_ns import api  # lazily: nerfstudio imports this package to list its methods

    return getattr(api, name)
