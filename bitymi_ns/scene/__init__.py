"""Trained scenes: surfels with view-dependent and residual colours."""

from .camera import Camera
from .config import SceneConfig
from .field import HashField
from .scene import RenderOutput, Scene

__all__ = ["Camera", "HashField", "RenderOutput", "Scene", "SceneConfig"]
