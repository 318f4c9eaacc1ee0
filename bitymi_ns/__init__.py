"""Textured Beta-surfel splatting: a nerfstudio method.

The public functions are `load_capture`, `train_scene`, `bake_scene`, `read_bundle` and `rasterize` (bitymi_ns/api.py).
"""

import importlib.metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .api import Bundle, Camera, View, bake_scene, load_capture, rasterize, read_bundle, train_scene

__all__ = ["Bundle", "Camera", "View", "bake_scene", "load_capture", "rasterize", "read_bundle", "train_scene"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.metadata.version("bitymi-ns")
    if name not in __all__:
        raise AttributeError(f"module 'bitymi_ns' has no attribute '{name}'")
    from . import api  # lazily: nerfstudio imports this package to list its methods

    return getattr(api, name)
